"""Scripts of tasks: check, draw and write task files, and list the regions that they can refer to."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from libero.libero import get_libero_path
from libero.libero.benchmark import Benchmark, get_benchmark, libero_suites
from libero.libero.envs import OffScreenRenderEnv
from libero.libero.envs.objects import get_object_dict
from libero.libero.utils.object_utils import get_affordance_regions
from libero.libero.utils.task_generation_utils import TaskInfoTuple, generate_bddl_from_task_info
from libero.scripts.command import script
from libero_env.cli.options import Positional, Positive, Side
from libero_env.demos.read import read_demos
from libero_env.errors import LiberoError
from libero_env.init_states.pickles import read_states
from libero_env.tasks import bddl

EXAMPLES = (
    TaskInfoTuple(
        "kitchen_scene1",
        "open the top drawer of the cabinet and put the bowl in it",
        ("wooden_cabinet_1", "akita_black_bowl_1"),
        (
            ("Open", "wooden_cabinet_1_top_region"),
            ("In", "akita_black_bowl_1", "wooden_cabinet_1_top_region"),
        ),
    ),
    TaskInfoTuple(
        "kitchen_scene1",
        "put the plate on top of the cabinet",
        ("plate_1", "wooden_cabinet_1"),
        (("On", "plate_1", "wooden_cabinet_1_top_side"),),
    ),
)


@script()
def check_task_suites(suites: Positional[tuple[str, ...]] = tuple(libero_suites)) -> int:
    """Check that every task of the benchmark has a task file that can be read, and its initial states.

    Args:
        suites: Names of suites.
    """
    bad = 0
    for name in suites:
        suite = get_benchmark(name)()
        faults = list(_faults(suite))
        for line in faults:
            print(f"FAIL  {line}")
        print(f"{name}: {suite.n_tasks} tasks, {len(faults)} faults")
        bad += len(faults)
    return int(bad > 0)


def _faults(suite: Benchmark) -> Iterator[str]:
    """Yield what is wrong with the files of a suite."""
    states = Path(get_libero_path("init_states"))
    for i, task in enumerate(tqdm(suite.tasks, desc=suite.name, disable=None)):
        try:
            bddl.read(suite.get_task_bddl_file_path(i))
            rows = read_states(states / task.problem_folder / task.init_states_file)
        except (LiberoError, OSError) as error:
            yield str(error)
            continue
        if rows.ndim != 2 or len(rows) < 50:
            yield f"{task.init_states_file}: {rows.shape}; expected at least 50 states"


@script()
def render_single_task(
    *,
    benchmark_name: str | None = None,
    task_id: int | None = None,
    bddl_file: str | None = None,
    demo_file: str | None = None,
    num: Positive = 5,
    size: Side = 256,
    seed: int = 0,
    out: Path = Path("benchmark_tasks"),
) -> None:
    """Draw the initial states of a task, or the first states of its demonstrations, side by side.

    Args:
        benchmark_name: Such as libero_goal.
        task_id: Index of the task in the benchmark.
        bddl_file: Task file, instead of a task of a benchmark.
        demo_file: Demonstration file, whose first states are drawn.
        num: Number of states.
        size: Size of each picture, pixels.
        seed: Seed of the states where none are stored.
        out: Folder.
    """
    states: Sequence[np.ndarray] | None = None  # to be sampled
    if bddl_file and (benchmark_name or task_id is not None):
        raise LiberoError("--bddl_file and a task of a benchmark are both given; give one of them")
    if bddl_file:
        file = bddl_file
    elif benchmark_name and task_id is not None:
        suite = get_benchmark(benchmark_name)()
        if task_id not in range(suite.n_tasks):
            raise LiberoError(f"--task_id {task_id}: {suite.name} has 0 to {suite.n_tasks - 1}")
        file = suite.get_task_bddl_file_path(task_id)
        if not demo_file:
            states = list(suite.get_task_init_states(task_id)[:num])
    else:
        raise LiberoError("which task? Pass --benchmark_name and --task_id, or --bddl_file")
    if demo_file:
        demos = read_demos(demo_file, (), num)
        states = [demo.states[0] for demo in demos if demo.states.shape[1]]
    env = OffScreenRenderEnv(bddl_file_name=file, camera_heights=size, camera_widths=size)
    env.seed(seed)
    pictures = []
    for i in tqdm(range(num if states is None else len(states)), unit="state", disable=None):
        obs = env.reset()
        if states is not None:
            obs = env.set_init_state(states[i])
        pictures.append(obs["agentview_image"][::-1])
    env.close()
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{Path(file).stem}.png"
    Image.fromarray(np.concatenate(pictures, axis=1)).save(path)
    print(path)


@script()
def create_libero_task_example(*, folder: str = "custom_pddl") -> None:
    """Write two user-defined tasks on a scene of the benchmark as task files, as an example.

    Args:
        folder: Folder of the files.
    """
    for task in EXAMPLES:
        print(generate_bddl_from_task_info(task, output_dir=folder))


@script()
def get_affordance_info(categories: Positional[tuple[str, ...]] = ()) -> None:
    """List the regions of objects that tasks can refer to: drawers, shelves, the inside of baskets.

    Args:
        categories: Such as wooden_cabinet (default: all).
    """
    get_affordance_regions(categories or get_object_dict(), verbose=True)
