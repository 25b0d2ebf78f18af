"""Draw the initial states of a task, or the first states of its demonstrations, side by side."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from libero.libero.benchmark import get_benchmark
from libero.libero.envs import OffScreenRenderEnv
from libero.scripts.command import option, script
from libero_env.demos.read import read_demos
from libero_env.errors import LiberoError


@script(
    option("--benchmark_name", help="such as libero_goal"),
    option("--task_id", type=int, help="index of the task in the benchmark"),
    option("--bddl_file", help="task file, instead of a task of a benchmark"),
    option("--demo_file", help="demonstration file, whose first states are drawn"),
    option("--num", type=int, default=5, help="number of states (default: 5)"),
    option("--size", type=int, default=256, help="size of each picture, pixels (default: 256)"),
    option("--seed", type=int, default=0, help="seed of the states where none are stored (default: 0)"),
    option("--out", type=Path, default=Path("benchmark_tasks"), help="folder (default: benchmark_tasks)"),
)
def main(args: argparse.Namespace) -> None:
    """Write the picture and print its path; raise a LiberoError if no task is named, or the index does not exist."""
    file, states = task_and_states(args)
    env = OffScreenRenderEnv(bddl_file_name=file, camera_heights=args.size, camera_widths=args.size)
    env.seed(args.seed)
    pictures = []
    for i in tqdm(range(args.num if states is None else len(states)), unit="state", disable=None):
        obs = env.reset()
        if states is not None:
            obs = env.set_init_state(states[i])
        pictures.append(obs["agentview_image"][::-1])
    env.close()
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{Path(file).stem}.png"
    Image.fromarray(np.concatenate(pictures, axis=1)).save(path)
    print(path)


def task_and_states(args: argparse.Namespace) -> tuple[str, Sequence[np.ndarray] | None]:
    """Return the task file and the states to draw; None for states to be sampled."""
    states: Sequence[np.ndarray] | None = None
    if args.bddl_file:
        file = args.bddl_file
    elif args.benchmark_name and args.task_id is not None:
        suite = get_benchmark(args.benchmark_name)()
        if args.task_id not in range(suite.n_tasks):
            raise LiberoError(f"--task_id {args.task_id}: {suite.name} has 0 to {suite.n_tasks - 1}")
        file = suite.get_task_bddl_file_path(args.task_id)
        if not args.demo_file:
            states = list(suite.get_task_init_states(args.task_id)[: args.num])
    else:
        raise LiberoError("which task? Pass --benchmark_name and --task_id, or --bddl_file")
    if args.demo_file:
        demos = read_demos(args.demo_file, (), args.num)
        states = [demo.states[0] for demo in demos if demo.states.shape[1]]
    return file, states
