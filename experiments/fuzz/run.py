"""The long form of the property tests: thousands of hostile inputs for each surface, counted.

    make fuzz                                      # or: python experiments/fuzz/run.py
    python experiments/fuzz/run.py --seed 7 -k hdf5

It exits with pytest's status; a run of all surfaces without a fault replaces the table in README.md beside this file.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = Path(__file__).with_name("README.md")
START, END = "<!-- table: begin -->", "<!-- table: end -->"
COLUMNS = ("tried", "accepted", "refused", "faults")


def main() -> int:
    args = parse()
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        status = run_tests(args, folder)
        counts = read_counts(Path(folder))
    text = table(counts, time.monotonic() - began, args.seed)
    print(text)
    if status == 0 and not args.keyword:
        before, _, rest = README.read_text(encoding="utf-8").partition(START)
        after = rest.partition(END)[2]
        README.write_text(f"{before}{START}\n{text}\n{END}{after}", encoding="utf-8")
    return status


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Run the property tests with thousands of inputs each.")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the inputs (default: 0, always the same)"
    )
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="test processes")
    parser.add_argument("-k", dest="keyword", help="only tests that match, as for pytest")
    return parser.parse_args()


def run_tests(args: argparse.Namespace, folder: str) -> int:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "tests/fuzz",
        "-n",
        str(args.workers),
        "--dist=worksteal",
    ]
    command += [f"--hypothesis-seed={args.seed}"] if args.seed else []
    command += ["-k", args.keyword] if args.keyword else []
    variables = {"LIBERO_FUZZ": folder, "LIBERO_FUZZ_SEED": str(args.seed), "OMP_NUM_THREADS": "1"}
    return subprocess.run(command, cwd=ROOT, env=os.environ | variables, check=False).returncode


def read_counts(folder: Path) -> dict[str, Counter[str]]:
    """Return what each surface's inputs came to, over all test processes."""
    total: dict[str, Counter[str]] = {}
    for file in sorted(folder.glob("*.json")):
        for surface, counts in json.loads(file.read_text()).items():
            total.setdefault(surface, Counter()).update(counts)
    return dict(sorted(total.items()))


def table(counts: dict[str, Counter[str]], seconds: float, seed: int) -> str:
    everything = sum(counts.values(), Counter())
    rows = [*counts.items(), ("**all**", everything)]
    lines = ["| surface | tried | read | refused in one line | faults |", "|---|---|---|---|---|"]
    lines += [f"| {name} | {' | '.join(f'{found[c]:,}' for c in COLUMNS)} |" for name, found in rows]
    day = datetime.now(UTC).date()
    lines += ["", f"{day}, seed {seed}, {os.cpu_count()} cores, {seconds / 60:.0f} minutes."]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
