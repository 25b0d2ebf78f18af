"""Loading of a run's policy for acting, from the run's directory or one of its checkpoints."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from inspect import isclass
from pathlib import Path
from typing import Any

import torch

from libero_env.envs.batch import BatchEnv
from libero_env.perturbations import Perturbation, reword_task
from libero_env.tasks import Task
from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm, load_algorithm
from lifelong.data.settings import DataSettings
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError, ConfigError, LifelongError, require_run
from lifelong.evaluation.environments import run_environment
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from lifelong.results.run_directory import RunDirectory, read_saved_config
from lifelong.settings import Configuration, find_target
from lifelong.streams import Stages, learning_stages, plan_tasks
from lifelong.training.distributed import Ranks
from lifelong.training.memory import check_memory, policy_bytes


@dataclass(frozen=True)
class LoadedRun:
    """The policy of a run as it was after one of its tasks.

    Attributes:
        path: Directory of the run.
        checkpoint: File of the weights.
        tasks: Tasks of the run in learning order, without perturbations.
        learned: Position of the last task learned.
        policy: Policy in evaluation mode.
        algorithm: Algorithm with the state that `policy_for` needs.
        eval: Settings by which the run measured success.
        language: Encoder of instructions; see `embed`.
        instructions: Instructions that are embedded together: those of the pretraining, then those of the run.
        data: How its demonstrations were recorded and drawn, and with which arm.
        group_sizes: Number of tasks in each group that was learned together; () for one task at a time.
        perturb: Perturbations under which each task was learned and evaluated; () for none at all.
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
    instructions: tuple[str, ...]
    data: DataSettings
    group_sizes: tuple[int, ...] = ()
    perturb: tuple[tuple[Perturbation, ...], ...] = ()

    @property
    def weights_digest(self) -> str:
        """Digest of the file of the weights, 16 hex digits."""
        return hashlib.sha256(self.checkpoint.read_bytes()).hexdigest()[:16]

    def learned_task(self, position: int) -> Task:
        """Return a task of the run in the words in which it was learned."""
        return reword_task(self.tasks[position], self.perturbations(position))

    def perturbations(self, position: int) -> tuple[Perturbation, ...]:
        """Return the perturbations under which a task of the run was learned and evaluated."""
        return self.perturb[position] if self.perturb else ()

    def embed(self, task: Task | int) -> torch.Tensor:
        """Return the (L,) embedding of a task's instruction, as in training.

        Args:
            task: A task, or the position of one of the run's, which may have a task twice.

        Raises:
            LanguageError: The instruction cannot be embedded.
            LifelongError: The run's embedding is defined for its own tasks only, by their position.
        """
        if isinstance(task, int):
            return self.language.embed(self.instructions)[task - len(self.tasks)]
        learned = map(self.learned_task, range(len(self.tasks)))
        names = [(t.name, t.language) for t in learned]
        if (own := (task.origin.name, task.language)) in names:
            return self.language.embed(self.instructions)[names.index(own) - len(names)]
        if getattr(self.language, "by_position", False):  # an encoder of a user's own need not say it
            raise LifelongError(
                f"{self.path} identifies tasks by their position, and {task.id} is not one of its tasks: "
                "evaluate the run on its own tasks"
            )
        # another task, or one of its own in other words
        return self.language.embed([*self.instructions, task.language])[-1]

    @property
    def stages(self) -> Stages:
        """Positions of the tasks that were learned together, stage after stage."""
        return learning_stages(self.algorithm, self.group_sizes or (1,) * len(self.tasks))

    def environment(self, position: int, simulations: int, horizon: int) -> BatchEnv:
        """Return an environment of a task of the run, as it was learned: views, perturbations, drawing and robot.

        Args:
            simulations: Number of episodes that run side by side.
            horizon: Maximum number of control steps of the policy.
        """
        task, perturb = self.tasks[position], self.perturbations(position)
        return run_environment(task, simulations, self.policy.spec, self.eval, self.data, perturb, horizon)

    @contextmanager
    def acting(self, task: Task | int) -> Iterator[Policy]:
        """Yield the policy that acts on a task; for a task that is not the run's, that of the last task learned.

        Args:
            task: As for `embed`.
        """
        if isinstance(task, int):
            position = task
        else:
            names, name = [t.name for t in self.tasks], task.origin.name
            position = names.index(name) if name in names else self.learned
        stage = next(stage for stage in self.stages if position in stage)
        with self.algorithm.policy_for(stage[-1], self.policy) as policy:
            yield policy


def restore(
    source: Path, *, after: int | None = None, device: str = "auto", allow: Sequence[str] = ()
) -> LoadedRun:
    """Load a run's policy from a checkpoint.

    The run may be somebody else's: its configuration is read as plain data, and builds classes of this package only.

    Args:
        source: Directory of a run, or a file in its `checkpoints` folder.
        after: Position of the task after which the checkpoint was written; by default that of the file, or the last.
        device: Device for the policy: `auto`, `cpu`, `cuda`, `cuda:<number>`.
        allow: Packages whose classes the configuration may name too, such as that of a policy of your own.

    Raises:
        ConfigError: The configuration is not valid, or names a class of another package.
        LifelongError: There is no such run or checkpoint, or it does not match its configuration.
    """
    path, checkpoint = _find(source, after)
    config = read_config(path / "config.yaml", allow)
    where = Ranks().device(device)
    config = _from_own_files(config, path)
    plan, language = plan_tasks(config), config.build("language")
    data: DataSettings = config.build("data")
    tasks, instructions = plan.tasks, plan.instructions
    spec = data.spec(language.embed(instructions).shape[1])
    weights = policy_bytes(config, spec)
    check_memory({f"the policy's weights ({path / 'config.yaml'})": weights or 0})
    policy, algorithm = config.build("policy", spec=spec).to(where), config.build("algo")
    state = RunDirectory(path).checkpoints.load_task(checkpoint, where)
    if state["task"] not in range(len(tasks)):
        raise CheckpointError(
            f"{checkpoint} was written after task {state['task']}; the run has {len(tasks)}"
        )
    checkpoints.load_weights(policy, state["policy"], checkpoint)
    if type(algorithm).policy_for is not Algorithm.policy_for:
        load_algorithm(algorithm, state["algorithm"], _NoWindows(path), policy, checkpoint)
    return LoadedRun(
        path=path,
        checkpoint=checkpoint,
        tasks=tasks,
        learned=state["task"],
        policy=policy.eval(),
        algorithm=algorithm,
        eval=config.build("eval"),
        seed=config.settings().seed,
        device=where,
        language=language,
        instructions=instructions,
        data=data,
        group_sizes=plan.group_sizes,
        perturb=plan.perturb if plan.stream.perturb else (),
    )


def _from_own_files(config: Configuration, run: Path) -> Configuration:
    """Return the configuration of a run with a policy that is built from what the run has saved, nothing elsewhere."""
    node: Any = config.values.get("policy")
    with suppress(ConfigError, KeyError, TypeError):  # which building it says
        kind = find_target(node["_target_"], config.allowed)
        if isclass(kind) and issubclass(kind, Policy):
            return replace(config, values={**config.values, "policy": kind.saved_arguments(node, run)})
    return config


def _find(source: Path, after: int | None) -> tuple[Path, Path]:
    """Return the directory of the run, and the checkpoint."""
    if source.is_file():
        if after is not None:
            raise LifelongError(
                f"{source} is one checkpoint, and after={after} names another; give one of them"
            )
        return source.parent.parent, source
    folder = RunDirectory(require_run(source)).checkpoints
    there = folder.tasks()
    if not (source / "config.yaml").is_file() or not there:
        raise LifelongError(
            f"{source} is not a run directory with a learned task: it needs config.yaml and checkpoints"
        )
    if after is not None and after not in there:
        raise LifelongError(f"{source} has no checkpoint after task {after}; valid: {there}")
    return source, folder.task_path(there[-1] if after is None else after)


def read_config(file: Path, allow: Sequence[str]) -> Configuration:
    """Return the configuration of a saved run; the parts of it that acting needs are checked.

    Args:
        file: File config.yaml of the run.
        allow: Packages whose classes the configuration may name, too.

    Raises:
        LifelongError: The file is missing.
        ConfigError: A part is not valid, or names a class of another package.
    """
    if not file.is_file():
        raise LifelongError(f"{file} is missing: a checkpoint needs the configuration of its run")
    values = read_saved_config(file)
    language = values.get("language")
    if isinstance(language, dict):  # nothing is written into a folder that the file names
        values["language"] = {key: value for key, value in language.items() if key != "cache_dir"}
    return Configuration(values, source=str(file), allowed=tuple(allow))


class _NoWindows(dict[int, TaskWindows]):
    """Raises an error if an algorithm reads demonstrations, which are not available for acting."""

    def __init__(self, path: Path):
        self._path = path

    def __missing__(self, task: int) -> TaskWindows:
        raise CheckpointError(f"{self._path}: the algorithm needs the demonstrations of task {task} to act")
