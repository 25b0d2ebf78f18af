"""Pictures of a task: of its initial states, or of the first states of demonstrations, side by side."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from libero.libero.benchmark import get_benchmark
from libero.libero.envs import OffScreenRenderEnv
from libero.scripts.command import run
from libero_env.demos.read import read_demos
from libero_env.errors import LiberoError


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = argparse.ArgumentParser(prog="render_single_task.py", description=__doc__)
    add = parser.add_argument
    add("--benchmark_name", help="such as libero_goal")
    add("--task_id", type=int, help="index of the task in the benchmark")
    add("--bddl_file", help="task file, instead of a task of a benchmark")
    add("--demo_file", help="demonstrations, whose first states are drawn")
    add("--num", type=int, default=5, help="states (default: 5)")
    add("--size", type=int, default=256, help="of each picture, pixels (default: 256)")
    add("--seed", type=int, default=0, help="of the starts where none are stored (default: 0)")
    add("--out", type=Path, default=Path("benchmark_tasks"), help="folder (default: benchmark_tasks)")
    return run(parser, draw, argv)


def draw(args: argparse.Namespace) -> None:
    """Write the picture and name it.

    Raises:
        LiberoError: no task is named, or there is none of this index.
    """
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
    """The task file, and the states to draw; None for starts to be drawn anew."""
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
        raise LiberoError("which task? Name --benchmark_name and --task_id, or --bddl_file")
    if args.demo_file:
        demos = read_demos(args.demo_file, (), args.num)
        states = [demo.states[0] for demo in demos if demo.states is not None]
    return file, states


if __name__ == "__main__":
    raise SystemExit(main())
