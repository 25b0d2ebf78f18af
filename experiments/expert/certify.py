"""Run the expert from all 50 initial states of each task and write down how it went.

    python experiments/expert/certify.py [--suite libero_object] [--states 50] [--disturb] [--out experiments/expert]
"""

import argparse
import json
import time
from pathlib import Path

import mujoco
import numpy as np

from libero_env.expert import Disturbance, Expert, Shapes
from libero_env.expert.driver import run_experts
from libero_env.tasks import get_suite
from libero_env.vector import BatchEnv


def certify_task(task, states: int, disturb: bool) -> dict:
    """One task: success, length and reasons of failure for each initial state."""
    start = time.perf_counter()
    env = BatchEnv(task, states, cameras=())
    env.reset(options={"init_state": np.arange(states)})
    shapes = Shapes(env.world.scene)
    seeds = [np.random.SeedSequence([task.index, i]).spawn(2) for i in range(states)]
    experts = [Expert(task, np.random.default_rng(a), shapes=shapes) for a, _ in seeds]
    noise = [Disturbance(np.random.default_rng(b)) for _, b in seeds] if disturb else None
    attempts = run_experts(env, experts, noise)
    env.close()
    lengths = [len(a) for a in attempts if a.success]
    return {
        "task": task.name,
        "states": states,
        "successes": sum(a.success for a in attempts),
        "mean_length": round(float(np.mean(lengths)), 1) if lengths else None,
        "max_length": max(lengths, default=None),
        "retries": sum(a.retries for a in attempts),
        "failures": {i: a.reason for i, a in enumerate(attempts) if not a.success},
        "seconds": round(time.perf_counter() - start, 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--states", type=int, default=50)
    parser.add_argument("--tasks", type=int, nargs="*")
    parser.add_argument("--disturb", action="store_true", help="disturb the actions as demonstrations do")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rows = []
    for task in get_suite(args.suite).tasks:
        if args.tasks and task.index not in args.tasks:
            continue
        rows.append(certify_task(task, args.states, args.disturb))
        print(json.dumps(rows[-1]), flush=True)
    total, good = sum(r["states"] for r in rows), sum(r["successes"] for r in rows)
    print(f"{good}/{total} = {100 * good / total:.1f} %")
    if args.out:
        result = {"mujoco": mujoco.__version__, "disturbed": args.disturb, "successes": good, "total": total}
        name = "results-disturbed.json" if args.disturb else "results.json"
        (args.out / name).write_text(json.dumps({**result, "tasks": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
