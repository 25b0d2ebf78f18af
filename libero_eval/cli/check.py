"""The command `libero check`: whether run directories are intact."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add `libero check RUN...`."""
    parser = subparsers.add_parser(
        "check",
        help="whether run directories are intact: checksums, records, what belongs together",
        description="Read everything in run directories and change nothing: the configuration, every line of "
        "results.jsonl, every checkpoint with its checksum, results.json against the records, and evaluations. The "
        "exit status is 1 where something is damaged or lost.",
    )
    parser.add_argument(
        "runs", nargs="+", type=arguments.path, metavar="RUN", help="a run directory, or a folder of them"
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")
    parser.set_defaults(run=run_check)


def run_check(args: argparse.Namespace) -> int:
    """Print what is found; return 1 where there is a fault."""
    from libero_eval.check import examine, find_runs

    runs: list[Path] = [run for path in args.runs for run in find_runs(path)]
    found = [examine(run) for run in dict.fromkeys(runs)]
    if args.json:
        rows = [
            {
                "path": str(one.path),
                "sound": one.sound,
                **one.counts,
                "findings": list(map(asdict, one.findings)),
            }
            for one in found
        ]
        print(json.dumps(rows, indent=1))
    else:
        for one in found:
            counts = ", ".join(f"{count} {name}" for name, count in one.counts.items())
            print(f"{one.path}: {'sound' if one.sound else 'FAULTS'} ({counts})")
            for finding in one.findings:
                print(f"  {finding.level}: {finding.text}")
    return int(not all(one.sound for one in found))
