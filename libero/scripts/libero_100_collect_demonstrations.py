"""Record demonstrations of a task of LIBERO-100 by hand, by its number."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from libero.libero.benchmark import get_benchmark
from libero.scripts.collect_demonstration import collect, make_parser
from libero.scripts.command import run
from libero_env.errors import LiberoError


def main(argv: Sequence[str] | None = None) -> int:
    """The script."""
    parser = make_parser("libero_100_collect_demonstrations.py", __doc__)
    parser.add_argument(
        "--task-id", type=int, required=True, help="0 to 99; the last ten are those of libero_10"
    )
    return run(parser, collect_numbered, argv)


def collect_numbered(args: argparse.Namespace) -> int:
    """See `collect`.

    Raises:
        LiberoError: no such task.
    """
    suite = get_benchmark("libero_100")()
    if args.task_id not in range(suite.n_tasks):
        raise LiberoError(f"--task-id {args.task_id}: LIBERO-100 has 0 to {suite.n_tasks - 1}")
    args.bddl_file = Path(suite.get_task_bddl_file_path(args.task_id))
    return collect(args)


if __name__ == "__main__":
    raise SystemExit(main())
