"""Put the numbers of the comparisons into the README beside them.

python experiments/algorithms/table.py          # reads SUITE/comparison.json, which `study.py report` writes
"""

import json
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

from study import planned

from lifelong.report.statistics import findings
from lifelong.report.tables import duration, quantity
from lifelong.results.relearning import Savings, read_relearning, savings

HERE = Path(__file__).parent
COLUMNS = {"just_learned": "just learned", "final_success": "final", "fwt": "FWT", "nbt": "NBT", "auc": "AUC"}


def table(heads: list[str], rows: list[list[str]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = ["| " + " | ".join(heads) + " |", "|---|" + "---:|" * (len(heads) - 1)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


def metric(cell: dict) -> str:
    """Mean over seeds, and its interval over seeds and starts; a dash where nothing is defined."""
    if cell["mean"] is None:
        return "–"
    return f"{cell['mean']:.2f} [{cell['low']:.2f}, {cell['high']:.2f}]"


def tables(found: dict) -> Iterator[tuple[str, list[str]]]:
    """Metrics, costs, and pairs that the intervals tell apart; best AUC first."""
    groups = sorted(found["groups"].items(), key=lambda item: -(item[1]["metrics"]["auc"]["mean"] or 0))
    rows = [[label, *(metric(group["metrics"][m]) for m in COLUMNS)] for label, group in groups]
    yield "metrics", table(["algorithm", *COLUMNS.values()], rows)
    rows = [[label, *costs(group["costs"])] for label, group in groups]
    heads = ["algorithm", "training a task", "between tasks", "a step", "trained", "stored", "memory"]
    yield "costs", table(heads, rows)
    yield "pairs", findings(found, {"auc": "AUC"}, most=len(found["differences"]))


def costs(values: dict) -> list[str]:
    """Cells of a row of costs."""
    return [
        duration(values["training_seconds"]),
        duration(values.get("end_task_seconds", 0.0)),
        quantity(values["flops_per_step"], "FLOP"),
        quantity(values["parameters_trained"]),
        quantity(values["stored_bytes"], "B"),
        quantity(values["peak_memory_bytes"], "B"),
    ]


def relearning(benchmark: str) -> list[str]:
    """Lines of the table of relearning; none where nothing was measured."""
    found: dict[str, list[Savings]] = {}
    for run in planned():
        if run.benchmark == benchmark and run.is_done():
            with tempfile.TemporaryDirectory() as scratch:
                measured = savings(read_relearning(run.unpack(Path(scratch))))
            if measured:
                found.setdefault(run.algo, []).extend(measured)
    rows = []
    for algo, tasks in sorted(found.items()):
        again, first = [t.again for t in tasks], [t.first for t in tasks]
        grown = statistics.median(t.final_error / t.learned_error for t in tasks)
        shares = [t.share for t in tasks if t.share is not None]
        saved = f"{statistics.median(shares):.2f}" if shares else "–"
        rows.append([algo, f"{grown:.1f}", _middle(again), _middle(first), saved, str(len(tasks))])
    heads = ["algorithm", "error at the end", "steps again", "steps at first", "savings", "tasks"]
    return table(heads, rows) if rows else []


def _middle(steps: list[int | None]) -> str:
    """The median number of steps, where tasks that were given up count as the largest."""
    middle = statistics.median_high([float("inf") if s is None else s for s in steps])
    return "given up" if middle == float("inf") else f"{middle:.0f}"


def insert(text: str, name: str, lines: list[str]) -> str:
    """Return a text with lines in place of what stands between the marks of a name."""
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, rest = text.split(start)
    return before + start + "\n".join([*lines, end]) + rest.split(end)[1]


def main() -> None:
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    for path in sorted(HERE.glob("*/comparison.json")):
        for name, lines in tables(json.loads(path.read_text(encoding="utf-8"))):
            text = insert(text, f"{path.parent.name}: {name}", lines)
        text = insert(text, f"{path.parent.name}: relearning", relearning(path.parent.name))
    readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
