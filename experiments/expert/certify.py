"""Run the expert from all 50 initial states of each task and write down how it went.

python experiments/expert/certify.py [--suite libero_object] [--states 50] [--disturb] [--out experiments/expert]
"""

import argparse
import json
import time
from pathlib import Path

import mujoco
import numpy as np

from libero_env.demos_studio import GENERATOR
from libero_env.expert import Disturbance, Expert, Shapes
from libero_env.expert.driver import run_experts
from libero_env.tasks import get_suite
from libero_env.vector import BatchEnv

MARKS = ("<!-- results -->", "<!-- end of results -->")


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


def write_table(folder: Path) -> None:
    """Put the results that there are into the README, between its marks."""
    columns = [("results.json", "as it is"), ("results-disturbed.json", "disturbed")]
    found = [(json.loads((folder / f).read_text()), t) for f, t in columns if (folder / f).exists()]
    head = "| task |" + "".join(f" {title}: success | steps, mean (max) | retries |" for _, title in found)
    lines = [head, "| --- |" + " ---: | ---: | ---: |" * len(found)]
    for rows in zip(*(result["tasks"] for result, _ in found), strict=True):
        cells = [
            f"{r['successes']}/{r['states']} | {r['mean_length']} ({r['max_length']}) | {r['retries']}"
            for r in rows
        ]
        lines.append(f"| {rows[0]['task'].replace('_', ' ')} | {' | '.join(cells)} |")
    totals = [
        f"**{r['successes']}/{r['total']} = {100 * r['successes'] / r['total']:.1f} %** | |" for r, _ in found
    ]
    lines.append(f"| all | {' | '.join(totals)} |")
    readme = folder / "README.md"
    if readme.exists():
        before, rest = readme.read_text().split(MARKS[0])
        after = rest.split(MARKS[1])[1]
        readme.write_text(before + "\n".join([MARKS[0], *lines, MARKS[1]]) + after)


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
        args.out.mkdir(parents=True, exist_ok=True)
        result = {"mujoco": mujoco.__version__, "generator": GENERATOR, "disturbed": args.disturb}
        result |= {"complete": len(rows) == len(get_suite(args.suite)), "successes": good, "total": total}
        name = "results-disturbed.json" if args.disturb else "results.json"
        (args.out / name).write_text(json.dumps({**result, "tasks": rows}, indent=1) + "\n")
        write_table(args.out)


if __name__ == "__main__":
    main()
