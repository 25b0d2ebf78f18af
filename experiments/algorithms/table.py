"""Put the numbers of the comparisons into the README beside them.

python experiments/algorithms/table.py          # reads STUDY/comparison.json, which `study.py report` writes
"""

import argparse
import functools
import json
import math
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from study import REFERENCES, Planned, planned

from libero_env.text import duration, quantity
from lifelong.results.log import ResultLog
from lifelong.results.records import LossRecord
from lifelong.stats.intervals import Estimate, holm
from lifelong.stats.methods import paired_difference, welch_difference
from lifelong.stats.metrics import metric_values

HERE = Path(__file__).parent
COLUMNS = {"just_learned": "just learned", "final_success": "final", "nbt": "NBT", "auc": "AUC"}
COMPARED = {"final_success": "final success", "auc": "AUC"}


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
    """Metrics, the planned pairs, and costs; best AUC first."""
    groups = found["groups"]
    order = by_auc({label: group["metrics"] for label, group in groups.items()})
    rows = [
        [
            label,
            str(len(groups[label]["seeds"])),
            "yes" if groups[label]["told_task"] else "no",
            *(metric(groups[label]["metrics"][name]) for name in COLUMNS),
        ]
        for label in order
    ]
    yield "metrics", table(["algorithm", "seeds", "told the task", *COLUMNS.values()], rows)
    for name, title in COMPARED.items():
        yield f"pairs of {title}", pairs(order, found["differences"], name, title)
    training = training_seconds(study)
    rows = [[label, training[label], *costs(groups[label]["costs"])] for label in order]
    heads = ["algorithm", "training a task", "between tasks", "a step", "trained", "stored", "memory"]
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
            rows.append([label, *(_difference(cell) for cell in cells), _by_seed(cells[0])])
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
                    _estimate(Estimate(**found["lost"])),
                    _estimate(Estimate(**less)) if less else "–",
                ]
            )
        heads = ["algorithm", "seeds", "told the task", "final", f"under `{shift}`", "lost"]
        yield f"under {shift}", table([*heads, f"lost, less {REFERENCES[0]}'s"], rows)


def by_bytes() -> Iterator[tuple[str, list[str]]]:
    """Final success of replay with each memory, compressed and not, in the same bytes; less that with 247 MB.

    P-values of the differences are Holm's over the memories.
    """
    by_method, largest = measures("memory", "final_success"), measures("goal", "final_success").get("er", {})
    sizes = dict.fromkeys(method.partition(" ")[2] for method in by_method)
    rows, tested = [], []
    for size in sizes:
        plain, compressed = (by_method.get(f"{name} {size}", {}) for name in ("er", "compressed_er"))
        both = sorted(plain.keys() & compressed.keys())
        less = [compressed[seed] - plain[seed] for seed in both]
        tested.append(paired_difference(np.array(less)).p_value if less else math.nan)
        means = (f"{statistics.mean(v.values()):.2f}" if v else "–" for v in (plain, compressed))
        rows.append(
            [
                *(size, str(len(both)), *means, _plain_difference(less)),
                ", ".join(f"{100 * v:+.1f}" for v in less),
                *(
                    _plain_difference([v[s] - largest[s] for s in sorted(v.keys() & largest.keys())])
                    for v in (plain, compressed)
                ),
            ]
        )
    for row, p in zip(rows, holm(tested), strict=True):
        row.insert(6, f"{p:.2g}")
    heads = [
        "memory",
        "seeds",
        "`er`",
        "`compressed_er`",
        "`compressed_er` less `er`",
        "each seed",
        "p (Holm)",
    ]
    if rows:
        yield (
            "memory: by bytes",
            table([*heads, "`er` less 247 MB", "`compressed_er` less 247 MB of `er`"], rows),
        )


def together(studies: tuple[str, str]) -> Iterator[tuple[str, list[str]]]:
    """A metric of each algorithm less that of the first reference in two streams, and the mean of both effects.

    The interval of the mean is Welch's: of two independent means with deviations of their own.
    """
    for name, title in COMPARED.items():
        found = [measures(study, name) for study in studies]
        rows = []
        for label in (label for label in found[1] if label != REFERENCES[0] and label in found[0]):
            effects = [
                np.array(
                    [
                        v - values[REFERENCES[0]][s]
                        for s, v in values[label].items()
                        if s in values[REFERENCES[0]]
                    ]
                )
                for values in found
            ]
            mean = welch_difference(effects[0] / 2, -effects[1] / 2).estimate
            rows.append([label, *(_plain_difference(list(e)) for e in effects), _estimate(mean)])
        if rows:
            heads = [f"less {REFERENCES[0]}, `{study}`" for study in studies]
            yield f"together: {title}", table(["algorithm", *heads, "mean of both"], rows)


def measures(study: str, name: str) -> dict[str, dict[int, float]]:
    """A metric of each finished run, by method and seed."""
    return {
        method: {seed: values[name] for seed, values in runs.items()}
        for method, runs in _metrics(study).items()
    }


@functools.cache
def _metrics(study: str) -> dict[str, dict[int, dict[str, float]]]:
    found: dict[str, dict[int, dict[str, float]]] = {}
    for run, folder in finished(study):
        scores = ResultLog(folder / "results.jsonl").read().scores()
        found.setdefault(run.method, {})[run.seed] = metric_values(scores)
    return found


def _plain_difference(values: list[float]) -> str:
    """The mean of differences in points, with Student's interval of these alone."""
    return _estimate(paired_difference(np.array(values)).estimate) if values else "–"


def _estimate(found: Estimate) -> str:
    ends = "" if math.isnan(found.low) else f" [{100 * found.low:z.1f}, {100 * found.high:z.1f}]"
    return f"{100 * found.value:+.1f}{ends}"


def finished(study: str) -> Iterator[tuple[Planned, Path]]:
    """Yield the finished runs of a study, each with a folder of its records."""
    for run in planned():
        if run.study.name == study and run.is_done():
            with tempfile.TemporaryDirectory() as scratch:
                yield run, run.unpack(Path(scratch))


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
    text, found = readme.read_text(encoding="utf-8"), dict[str, list[str]]()
    for path in sorted(HERE.glob("*/comparison.json")):
        for name, lines in tables(path.parent.name, json.loads(path.read_text(encoding="utf-8"))):
            found[f"{path.parent.name}: {name}"] = lines
    found |= {**dict(by_bytes()), **dict(together(("goal", "ten_demonstrations")))}
    for name, lines in found.items():
        if f"<!-- {name} -->" in text:  # of costs only the costs
            text = insert(text, name, lines)
    readme.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
