"""Check that every task of the benchmark has a task file that can be read, and its initial states."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from libero.libero import get_libero_path
from libero.libero.benchmark import Benchmark, get_benchmark, libero_suites
from libero.scripts.command import option, script
from libero_env.errors import LiberoError
from libero_env.init_states.pickles import read_states
from libero_env.tasks import bddl


@script(option("suites", nargs="*", default=libero_suites, help="names of suites (default: all)"))
def main(args: argparse.Namespace) -> int:
    """Print one line for each suite and each fault; return 1 where there is a fault."""
    bad = 0
    for name in args.suites:
        suite = get_benchmark(name)()
        found = list(faults(suite))
        for line in found:
            print(f"FAIL  {line}")
        print(f"{name}: {suite.n_tasks} tasks, {len(found)} faults")
        bad += len(found)
    return int(bad > 0)


def faults(suite: Benchmark) -> Iterator[str]:
    """Yield what is wrong with the files of a suite."""
    states = Path(get_libero_path("init_states"))
    for i, task in enumerate(tqdm(suite.tasks, desc=suite.name, disable=None)):
        try:
            bddl.read(suite.get_task_bddl_file_path(i))
            rows = read_states(states / task.problem_folder / task.init_states_file)
        except (LiberoError, OSError) as error:
            yield str(error)
            continue
        if rows.ndim != 2 or len(rows) < 50:
            yield f"{task.init_states_file}: {rows.shape}; expected at least 50 states"
