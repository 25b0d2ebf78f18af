"""What a policy knows before the first task: the weights of another run, or a suite learned jointly."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from libero_env.tasks import Task
from libero_env.text import flatten
from lifelong import checkpoints
from lifelong.algorithms.multitask import Multitask
from lifelong.context import RunContext
from lifelong.errors import CheckpointError, ConfigError, LifelongError
from lifelong.evaluation.restore import read_config, restore
from lifelong.policies.base import Policy
from lifelong.results.log import ResultLog
from lifelong.results.records import RunRecord
from lifelong.results.run_directory import RunDirectory, read_saved_config
from lifelong.seeding import INIT, seeded
from lifelong.settings import Configuration, PretrainSettings
from lifelong.streams import StreamSettings
from lifelong.tracking import Tracker
from lifelong.types import PolicySpec

_ROUTED = ("clare", "dmpel", "iscil")
# keys that decide what a policy reads and what it makes of it, whose values do not show in the shapes of weights
INPUTS = (
    *("language.model", "language.numbered", "language.pad_to", "data.views", "data.proprio"),
    *(f"policy.encoder.{key}" for key in ("pixels", "stem_stride", "stem_pool", "temperature", "rectify")),
    *("policy.temporal.heads", "policy.spatial.heads"),
    *("policy.normalise_proprio", "policy.standardise_language"),
)


def load_initial_weights(path: Path) -> tuple[dict[str, Tensor], Path]:
    """Read a policy's weights from another run.

    Args:
        path: Directory of a finished run, for its weights after the last task, or one of the
            `task_<k>.safetensors` in its `checkpoints`.

    Returns:
        The weights, and the file they were read from.

    Raises:
        CheckpointError: There are no such weights; the message states what was found.
    """
    file = _last_checkpoint(path) if path.is_dir() else path
    state = checkpoints.load(file)
    if not isinstance(state.get("policy"), dict):
        raise CheckpointError(
            f"{file} holds no policy's weights; name a run's directory or a task_<k>.safetensors"
        )
    algorithm = state.get("algorithm") or {}
    # LoRA, which keeps its base, has adapters in the weights
    if algorithm.get("library") and "base" not in algorithm:
        raise CheckpointError(
            f"{file}: its policy acts with experts beside these weights, as of {', '.join(_ROUTED)}, which another run "
            "cannot begin with; name the checkpoint after its base stage, or a run of another algorithm"
        )
    return state["policy"], file


def initial_policy(run: Path, *, weights: Path | None = None, allow: Sequence[str] = ()) -> Policy:
    """Return a policy with the weights that a run began with, on the CPU.

    Args:
        weights: A finished run or a checkpoint with these weights. None: those of its seed, or its `init_from`.
        allow: Packages whose classes the configuration may name, too.

    Raises:
        ConfigError: The run was pretrained, and no weights are given.
        CheckpointError: There are no such weights, or they are those of another policy.
    """
    loaded, config = restore(run, device="cpu", allow=allow), read_config(run / "config.yaml", allow)
    if weights is None and config.build("pretrain").sequence():
        raise ConfigError(
            f"{run} began with pretrained weights; name them with --initial, such as a folder in runs/pretrain"
        )
    stated = config.values.get("init_from")
    try:
        return policy_at_start(config, loaded.policy.spec, loaded.seed, weights or stated)
    except LifelongError as error:
        if weights is not None or stated is None:
            raise
        raise CheckpointError(f"{error}; name the weights that the run began with by --initial") from None


def policy_at_start(config: Configuration, spec: PolicySpec, seed: int, weights: str | Path | None) -> Policy:
    """Build a policy with the weights that a run begins with.

    Args:
        spec: What the policy observes and does.
        weights: A finished run or a checkpoint with the weights. None: drawn by the seed.

    Raises:
        CheckpointError: There are no such weights, or they are those of another policy.
    """
    with seeded(seed, INIT):
        policy: Policy = config.build("policy", spec=spec)
    if weights is not None:
        found, file = load_initial_weights(Path(weights).expanduser())
        _check_inputs(config, file)
        checkpoints.load_weights(policy, found, file)
    return policy


def _check_inputs(config: Configuration, file: Path) -> None:
    """Check that a policy reads what the weights of a checkpoint were learned with, where its run's folder tells it.

    Raises:
        CheckpointError: It reads something else, which has the same shapes.
    """
    saved = file.parent.parent / "config.yaml"
    if not saved.is_file():
        return
    was, now = (flatten(values) for values in (read_saved_config(saved), config.values))
    for key in INPUTS:
        if key in was and was[key] != now.get(key):
            raise CheckpointError(
                f"{file} does not fit this run: it was learned with {key}={was[key]}, and this run has {now.get(key)}"
            )


def tasks_learned(path: Path) -> list[str]:
    """Return the names of the tasks that weights given as `init_from` have learned, as far as their run tells."""
    file = _last_checkpoint(path) if path.is_dir() else path
    starts = ResultLog(file.parent.parent / "results.jsonl").read().of(RunRecord)
    place = re.fullmatch(r"task_(\d+)", file.stem)
    return list(starts[-1].tasks[: int(place[1]) + 1]) if starts and place else []


def _last_checkpoint(run: Path) -> Path:
    """Return the checkpoint after the last task of a finished run."""
    folder = RunDirectory(run).checkpoints
    if not (found := folder.tasks()):
        raise CheckpointError(
            f"{run} has no checkpoints/task_<k>.safetensors: it is not a run directory, or no task is learned yet"
        )
    folder.require_own(last := folder.task_path(found[-1]))
    if not ResultLog(run / "results.jsonl").read().finished:
        raise CheckpointError(
            f"{run} is not finished; finish it, or name one of its checkpoints, such as init_from={last}"
        )
    return last


def pretraining_context(
    context: RunContext,
    tasks: tuple[Task, ...],
    languages: Tensor,
    settings: PretrainSettings,
    directory: RunDirectory,
) -> RunContext:
    """Return the context of joint training on other tasks before the sequence, as algo=multitask does it.

    Liu et al. 2023 (LIBERO, figure 5) pretrain on LIBERO-90 and then learn another suite. The policy is that of the
    sequence, so `TaskSequence(...).run(evaluate=False)` trains it in place, or loads its weights if that is done.

    Args:
        context: Context of the sequence that follows.
        tasks: Tasks learned before it.
        languages: (K, L) embeddings of their instructions.
        settings: Number of demonstrations and epochs.
        directory: Directory of their checkpoints and losses, apart from that of the sequence.
    """
    return replace(
        context,
        tasks=tasks,
        languages=languages,
        demos=(settings.demos or context.data.demos,) * len(tasks),
        algorithm=Multitask(),
        fit=replace(context.fit, epochs=settings.epochs or context.fit.epochs),
        eval=replace(context.eval, unseen="none"),
        stream=StreamSettings(),
        perturb=(),
        shift=None,
        held_out=(),
        group_sizes=(1,) * len(tasks),
        directory=directory,
        tracker=Tracker(),
    )
