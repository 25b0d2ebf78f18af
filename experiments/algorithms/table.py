"""Put the numbers of the comparisons into the README beside them.

python experiments/algorithms/table.py          # reads STUDY/comparison.json, which `study.py report` writes
"""

import argparse
import json
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from along import beside_alone, streams
from kept import SPENT, by_bytes, equal_bytes, spent
from reading import by_seed, difference, finished, in_points, measures, paired, table
from study import REFERENCES

from libero_env.text import duration, quantity
from lifelong.results.records import LossRecord, RunEndRecord
from lifelong.stats.intervals import Estimate, holm
from lifelong.stats.methods import paired_difference, welch_difference

HERE = Path(__file__).parent
COLUMNS = {"just_learned": "just learned", "final_success": "final", "nbt": "NBT", "auc": "AUC"}
COMPARED = {"final_success": "final success", "auc": "AUC"}
CHANGED = "2026-11-26T20:40:46"  # when the plan got final success as an outcome, UTC


def metric(cell: dict) -> str:
    """Mean over seeds, and its interval; a dash where nothing is defined."""
    if cell["mean"] is None:
        return "–"
    if cell["low"] is None:
        return f"{cell['mean']:z.2f}"
    return f"{cell['mean']:z.2f} [{cell['low']:z.2f}, {cell['high']:z.2f}]"


def tables(study: str, found: dict) -> Iterator[tuple[str, list[str]]]:
    """Metrics, the planned pairs, and costs; best AUC first."""
    groups = found["groups"]
    order = by_auc({label: group["metrics"] for label, group in groups.items()})
    rows = [
        [
            label,
            str(len(groups[label]["seeds"])),
            "yes" if groups[label]["told_task"] else "no",
            *spent(study, label, groups[label]["costs"]["stored_bytes"]),
            *(metric(groups[label]["metrics"][name]) for name in COLUMNS),
        ]
        for label in order
    ]
    yield "metrics", table(["algorithm", "seeds", "told the task", *SPENT, *COLUMNS.values()], rows)
    for name, title in COMPARED.items():
        yield f"pairs of {title}", pairs(order, found["differences"], name, title)
    training = training_seconds(study)
    rows = [
        [
            *(label, training[label], *costs(groups[label]["costs"])),
            *spent(study, label, groups[label]["costs"]["stored_bytes"])[:-1],
        ]
        for label in order
    ]
    heads = ["algorithm", "training a task", "between tasks", "a step", "trained", "memory", *SPENT[:-1]]
    yield "costs", table(heads, rows)
    yield from shifts(groups, order)


def by_auc(measured: dict[str, dict]) -> list[str]:
    """Labels, best AUC first."""
    return sorted(measured, key=lambda label: -(measured[label]["auc"]["mean"] or 0))


def pairs(labels: list[str], differences: list[dict], name: str, title: str) -> list[str]:
    """A metric of each algorithm less that of each reference, and of the first one with every seed, in points."""
    found = {}
    for pair in differences:
        cell = pair["metrics"][name]
        found[pair["of"], pair["less"]] = cell
        found.setdefault((pair["less"], pair["of"]), _turned(cell))
    references = [label for label in REFERENCES if any(less == label for _, less in found)]
    rows = []
    for label in labels:
        cells = [found.get((label, reference)) for reference in references]
        if any(cell and cell["value"] is not None for cell in cells):
            rows.append(
                [
                    label,
                    *(_difference(cell) for cell in cells),
                    by_seed(cells[0]["by_seed"] if cells[0] else ()),
                ]
            )
    heads = [f"{title} less {reference}" for reference in references]
    return table(["algorithm", *heads, f"less {references[0]}, each seed"], rows)


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


def costs(values: dict) -> list[str]:
    """Cells of a row of costs, behind the time of training."""
    return [
        duration(values.get("end_task_seconds", 0.0)),
        quantity(values["flops_per_step"], "FLOP"),
        quantity(values["parameters_trained"]),
        quantity(values["peak_memory_bytes"], "B"),
    ]


def training_seconds(study: str) -> dict[str, str]:
    """Time of training a task, by algorithm: of each task the fastest epoch of all seeds, as other work ran beside.

    Where all tasks are learned in one stage, it is the time of that stage.
    """
    found: dict[str, dict[int, float]] = {}  # of each task, by algorithm
    for run, results in finished(study):
        epochs: dict[int, list[float]] = {}
        for record in results.of(LossRecord):
            epochs.setdefault(record.task, []).append(record.seconds)
        seconds = found.setdefault(run.method, {})
        for task, times in epochs.items():
            seconds[task] = min(seconds.get(task, float("inf")), len(times) * min(times))
    return {
        algo: duration(statistics.mean(tasks.values())) + (" (all tasks)" if len(tasks) == 1 else "")
        for algo, tasks in found.items()
    }


def shifts(groups: dict[str, dict], order: list[str]) -> Iterator[tuple[str, list[str]]]:
    """Final success under each held-out shift, and what the shift costs, alone and beside the first reference."""
    for shift in dict.fromkeys(shift for group in groups.values() for shift in group["shifts"]):
        rows = []
        for label in (label for label in order if shift in groups[label]["shifts"]):
            found = groups[label]["shifts"][shift]
            less = found["lost_less"].get(REFERENCES[0])
            rows.append(
                [
                    label,
                    str(found["runs"]),
                    "yes" if groups[label]["told_task"] else "no",
                    f"{found['final']:.2f}",
                    f"{found['final_shifted']:.2f}",
                    in_points(Estimate(**found["lost"])),
                    in_points(Estimate(**less)) if less else "–",
                ]
            )
        heads = ["algorithm", "seeds", "told the task", "final", f"under `{shift}`", "lost"]
        yield f"under {shift}", table([*heads, f"lost, less {REFERENCES[0]}'s"], rows)


def both_outcomes(differences: list[dict]) -> Iterator[tuple[str, list[str]]]:
    """Planned pairs of what keeps anything by both outcomes, each p after Holm over its metric, and over both."""
    tested = [
        (pair["of"], pair["less"], name, pair["metrics"][name])
        for name in COMPARED
        for pair in differences
        if pair["metrics"][name]["p_value"] is not None
    ]
    jointly = {
        key: (cell, p)
        for (*key, cell), p in zip(tested, holm([cell["p_value"] for *_, cell in tested]), strict=True)
        for key in [tuple(key)]
    }
    first = {run.seed for run, results in finished("goal") if results.of(RunEndRecord)[0].finished < CHANGED}
    rows = []
    for of, less, _ in (key for key in jointly if key[2] == "final_success"):
        if {of, less} & {"sequential", "ewc", "multitask"}:
            continue
        row = [f"{of} less {less}"]
        for name in COMPARED:
            cell, joint = jointly[of, less, name]
            row += [f"{100 * cell['value']:+z.1f}", f"{cell['adjusted']:.2g}", f"{joint:.2g}"]
        found = measures("goal", "final_success")
        later = [found[of][seed] - found[less][seed] for seed in found[of] if seed not in first]
        rows.append([*row, by_seed(later), f"{paired_difference(np.array(later)).p_value:.2g}"])
    heads = ["pair", *(f"{title}{what}" for title in COMPARED.values() for what in _CORRECTED)]
    heads += [f"final success, seeds {', '.join(str(s) for s in range(1, 6) if s not in first)}", "p"]
    yield "goal: both outcomes", table(heads, rows)


_CORRECTED = ("", ", p (Holm)", ", p (Holm over both)")


def together(studies: tuple[str, str]) -> Iterator[tuple[str, list[str]]]:
    """A metric of each algorithm less that of the first reference in two streams, and the mean of both effects.

    The interval of the mean is Welch's: of two independent means with deviations of their own.
    """
    for name, title in COMPARED.items():
        found = [measures(study, name) for study in studies]
        rows = []
        for label in (label for label in found[1] if label != REFERENCES[0] and label in found[0]):
            effects = [np.array(paired(values[label], values[REFERENCES[0]])) for values in found]
            mean = welch_difference(effects[0] / 2, -effects[1] / 2).estimate
            rows.append([label, *map(difference, effects), in_points(mean)])
        if rows:
            heads = [f"less {REFERENCES[0]}, `{study}`" for study in studies]
            yield f"together: {title}", table(["algorithm", *heads, "mean of both"], rows)


def insert(text: str, name: str, lines: list[str]) -> str:
    """Return a text with lines in place of what stands between the marks of a name."""
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    before, rest = text.split(start)
    return before + start + "\n".join([*lines, end]) + rest.split(end)[1]


def written(text: str) -> str:
    """Return a text with all tables that it has the marks of."""
    found = dict[str, list[str]]()
    for path in sorted(HERE.glob("*/comparison.json")):
        content = json.loads(path.read_text(encoding="utf-8"))
        for name, lines in tables(path.parent.name, content):
            found[f"{path.parent.name}: {name}"] = lines
        if path.parent.name == "goal":
            found |= dict(both_outcomes(content["differences"]))
    found |= {**dict(by_bytes()), **dict(equal_bytes()), **dict(together(("goal", "ten_demonstrations")))}
    found["goal: beside single_task"] = beside_alone(streams("goal"))
    for name, lines in found.items():
        if f"<!-- {name} -->" in text:  # of costs only the costs
            text = insert(text, name, lines)
    return text


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; 1 where the README has other numbers"
    )
    check, readme = parser.parse_args().check, HERE / "README.md"
    text = readme.read_text(encoding="utf-8")
    new = written(text)
    if not check:
        readme.write_text(new, encoding="utf-8")
    return int(check and new != text)


if __name__ == "__main__":
    sys.exit(main())
