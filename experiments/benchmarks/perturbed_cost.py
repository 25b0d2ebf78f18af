"""Cost of a perturbed reset and step beside a plain one: CPU time of four simulations on one thread, two cameras.

    OMP_NUM_THREADS=1 python experiments/benchmarks/perturbed_cost.py [--task libero_goal/3] [--severity 0.5]

Each environment takes turns with a plain one; both count with their fastest round. Times are in ms, of one simulation;
`open` is of the environment, once: where it is high, another scene was compiled. `first reset` is of starts that were
not seen before, `reset` of the same ones again.
"""

import argparse
import json
import os
import time
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from libero_env import BatchEnv

os.environ.setdefault("MUJOCO_GL", "egl")
NUM, STEPS = 4, 5
COLUMNS = ("open", "first reset", "plain reset", "reset", "plain step", "step")


def reset_ms(env: "BatchEnv") -> float:
    """Return the CPU time of the reset of one simulation, ms."""
    began = time.process_time()
    env.reset(options={"init_state": list(range(NUM))})
    return 1e3 * (time.process_time() - began) / NUM


def step_ms(env: "BatchEnv") -> float:
    """Return the CPU time of a step of one simulation with its two pictures, ms."""
    began = time.process_time()
    for _ in range(STEPS):
        env.step(np.zeros((NUM, 7)))
    return 1e3 * (time.process_time() - began) / NUM / STEPS


def main() -> None:
    """Print a row for each kind, and the numbers as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="libero_goal/3")
    parser.add_argument("--severity", type=float, default=0.5)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()

    from libero_env import BatchEnv
    from libero_env.perturbations import KINDS

    def make(perturb: str) -> BatchEnv:
        return BatchEnv(args.task, NUM, num_threads=1, camera_size=(args.size, args.size), perturb=perturb)

    plain, rows = make(""), {}
    plain.reset(options={"init_state": [40, 41, 42, 43]})  # the OpenGL context
    for name in KINDS:
        began = time.process_time()
        env = make(f"{name}={args.severity}")
        opened = 1e3 * (time.process_time() - began)
        env.reset(options={"init_state": [40, 41, 42, 43]})
        first = reset_ms(env)
        best = np.full((2, 2), np.inf)
        for _ in range(args.rounds):
            best = np.minimum(best, [[reset_ms(one), step_ms(one)] for one in (plain, env)])
        rows[name] = dict(zip(COLUMNS, [opened, first, *best.T.ravel().tolist()], strict=True))
        env.close()
    print(f"{'':16}" + "".join(f"{column:>14}" for column in COLUMNS))
    for name, row in rows.items():
        print(f"{name:16}" + "".join(f"{value:14.1f}" for value in row.values()))
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
