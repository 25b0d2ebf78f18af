"""Series of kill -9 of a training at random moments: every series ends in the bits of an uninterrupted run.

    python experiments/kills/series.py                          # 10 series of 9 kills over six algorithms
    python experiments/kills/series.py --series 2 --kills 3 --algorithms er

A series is one run: it is killed, the same command is given again, and so on; then it may finish. Where a run ends
before it is killed, the series is tried again with other moments. It exits with status 1 where anything differs.
"""

import argparse
import random
import shutil
import sys
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))  # `tests` is no installed package

from tests.harness.kills import assert_same_runs, finish, kill_somewhere, start, written  # noqa: E402

ALGORITHMS = ("er", "ewc", "packnet", "dmpel", "derpp", "lora")
ATTEMPTS = 10  # of one series
BESIDE = "eval.beside=true"  # of the runs that are killed; the whole one measures in its own process


def main() -> int:
    args = parse()
    failed = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder, wholes = Path(args.out or scratch), {}
        folder.mkdir(parents=True, exist_ok=True)
        demos = folder / "demos"
        print("| series | algorithm | kills | while files were written | seconds | ends in the same bits |")
        print("|---|---|---|---|---|---|", flush=True)
        for number, algo in enumerate(islice(cycle(args.algorithms), args.series)):
            if algo not in wholes:
                whole = folder / f"whole_{algo}"
                wholes[algo] = finish(start(algo, whole, demos), whole)
            began = time.monotonic()
            partial, run = kill_series(
                algo, folder / f"killed_{number}", demos, args.kills, args.seed + number
            )
            try:
                assert_same_runs(run, wholes[algo])
                same = "yes"
            except AssertionError as error:
                failed, same = failed + 1, f"**no**: {error}"
            seconds = time.monotonic() - began
            print(
                f"| {number + 1} | {algo} | {args.kills} | {partial} | {seconds:.0f} | {same} |", flush=True
            )
    return int(failed > 0)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description="Kill trainings at random moments and compare what they end in."
    )
    parser.add_argument("--series", type=int, default=10)
    parser.add_argument("--kills", type=int, default=9, help="of each series")
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS)
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments")
    parser.add_argument("--out", help="folder that keeps the runs (default: none does)")
    return parser.parse_args()


def kill_series(algo: str, runs: Path, demos: Path, kills: int, seed: int) -> tuple[int, Path]:
    """Kill a run several times, then let it finish.

    Returns:
        Number of kills that left a file half written, and the run's directory.
    """
    for attempt in range(ATTEMPTS):
        draws, partial = random.Random(f"{seed} {attempt}"), 0
        shutil.rmtree(runs, ignore_errors=True)
        for _ in range(kills):
            if not kill_somewhere(start(algo, runs, demos, BESIDE), runs, draws):
                break  # it had ended
            partial += any(path.suffix == ".part" for path in written(runs))
        else:
            return partial, finish(start(algo, runs, demos, BESIDE), runs)
    raise SystemExit(f"{algo}: the run ends before {kills} kills; make it longer")


if __name__ == "__main__":
    sys.exit(main())
