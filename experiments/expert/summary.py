"""Summarise certificates in the README: a row for each suite, and the tasks with failures.

libero tasks certify libero_spatial libero_object libero_goal libero_10 libero_90 --out experiments/expert/builtin
python experiments/expert/summary.py
"""

import argparse
import json
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path
from statistics import median

HERE = Path(__file__).parent
MARKS = "<!-- {}: results -->", "<!-- {}: end of results -->"


def table(results: dict) -> Iterator[str]:
    """Yield the lines of the summary: a table of the suites, and the tasks with failures."""
    yield "| suite | success | weakest task | steps, median of tasks (longest success) | retries |"
    yield "| --- | ---: | ---: | ---: | ---: |"
    rows = results["tasks"]
    groups = [(k, list(g)) for k, g in groupby(rows, lambda row: row["id"].partition("/")[0])]
    for suite, own in [*groups, ("all", rows)]:
        good, total = sum(r["successes"] for r in own), sum(r["states"] for r in own)
        weakest = min(own, key=lambda r: r["successes"] / r["states"])
        lengths = [r["median_length"] for r in own if r["successes"]]
        yield (
            f"| {suite}, {len(own)} tasks | **{good}/{total} = {100 * good / total:.1f} %** "
            f"| {weakest['id']}: {weakest['successes']}/{weakest['states']} "
            f"| {median(lengths):.0f} ({max(r['max_length'] or 0 for r in own)}) | {sum(r['retries'] for r in own)} |"
        )
    yield ""
    perfect = sum(r["successes"] == r["states"] for r in rows)
    yield f"{perfect} of {len(rows)} tasks are solved from every initial state. The others:"
    yield ""
    for r in sorted(rows, key=lambda r: r["successes"] / r["states"]):
        if r["successes"] < r["states"]:
            yield f"- {r['id']} {r['task'].replace('_', ' ')}: {r['successes']}/{r['states']}"


def main() -> None:
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    readme = HERE / "README.md"
    for name in ("builtin", "builtin-disturbed", "original"):
        folder, _, kind = name.partition("-")
        path = HERE / folder / f"results{'-' + kind if kind else ''}.json"
        if not path.exists():
            continue
        start, end = (mark.format(name) for mark in MARKS)
        before, rest = readme.read_text(encoding="utf-8").split(start)
        after = rest.split(end)[1]
        lines = [start, *table(json.loads(path.read_text(encoding="utf-8"))), end]
        readme.write_text(before + "\n".join(lines) + after, encoding="utf-8")


if __name__ == "__main__":
    main()
