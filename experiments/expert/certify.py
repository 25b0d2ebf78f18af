"""Run the expert from the stored initial states of a suite's tasks and write down how it went.

python experiments/expert/certify.py [--suite libero_object] [--states 50] [--disturb] [--out experiments/expert]

With --out it goes on where it was stopped, as `libero tasks certify` does.
"""

import argparse
import json
from pathlib import Path

from libero_env.certify import certify, markdown_table, results
from libero_env.demos_generate import cores
from libero_env.tasks import get_suite

MARKS = ("<!-- results -->", "<!-- end of results -->")


def write_table(folder: Path) -> None:
    """Put the results that there are into the README, between its marks."""
    columns = [("results.json", "as it is"), ("results-disturbed.json", "disturbed")]
    found = [(json.loads((folder / f).read_text()), t) for f, t in columns if (folder / f).exists()]
    head = "| task |" + "".join(f" {title}: success | steps, mean (max) | retries |" for _, title in found)
    lines = [head, "| --- |" + " ---: | ---: | ---: |" * len(found)]
    for name in dict.fromkeys(row["task"] for result, _ in found for row in result["tasks"]):
        cells = [_cells(row) for result, _ in found for row in [_row(result, name)]]
        lines.append(f"| {name.replace('_', ' ')} | {' | '.join(cells)} |")
    totals = [
        f"**{r['successes']}/{r['total']} = {100 * r['successes'] / r['total']:.1f} %** | |" for r, _ in found
    ]
    lines.append(f"| all | {' | '.join(totals)} |")
    readme = folder / "README.md"
    if readme.exists():
        before, rest = readme.read_text().split(MARKS[0])
        after = rest.split(MARKS[1])[1]
        readme.write_text(before + "\n".join([MARKS[0], *lines, MARKS[1]]) + after)


def _row(result: dict, name: str) -> dict | None:
    return next((row for row in result["tasks"] if row["task"] == name), None)


def _cells(row: dict | None) -> str:
    if row is None:
        return " | |"
    return (
        f"{row['successes']}/{row['states']} | {row['mean_length']} ({row['max_length']}) | {row['retries']}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--states", type=int, default=50)
    parser.add_argument("--tasks", type=int, nargs="*")
    parser.add_argument("--disturb", action="store_true", help="disturb the actions as demonstrations do")
    parser.add_argument("--jobs", type=int, default=0, help="processes (default: one for each core)")
    parser.add_argument("--again", action="store_true", help="run what is in the folder too")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    suite = get_suite(args.suite)
    tasks = [task for task in suite.tasks if not args.tasks or task.index in args.tasks]
    found = certify(
        tasks, args.states, jobs=args.jobs or cores(), out=args.out, disturb=args.disturb, again=args.again
    )
    print(markdown_table(found), end="")
    if args.out:
        result = {**results(found, disturb=args.disturb), "complete": len(found) == len(suite)}
        name = "results-disturbed.json" if args.disturb else "results.json"
        (args.out / name).write_text(json.dumps(result, indent=1) + "\n")
        write_table(args.out)


if __name__ == "__main__":
    main()
