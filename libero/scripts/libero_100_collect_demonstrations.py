"""Record demonstrations of a task of LIBERO-100 by hand; the task is given by its number."""

import argparse
from pathlib import Path

from libero.libero.benchmark import get_benchmark
from libero.scripts.collect_demonstration import OPTIONS, collect
from libero.scripts.command import option, script
from libero_env.errors import LiberoError


@script(*OPTIONS, option("--task-id", type=int, required=True, help="0 to 99; 90 to 99 are libero_10"))
def main(args: argparse.Namespace) -> int:
    """Record the demonstrations, see `collect_demonstration.collect`; raise a LiberoError if there is no such task."""
    suite = get_benchmark("libero_100")()
    if args.task_id not in range(suite.n_tasks):
        raise LiberoError(f"--task-id {args.task_id}: LIBERO-100 has 0 to {suite.n_tasks - 1}")
    args.bddl_file = Path(suite.get_task_bddl_file_path(args.task_id))
    return collect(args)
