"""Record successful episodes of the expert on the original's models, for `expert_there.py`.

    python expert_here.py --assets FOLDER --out FOLDER [--episodes 20] [--suites libero_goal ...]

Each suite gives the same number of episodes, spread over its tasks; episodes whose file exists are not run again.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.expert import Expert, Shapes
from libero_env.expert.expert import MAX_STEPS, run_experts
from libero_env.storage import atomic_write_npz
from libero_env.tasks import Task, get_suite

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_90", "libero_10")


def record(task: Task, seed: int, assets: str, robot: str) -> dict[str, np.ndarray]:
    """Return the arrays of the expert's attempt from a placement of a task's objects."""
    env = BatchEnv(task, 1, cameras=(), horizon=MAX_STEPS, assets=assets, robot=robot)
    scene = env.scene
    env.reset(seed=seed)
    rng = np.random.default_rng([task.index, seed])
    attempt = run_experts(env, [Expert(task, rng, shapes=Shapes(scene))])[0]
    env.close()
    return {
        "suite": np.array(task.suite),
        "task_id": np.array(task.index),
        "seed": np.array(seed),
        "success": np.array(attempt.success),
        "start": attempt.states[0],
        "end": attempt.states[-1],
        "actions": attempt.actions,
        "fixtures": attempt.fixtures,
        "fixture_names": np.array(list(scene.fixtures)),
        "mujoco": np.array(mujoco.__version__),
        "robot": np.array(robot),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--assets", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--episodes", type=int, default=20, help="successful episodes of each suite")
    parser.add_argument("--suites", nargs="+", default=SUITES)
    parser.add_argument("--robot", default="libero")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for suite in args.suites:
        tasks = get_suite(suite).tasks
        tasks = tasks[:: max(1, len(tasks) // args.episodes)]
        good = 0
        for k, task in ((k, task) for k in range(10) for task in tasks):
            if good == args.episodes:
                break
            path = args.out / f"{suite}-{task.index:02d}-{k:02d}.npz"
            if not path.exists():
                atomic_write_npz(path, record(task, k, args.assets, args.robot))
            with np.load(path) as stored:
                good += bool(stored["success"])
                print(
                    path.stem,
                    "success" if stored["success"] else "failure",
                    len(stored["actions"]),
                    flush=True,
                )


if __name__ == "__main__":
    main()
