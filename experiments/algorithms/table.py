"""Put the numbers of the comparisons into the README beside them.

python experiments/algorithms/table.py          # reads STUDY/comparison.json, which `study.py report` writes
"""

import argparse
import json
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

from study import REFERENCES, Planned, planned

from libero_env.text import duration, quantity
from lifelong.results.log import ResultLog
from lifelong.results.records import LossRecord
from lifelong.results.relearning import Savings, by_measure, read_relearning, savings

HERE = Path(__file__).parent
# the first head of every table: the runs of a study were made in two versions of models and demonstrations
HEADS = {
    "libero_object": "algorithm (seeds 1, 2: older models and demonstrations than 3 to 5)",
    "libero_goal": "algorithm (seed 1, and er's seed 2: older models and demonstrations than the others)",
    "pretrained6": "algorithm (seed 1, and iscil's seed 2: older models and demonstrations than the others)",
}
COLUMNS = {"just_learned": "just learned", "final_success": "final", "fwt": "FWT", "nbt": "NBT", "auc": "AUC"}


def table(heads: list[str], rows: list[list[str]], align: str = "---:|") -> list[str]:
    """The lines of a Markdown table, whose columns but the first are aligned as given."""
    lines = ["| " + " | ".join(heads) + " |", "|---|" + align * (len(heads) - 1)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]


def metric(cell: dict) -> str:
    """Mean over seeds, and its interval; a dash where nothing is defined."""
    if cell["mean"] is None:
        return "–"
    if cell["low"] is None:
        return f"{cell['mean']:z.2f}"
    return f"{cell['mean']:z.2f} [{cell['low']:z.2f}, {cell['high']:z.2f}]"


def tables(study: str, found: dict) -> Iterator[tuple[str, list[str]]]:
    """Metrics, costs, and the planned pairs; best AUC first."""
    head, measured = HEADS[study], {label: group["metrics"] for label, group in found["groups"].items()}
    yield "metrics", metrics(head, measured)
    yield "pairs", pairs(head, by_auc(measured), found["differences"])
    if later := found["after_base_stage"]:
        yield "later tasks", metrics(head, later["metrics"])
        yield "pairs of later tasks", pairs(head, by_auc(later["metrics"]), later["differences"])
    training = training_seconds(study)
    rows = [[label, training[label], *costs(found["groups"][label]["costs"])] for label in by_auc(measured)]
    heads = ["algorithm", "training a task", "between tasks", "a step", "trained", "stored", "memory"]
    yield "costs", table(heads, rows)


def metrics(head: str, measured: dict[str, dict]) -> list[str]:
    """Lines of the table of metrics, by label."""
    rows = [[label, *(metric(measured[label][name]) for name in COLUMNS)] for label in by_auc(measured)]
    return table([head, *COLUMNS.values()], rows)


def by_auc(measured: dict[str, dict]) -> list[str]:
    """Labels, best AUC first."""
    return sorted(measured, key=lambda label: -(measured[label]["auc"]["mean"] or 0))


def pairs(head: str, labels: list[str], differences: list[dict]) -> list[str]:
    """Each algorithm's AUC less that of each reference, and of the first one with every seed, in points."""
    found = {}
    for pair in differences:
        auc = pair["metrics"]["auc"]
        found[pair["of"], pair["less"]] = auc
        found.setdefault((pair["less"], pair["of"]), _turned(auc))
    references = [name for name in REFERENCES if any(less == name for _, less in found)]
    rows = []
    for label in labels:
        cells = [found.get((label, name)) for name in references]
        if any(cell and cell["value"] is not None for cell in cells):
            rows.append([label, *(_difference(cell) for cell in cells), _by_seed(cells[0])])
    heads = [head, *(f"AUC less {name}" for name in references), f"less {references[0]}, each seed"]
    return table(heads, rows)


def _turned(cell: dict) -> dict:
    """The same pair the other way round."""
    ends = {"low": cell["high"], "high": cell["low"]}
    turned = {k: None if v is None else -v for k, v in {"value": cell["value"], **ends}.items()}
    return {**cell, **turned, "by_seed": [-v for v in cell["by_seed"]]}


def _difference(cell: dict | None) -> str:
    """A difference in points with its interval; bold if significant, with ≈ if equivalent, else seeds needed."""
    if cell is None or cell["value"] is None:
        return "–"
    text = f"{100 * cell['value']:+.1f}"
    text = f"**{text}**" if cell["significant"] else text
    if cell["low"] is not None:
        text += f" [{100 * cell['low']:z.1f}, {100 * cell['high']:z.1f}]"
    text += " ≈" if cell["equivalent"] else ""
    return text + (f" ({cell['seeds']})" if cell["seeds"] and not cell["significant"] else "")


def _by_seed(cell: dict | None) -> str:
    return ", ".join(f"{100 * v:+.1f}" for v in cell["by_seed"]) if cell else "–"


def costs(values: dict) -> list[str]:
    """Cells of a row of costs, behind the time of training."""
    return [
        duration(values.get("end_task_seconds", 0.0)),
        quantity(values["flops_per_step"], "FLOP"),
        quantity(values["parameters_trained"]),
        quantity(values["stored_bytes"], "B"),
        quantity(values["peak_memory_bytes"], "B"),
    ]


def training_seconds(study: str) -> dict[str, str]:
    """Time of training a task, by algorithm: of each task the fastest epoch of all seeds, as other work ran beside.

    Where all tasks are learned in one stage, it is the time of that stage.
    """
    found: dict[str, dict[int, float]] = {}  # of each task, by algorithm
    for run, folder in finished(study):
        epochs: dict[int, list[float]] = {}
        for record in ResultLog(folder / "results.jsonl").read().of(LossRecord):
            epochs.setdefault(record.task, []).append(record.seconds)
        seconds = found.setdefault(run.method, {})
        for task, times in epochs.items():
            seconds[task] = min(seconds.get(task, float("inf")), len(times) * min(times))
    return {
        algo: duration(statistics.mean(tasks.values())) + (" (all tasks)" if len(tasks) == 1 else "")
        for algo, tasks in found.items()
    }


def finished(study: str) -> Iterator[tuple[Planned, Path]]:
    """Yield the finished runs of a study, each with a folder of its records."""
    for run in planned():
        if run.study.name == study and run.is_done():
            with tempfile.TemporaryDirectory() as scratch:
                yield run, run.unpack(Path(scratch))


def relearning(study: str) -> Iterator[tuple[str, list[str]]]:
    """Tables of relearning, by error and by success; without lines where nothing was measured."""
    found: dict[bool, dict[str, list[Savings]]] = {False: {}, True: {}}
    for run, folder in finished(study):
        for part in by_measure(read_relearning(folder)):
            found[bool(part[0].episodes)].setdefault(run.method, []).extend(savings(part))
    steps = ["steps again", "steps at first", "savings", "tasks"]
    rows = [[algo, _growth(tasks), *_steps(tasks)] for algo, tasks in sorted(found[False].items())]
    yield "relearning", table(["algorithm", "error at the end", *steps], rows) if rows else []
    rows = [[algo, *_success(tasks), *_steps(tasks)] for algo, tasks in sorted(found[True].items())]
    heads = ["algorithm", "just learned", "at the end", *steps]
    yield "relearning by success", table(heads, rows) if rows else []


def _growth(tasks: list[Savings]) -> str:
    return f"{statistics.median(t.final_error / t.learned_error for t in tasks):.1f}"


def _success(tasks: list[Savings]) -> list[str]:
    means = (
        statistics.mean(1 - getattr(t, name) for t in tasks) for name in ("learned_error", "final_error")
    )
    return [f"{mean:.2f}" for mean in means]


def _steps(tasks: list[Savings]) -> list[str]:
    shares = [t.share for t in tasks if t.share is not None]
    saved = f"{statistics.median(shares):.2f}" if shares else "–"
    return [_middle([t.again for t in tasks]), _middle([t.first for t in tasks]), saved, str(len(tasks))]


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
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    readme = HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    for path in sorted(HERE.glob("*/comparison.json")):
        for name, lines in tables(path.parent.name, json.loads(path.read_text(encoding="utf-8"))):
            text = insert(text, f"{path.parent.name}: {name}", lines)
        for name, lines in relearning(path.parent.name):
            text = insert(text, f"{path.parent.name}: {name}", lines)
    readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
