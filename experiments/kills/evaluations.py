"""Processes that share an evaluation are killed at random moments: the result is that of one process, to the bit.

    python experiments/kills/evaluations.py                                  # 20 kills of one of three processes
    python experiments/kills/evaluations.py --policy RUN_DIR --suite libero_object/0 libero_object/1
    python experiments/kills/evaluations.py --event object=0.5@step8 light=1@25% --clock latency=lognormal:120/0.5ms

It exits with status 1 where an episode, a bit of an action, or a unit differs.
"""

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
HERE = Path(__file__).parent
START_UP = 0.2  # share of the kills that do not wait until the process runs a unit


class Wandering:
    """Actions that depend on every pixel and every joint, so that no bit of the past is lost."""

    cameras, camera_size, observations = ("agentview",), (64, 64), ("rgb", "proprioception")

    def reset(self, instruction, num_envs):
        self.weights = np.random.default_rng(len(instruction)).normal(size=(7, 16 + 7))

    def predict(self, observations):
        images = observations["agentview_rgb"].astype(np.float64) / 255
        cells = images.reshape(len(images), 4, 16, 4, 16, 3).mean((2, 4, 5)).reshape(len(images), 16)
        features = np.concatenate([cells, observations["joint_states"]], axis=1)
        return np.tanh(3 * features @ self.weights.T)


def make():
    return Wandering()


def main() -> int:
    args = parse()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(args.out or folder)
        started = time.monotonic()
        assert start(args, out / "one").wait() == 0, log(out / "one")
        alone = time.monotonic() - started
        kills = kill_and_finish(args, out / "shared")
        one, shared = (json.loads((out / name / "eval.json").read_text()) for name in ("one", "shared"))
        times = one.pop("times"), shared.pop("times")
        different = [key for key in one if one[key] != shared[key]]
        units = finished(out / "shared")
        episodes = sum(len(task["init_states"]) for task in shared["tasks"])
        print(
            f"kills: {sum(kills.values())} ({', '.join(f'{n} {when}' for when, n in sorted(kills.items()))})"
        )
        print(f"units: {units}, episodes: {episodes}, processes that finished units: {times[1]['processes']}")
        print(
            f"seconds: one process {alone:.0f}, {args.workers} killed ones {time.monotonic() - started - alone:.0f}"
        )
        print(f"actions of one process: {one['actions']}\nactions of the others:  {shared['actions']}")
        left = [p for p in (out / "shared").rglob("*") if p.parent.name == "claims" or p.suffix == ".part"]
        print(
            f"different: {different or 'nothing but times'}; left behind: {[p.name for p in left] or 'nothing'}"
        )
        return int(bool(different) or units != finished(out / "one"))


def kill_and_finish(args: argparse.Namespace, out: Path) -> Counter[str]:
    """Kill one of the processes after the other; return how many were killed in which state."""
    draws, kills = random.Random(args.seed), Counter()
    units = len(args.suite) * -(-args.episodes // args.unit_starts)
    processes = [start(args, out) for _ in range(args.workers)]
    while sum(kills.values()) < args.kills:
        starting = draws.random() < START_UP
        done = min(finished(out) + draws.choice((0, 0, 1, 2)), units - args.workers)
        while not starting and (finished(out) < done or not holders(out) & {p.pid for p in processes}):
            time.sleep(0.05)
            assert any(process.poll() is None for process in processes), f"all have ended\n{log(out)}"
        working = [i for i, process in enumerate(processes) if process.pid in holders(out)]
        chosen = draws.choice(working) if working and not starting else draws.randrange(args.workers)
        time.sleep(draws.uniform(0, args.pause))
        state = "while it ran a unit" if processes[chosen].pid in holders(out) else "at another moment"
        processes[chosen].kill()
        assert processes[chosen].wait() == -9, f"it ended before it could be killed\n{log(out)}"
        kills[state] += 1
        processes[chosen] = start(args, out)
    for process in processes:
        assert process.wait() == 0, log(out)
    return kills


def holders(out: Path) -> set[int]:
    """Return the processes that hold a unit."""
    found = set()
    for path in (out / "claims").glob("*.txt"):
        try:
            found.add(int(path.read_text().rpartition(":")[2]))
        except (OSError, ValueError):
            continue  # it was given back, or is being written
    return found


def finished(out: Path) -> int:
    """Return the number of units that are done."""
    return len(list((out / "units").glob("*.json")))


def start(args: argparse.Namespace, out: Path) -> subprocess.Popen:
    command = [
        sys.executable,
        "-m",
        "libero_cli",
        "eval",
        args.policy,
        "--suite",
        *args.suite,
        "--out",
        out,
    ]
    command += ["--episodes", args.episodes, "--unit-starts", args.unit_starts, "--threads", 1]
    command += ["--horizon", args.horizon]
    command += ["--device", "cpu"] if Path(args.policy).is_dir() else []
    command += ["--clock", args.clock] if args.clock else []
    command += ["--event", *args.event] if args.event else []
    paths = [str(HERE), str(ROOT), os.environ.get("PYTHONPATH", "")]
    out.mkdir(parents=True, exist_ok=True)
    with open(out.with_suffix(".log"), "a") as log_file:
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        return subprocess.Popen(map(str, command), env=environment, stdout=log_file, stderr=log_file)


def log(out: Path) -> str:
    return out.with_suffix(".log").read_text()[-3000:]


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--workers", type=int, default=3)
    parser.add_argument("--policy", default="evaluations:make")
    parser.add_argument("--suite", nargs="+", default=["libero_goal/3", "libero_object/0"])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--unit-starts", type=int, default=3)
    parser.add_argument("--horizon", type=int, default=60)
    parser.add_argument("--event", nargs="+", help="as of libero eval")
    parser.add_argument("--clock", help="as of libero eval")
    parser.add_argument("--pause", type=float, default=0.5, help="longest pause before a kill, s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder that is kept")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
