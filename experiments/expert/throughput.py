"""Measure demonstrations per hour, with and without images, on all cores or the given number of processes.

python experiments/expert/throughput.py [--suites libero_object libero_10] [--n 10] [--size 128] [--workers 2]

Each figure is one recording into an empty folder: starting the processes, compiling the scenes and writing the files
included. Both kinds take turns, and the best of `--rounds` counts.
"""

import argparse
import tempfile
import time
from pathlib import Path

from libero_env.demos.config import DemoConfig
from libero_env.demos.generate import RecordingJob, make_demos
from libero_env.parallel import cpu_count
from libero_env.tasks import get_suite


def seconds(suite: str, n: int, size: int, workers: int, images: bool) -> float:
    """Return the wall time of recording n demonstrations of each task, [s]."""
    with tempfile.TemporaryDirectory() as folder:
        rendered = {} if images else {"cameras": (), "modalities": ()}
        configs = [DemoConfig(task, (size, size), **rendered) for task in get_suite(suite).tasks]
        jobs = [RecordingJob(config, Path(folder) / f"{config.task.name}_demo.hdf5") for config in configs]
        started = time.perf_counter()
        reports = make_demos(jobs, n, workers=workers)
        took = time.perf_counter() - started
    for path, report in reports.items():
        if report.error:
            raise SystemExit(f"{path.name}: {report.error}")
    return took


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--suites", nargs="+", default=["libero_object", "libero_10"])
    parser.add_argument("--n", type=int, default=10, help="demonstrations of each task")
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=2)
    args = parser.parse_args()
    workers = args.workers or cpu_count()
    print(
        f"| suite, {workers} processes | without images, demos/h | two {args.size}x{args.size} views | ratio |"
    )
    print("| --- | ---: | ---: | ---: |")
    for suite in args.suites:
        best = {False: float("inf"), True: float("inf")}
        for _ in range(args.rounds):
            for images in best:
                best[images] = min(best[images], seconds(suite, args.n, args.size, workers, images))
        number = args.n * len(get_suite(suite).tasks)
        rates = [3600 * number / best[images] for images in best]
        print(f"| {suite} | {rates[0]:.0f} | {rates[1]:.0f} | {best[True] / best[False]:.2f} |", flush=True)


if __name__ == "__main__":
    main()
