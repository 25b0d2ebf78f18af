"""How long commands take that do nothing: help, lists, refused words. Processor time, before and after a change.

    python experiments/benchmarks/start_up.py df545aa9 HEAD --rounds 3

Each command line is a process of its own in a checkout of its commit, without the checkout's own configuration, with
byte code that a round before has written. The least of the rounds is printed, user and system time, [s], one line for
commands of one kind, with the slowest first.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from libero_cli.main import ALL

ROOT = Path(__file__).parents[2]
LISTS = ("--version", "tasks list", "perturb list", "protocols list", "power")
REFUSED = {  # kind -> words that name nothing
    "a task": (
        *("tasks list libero_objet", "tasks show libero_goal/12", "tasks certify libero-goal"),
        *(
            "tasks preview libero_goa",
            "tasks lint LIBERO_GOAL",
            "tasks init-states libero_goa",
            "teleop libero_goa",
        ),
        *("perturb certify libero_gola", "demos generate --task libero_goa", "view libero_goa"),
        *("eval expert --suite libero_goa", "robustness expert --suite libero_gaol"),
    ),
    "a policy, protocol, kind or clock": (
        *(
            "eval nowhere",
            "eval my_polcy:make --suite libero_goal",
            "eval localhost:8000 --suite libero_goal",
        ),
        *(
            "eval expert --suite libero_goal --protocol opnpi",
            "eval expert --suite libero_goal --perturb camra=1",
        ),
        *(
            "eval expert --suite libero_goal --clock late=1",
            "eval expert --suite libero_goal --despite mujoco",
        ),
        *(
            "robustness nowhere",
            "robustness expert --suite libero_goal --kinds camra",
            "protocols show opnpi",
        ),
        *("protocols diff libero opnpi", "perturb show libero_goal/3 --perturb camra=1"),
        "perturb certify libero_goal --kinds camra",
    ),
    "a run, a result, a number": (
        *("serve nowhere", "relearn nowhere", "diagnose nowhere", "saliency nowhere", "check nowhere"),
        *(
            "report nowhere",
            "board nowhere",
            "compare nowhere nothing",
            "power nowhere nothing",
            "power --base 2",
        ),
        *("eval expert --suite libero_goal --episodes 0", "sweep status nowhere", "evla"),
    ),
    "a key of the configuration": (
        *("train algo=ecw", "train -m algo=er,ecw", "train lr=3", "train benchmark=libero_goa"),
        *("train --cfg nothing", "tune algo=ecw", "tune nothing=1"),
    ),
    "a value of the configuration": (
        *("train train.epochs=abc", "train data.demos=-1", "train eval.episodes=1.5", "train seed=x"),
        "train eval.shift=lihgt=1",
    ),
}
VALUES = ("train algo=ewc algo.strength=abc", "train --cfg job")  # which load what learns


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("commits", nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    kinds = {"`--help` of every command": ["--help", *(f"{name} --help" for name in ALL)]}
    kinds |= {f"`{line}`": [line] for line in LISTS}
    kinds |= {f"refused: {kind}": list(lines) for kind, lines in REFUSED.items()}
    kinds |= {f"`{line}`": [line] for line in VALUES}
    with tempfile.TemporaryDirectory() as folder:
        places = [checkout(commit, Path(folder)) for commit in args.commits]
        times = {
            (k, line): [seconds(line, place) for place in places] for k, v in kinds.items() for line in v
        }
        for _ in range(args.rounds):
            for key, before in times.items():
                times[key] = [min(t, seconds(key[1], place)) for t, place in zip(before, places, strict=True)]
        for place in places:
            subprocess.run(["git", "-C", str(ROOT), "worktree", "remove", "--force", str(place)], check=True)
    print(f"| | {' | '.join(args.commits)} |\n|---|{'---:|' * len(args.commits)}")
    for kind, lines in kinds.items():
        columns = list(zip(*(times[kind, line] for line in lines), strict=True))
        print(f"| {kind} | {' | '.join(range_text(column) for column in columns)} |")
    for (_, line), row in sorted(times.items(), key=lambda one: -one[1][-1])[:8]:
        print(f"slowest: {line}: {', '.join(f'{value:.2f}' for value in row)}")


def range_text(values: tuple[float, ...]) -> str:
    low, high = min(values), max(values)
    return f"{high:.2f}" if len(values) == 1 else f"{low:.2f} to {high:.2f}"


def checkout(commit: str, folder: Path) -> Path:
    command = ["git", "-C", str(ROOT), "worktree", "add", "--quiet", "--detach", str(folder / commit), commit]
    subprocess.run(command, check=True)
    return folder / commit


def seconds(line: str, place: Path) -> float:
    """Return the processor time of a command line, [s]."""
    module = "libero_cli" if (place / "libero_cli").is_dir() else "libero_env.cli"  # as it was
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", module, *line.split()]
    subprocess.run(command, cwd=place, env=os.environ | {"PYTHONPATH": str(place)}, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
