"""A policy as a run left it, ready to act: read back from its directory or from one of its checkpoints."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from omegaconf import OmegaConf

from libero_env.tasks import Task
from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm, WindowDataset
from lifelong.build import build
from lifelong.data.settings import DataSettings
from lifelong.errors import CheckpointError, LifelongError
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from lifelong.results.run_directory import RunDirectory
from lifelong.saved_config import upgrade_config
from lifelong.settings import BenchmarkSettings
from lifelong.streams import learning_stages
from lifelong.training.distributed import Ranks


@dataclass(frozen=True)
class Restored:
    """What acts on the tasks of a run, as it was after one of them.

    Attributes:
        path: The run's directory.
        checkpoint: The file the weights came from.
        tasks: Of the run, in learning order.
        learned: Position of the last task learned.
        policy: In evaluation mode.
        algorithm: With what `policy_for` needs.
        eval: How the run measured success.
        seed: Of the run.
        device: Where the policy is.
        language: Embeds instructions; see `embed`.
    """

    path: Path
    checkpoint: Path
    tasks: tuple[Task, ...]
    learned: int
    policy: Policy
    algorithm: Algorithm
    eval: EvalSettings
    seed: int
    device: torch.device
    language: Any
    told: tuple[
        str, ...
    ]  # instructions embedded together: of what was learned before the sequence, and of it
    group_size: int = 1

    def embed(self, task: Task) -> torch.Tensor:
        """(L,) embedding of a task's instruction, as the policy was told it.

        Raises:
            LanguageError: The instruction cannot be embedded.
            LifelongError: The run's embedding knows its own tasks only (one-hot).
        """
        names = [t.name for t in self.tasks]
        if task.name in names:
            found = self.language.embed(self.told)[names.index(task.name) - len(names)]
        else:
            found = self.language.embed([*self.told, task.language])[-1]
        if len(found) != self.policy.spec.language_dim:
            raise LifelongError(
                f"{self.path} tells tasks apart by their position, and {task.id} is none of its own: "
                "evaluate it on its own tasks"
            )
        return found

    @contextmanager
    def acting(self, task: Task) -> Iterator[Policy]:
        """Within the context, the policy that acts on a task; on one that is not the run's, as on the last learned."""
        names = [t.name for t in self.tasks]
        position = names.index(task.name) if task.name in names else self.learned
        stages = learning_stages(self.algorithm, len(self.tasks), self.group_size)
        stage = next(stage for stage in stages if position in stage)
        with self.algorithm.policy_for(stage[-1], self.policy) as policy:
            yield policy


def restore(source: Path, *, after: int | None = None, device: str = "auto") -> Restored:
    """Reads a policy back.

    Args:
        source: A run's directory, or a file in its `checkpoints` folder.
        after: Position of the task after which it is wanted; by default that of the file, or the last there is.
        device: Where to: `auto`, `cpu`, `cuda`, `cuda:<number>`.

    Raises:
        LifelongError: There is no such run or checkpoint, or it does not fit its configuration.
    """
    path, checkpoint, after = _find(source, after)
    config = OmegaConf.create(upgrade_config(_read_config(path / "config.yaml")))
    where = Ranks().device(device)
    benchmark: BenchmarkSettings = build(config.benchmark)
    tasks = benchmark.sequence()
    data: DataSettings = build(config.data)
    language = build(config.language)
    before: tuple[Task, ...] = build(config.pretrain).sequence() if "pretrain" in config else ()
    told = tuple(t.language for t in (*before, *tasks))
    spec = data.spec(language.embed(told).shape[1])
    policy, algorithm = build(config.policy, spec=spec).to(where), build(config.algo)
    state = checkpoints.load(checkpoint, where)
    checkpoints.load_weights(policy, state["policy"], checkpoint)
    if type(algorithm).policy_for is not Algorithm.policy_for:
        algorithm.load_state_dict(state["algorithm"], _NoWindows(path))
    return Restored(
        path=path,
        checkpoint=checkpoint,
        tasks=tasks,
        learned=int(state["task"]),
        policy=policy.eval(),
        algorithm=algorithm,
        eval=build(config.eval),
        seed=int(config.seed),
        device=where,
        language=language,
        told=told,
        group_size=benchmark.group_size,
    )


def _find(source: Path, after: int | None) -> tuple[Path, Path, int]:
    """Directory of the run, the checkpoint, and the position of the task it was made after."""
    if source.is_file():
        return source.parent.parent, source, -1
    directory = RunDirectory(source)
    there = sorted(int(p.stem.removeprefix("task_")) for p in source.glob("checkpoints/task_*.safetensors"))
    if not (source / "config.yaml").is_file() or not there:
        raise LifelongError(
            f"{source} is no run's directory with a learned task: it needs config.yaml and checkpoints"
        )
    if after is not None and after not in there:
        raise LifelongError(f"{source} has no checkpoint after task {after}; there are those after {there}")
    chosen = there[-1] if after is None else after
    return source, directory.task_path(chosen), chosen


def _read_config(file: Path) -> dict[str, Any]:
    try:
        config = yaml.safe_load(file.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise LifelongError(
            f"{file} is missing: a checkpoint is read with its run's configuration"
        ) from error
    if not isinstance(config, dict):
        raise LifelongError(f"{file} is no configuration")
    return config


class _NoWindows(Mapping[int, WindowDataset]):
    """Demonstrations are not read for acting; an algorithm that asks for some cannot be restored for it."""

    def __init__(self, path: Path):
        self._path = path

    def __getitem__(self, task: int) -> WindowDataset:
        raise CheckpointError(f"{self._path}: the algorithm wants the demonstrations of task {task} to act")

    def __iter__(self) -> Iterator[int]:
        return iter(())

    def __len__(self) -> int:
        return 0
