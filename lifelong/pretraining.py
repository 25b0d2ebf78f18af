"""What a policy knows before the first task: another run's weights, or a suite learned jointly."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from lifelong import checkpoints
from lifelong.algorithms.base import WindowDataset
from lifelong.algorithms.multitask import Multitask
from lifelong.errors import CheckpointError
from lifelong.results.log import ResultLog
from lifelong.results.run_directory import RunDirectory
from lifelong.sequence import Parts, TaskSequence
from lifelong.streams import StreamSettings
from lifelong.tracking import Tracker


def weights_of(path: Path) -> tuple[dict[str, Tensor], Path]:
    """A policy's weights from another run.

    Args:
        path: The directory of a finished run, whose weights after the last task are taken, or one of the
            `task_<k>.safetensors` in its `checkpoints`.

    Returns:
        The weights, and the file they are from.

    Raises:
        CheckpointError: There is nothing of the kind; the message says what there is.
    """
    file = _last_checkpoint(path) if path.is_dir() else path
    state = checkpoints.load(file)
    if not isinstance(state.get("policy"), dict):
        raise CheckpointError(
            f"{file} holds no policy's weights; name a run's directory or a task_<k>.safetensors"
        )
    return state["policy"], file


def _last_checkpoint(run: Path) -> Path:
    """The checkpoint after the last task of a finished run."""
    made = {
        int(f.stem[5:]): f for f in (run / "checkpoints").glob("task_*.safetensors") if f.stem[5:].isdecimal()
    }
    if not made:
        raise CheckpointError(
            f"{run} has no checkpoints/task_<k>.safetensors: it is no run, or has learned nothing yet"
        )
    last = made[max(made)]
    if not ResultLog(run / "results.jsonl").read().finished:
        raise CheckpointError(
            f"{run} is not finished; finish it, or name one of its checkpoints, such as init_from={last}"
        )
    return last


def pretrain(
    parts: Parts,
    *,
    instructions: tuple[str, ...],
    languages: Tensor,
    datasets: Mapping[int, WindowDataset],
    directory: RunDirectory,
    epochs: int,
) -> None:
    """Train the policy jointly on other tasks, as algo=multitask does, without evaluating it on them.

    Liu et al. 2023 (LIBERO, figure 5) pretrain on LIBERO-90 and then learn another suite. It can be killed and
    goes on like a run; where it is done already, its weights are loaded.

    Args:
        parts: Of the sequence that follows; its policy is trained in place.
        instructions: Of the tasks learned before it.
        languages: (K, L) embeddings of these.
        datasets: Their windows.
        directory: Where checkpoints and losses are kept, apart from the sequence's.
        epochs: As of `FitSettings`.
    """
    joint = replace(
        parts,
        instructions=instructions,
        languages=languages,
        datasets=datasets,
        algorithm=Multitask(),
        fit=replace(parts.fit, epochs=epochs),
        directory=directory,
        tracker=Tracker(),
        stream=StreamSettings(),
        group_size=1,
    )
    TaskSequence(joint).run(evaluate=False)
