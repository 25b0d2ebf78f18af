"""A self-contained report page about one run, or a comparison of several."""

import json
import os
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.storage import atomic_write_text, write_json
from libero_env.text import Table, duration
from lifelong.errors import LifelongError
from lifelong.report.comparison import MUJOCO, Plan, compare, findings, published_metrics
from lifelong.report.figures import (
    Line,
    Panel,
    as_svg,
    forgetting_figure,
    heatmap_figure,
    learning_figure,
    save,
    storage_figure,
)
from lifelong.report.media import media
from lifelong.report.runs import Group, Run, group_runs, load_run, short_labels
from lifelong.report.tables import (
    COST_COLUMNS,
    atom_table,
    collection_table,
    cost_table,
    interference_table,
    mean_heatmap,
    method_table,
    most_forgotten,
    page_template,
    percent,
    run_heatmap,
    shift_table,
    shift_tables,
    subgoal_table,
    tally_tables,
    task_costs,
    triangle,
    with_contents,
)
from lifelong.results.failures import failure_score, safety_score
from lifelong.results.records import RunRecord
from lifelong.results.relearning import by_measure, read_relearning, savings_table
from lifelong.results.results import Results
from lifelong.results.shifts import shift_scores
from lifelong.results.summary import write_episodes
from lifelong.stats.intervals import Estimate
from lifelong.stats.methods import compared_transfer
from lifelong.stats.metrics import Transfer, lifelong_metrics

METRIC_TEXTS = {
    "fwt": ("FWT", "forward transfer: success averaged over the epochs of learning a task", "up"),
    "nbt": ("NBT", "forgetting: success lost on a task, averaged over the later ones", "down"),
    "auc": ("AUC", "success on a task averaged over learning it and all later tasks", "up"),
    "final_success": ("Final", "success over all tasks at the end of the sequence", "up"),
    "just_learned": ("Just learned", "success on each task right after learning it", "up"),
}
TRANSFER_TEXTS: dict[str, str] = {
    "plain": "FWT is the mean of the learning curve, as the last epoch's weights are kept.",
    "cross_fitted": "FWT holds the best epoch, chosen without the start that measures it.",
    "published": "FWT holds the best epoch as measured.",
}


def write_report(
    run_dirs: Sequence[Path],
    out: Path | None = None,
    plan: Plan = Plan(),  # noqa: B008 - frozen
) -> Path:
    """Write report.html and heatmap.png, .pdf; of several runs also forgetting.png, comparison.json, episodes.csv.gz.

    Args:
        run_dirs: Directory of one run to describe, or of several to compare. Runs need not be finished.
        out: File of the page, or a folder for it. Default: the run directory; for several runs, `comparison` in the
            current folder, which git ignores.
        plan: What is compared, of several runs.

    Returns:
        Path of the page. It needs no other file and no network.

    Raises:
        LifelongError: No run is given, a run directory has no results, or `out` cannot be written.
    """
    if not run_dirs:
        raise LifelongError("no run directory given; name one or more, such as runs/libero_object/er/seed1")
    runs = [load_run(Path(d)) for d in run_dirs]
    try:
        out = Path(out) if out is not None else _default_folder([r.path for r in runs])
        if out.is_dir() or out.suffix == "":
            out = out / "report.html"
        out.parent.mkdir(parents=True, exist_ok=True)
        context = _single_run(runs[0], out.parent) if len(runs) == 1 else _comparison(runs, out.parent, plan)
        atomic_write_text(out, with_contents(page_template("page.html").render(context)))
    except OSError as error:
        raise LifelongError(f"{out or Path.cwd()}: the report cannot be written ({error})") from error
    return out


def comparison_text(page: Path) -> list[str]:
    """Return what a comparison shows, in sentences, from the numbers beside its page."""
    found = json.loads((page.parent / "comparison.json").read_text(encoding="utf-8"))
    later = [f"Later tasks alone: {line}" for line in _findings(found["after_base_stage"])]
    return found["conditions"] + _findings(found) + later


def _findings(found: dict[str, Any] | None) -> list[str]:
    return findings(found, {name: text[0] for name, text in METRIC_TEXTS.items()}) if found else []


def shift_text(run_dir: Path) -> list[str]:
    """Return the success and forgetting of a run under each held-out shift, in sentences."""
    return [
        f"under {score.shift}: {percent(score.success('final_shifted').value)} % at the end, "
        f"{percent(score.success('final').value)} % without; forgotten "
        f"{percent(score.forgetting(shifted=True).value)} points, {percent(score.forgetting(shifted=False).value)} "
        "without"
        for score in shift_scores(load_run(Path(run_dir)).results)
    ]


def _default_folder(paths: Sequence[Path]) -> Path:
    """Return where a page is written: in the only run, or in a folder of its own, which git ignores, for several."""
    if len(paths) == 1:
        return paths[0]
    folder = Path.cwd() / "comparison"
    atomic_write_text(folder / ".gitignore", "*\n")
    return folder


def _single_run(run: Run, folder: Path) -> dict[str, Any]:
    """Return the template's variables for one run, and write the heatmap beside the page."""
    record, labels = run.record, short_labels(run.record.instructions)
    rates, _ = run.results.success_matrix()
    save(heatmap_figure([Panel(f"{record.algo}, {record.benchmark}", rates, labels)]), folder / "heatmap")
    curves, losses, drawn = run.results.curves(), run.results.losses(), run.results.collections()
    average = run.results.average_success()[None]
    times = {k: v for k, v in run.results.seconds_by_phase().items() if v > 0}
    return {
        "title": f"{record.algo} on {record.benchmark}",
        "facts": _facts(run),
        "command": shlex.join(["python", "train.py", *record.overrides]) if record.overrides else "",
        "notes": run.notes,
        "metrics": run.metrics,
        "metric_texts": _metric_texts([run]),
        "later_metrics": run.results.after_base_stage(),
        "base_tasks": _base_tasks(record),
        "transfer": TRANSFER_TEXTS[run.results.transfer],
        "published": _published(run),
        "bar_low": min(0.0, run.metrics.nbt.value) if run.metrics else 0.0,
        "heatmaps": [run_heatmap(run.results, labels)],
        "learning": as_svg(learning_figure(curves, losses, labels, _kept(run), drawn))
        if curves or losses
        else None,
        "collections": collection_table(drawn, labels),
        "forgetting": as_svg(forgetting_figure([Line("", average)])) if run.learned > 1 else None,
        "tasks": _task_rows(run, rates),
        "times": [(name, duration(s), 100 * s / sum(times.values())) for name, s in times.items()],
        "total_time": duration(sum(times.values())),
        "episodes": run.results.episodes(),
        "relearning": [savings_table(part) for part in by_measure(read_relearning(run.path))],
        "shifts": [(score.shift, shift_table(score, labels)) for score in shift_scores(run.results)],
        "safety": tally_tables(safety_score(run.results), labels),
        "failures": tally_tables(failure_score(run.results), labels),
        "interference": interference_table(failure_score(run.results), labels),
        "subgoals": subgoal_table(run.results.subgoals()),
        "atoms": atom_table(run.results.subgoals(), labels),
        "most_forgotten": most_forgotten(run.results.subgoals().atoms),
        "costs": task_costs(run, labels),
        "media": media(run.path / "videos"),
        "saliency": media(run.path / "saliency"),
        "config_text": run.config_text,
        "versions": {**record.versions, **{k.replace("_", " "): v for k, v in record.conditions.items()}},
        "run_dir": run.path.resolve().name,
    }


def _comparison(runs: Sequence[Run], folder: Path, plan: Plan) -> dict[str, Any]:
    """Return the template's variables for several runs, and write figures and numbers beside the page."""
    groups = sorted(_comparable(group_runs(runs)), key=_rank)
    found = compare(groups, plan)
    later = found["after_base_stage"]
    for group in found["groups"].values():  # a page that is sent says nothing of this machine
        group["runs"] = [os.path.relpath(path, folder) for path in group["runs"]]
    write_json(folder / "comparison.json", found)
    write_episodes(folder / "episodes.csv.gz", [(g.label, run.results) for g in groups for run in g.runs])
    panels, heatmaps, lines = zip(*map(_success_of, groups), strict=True)
    save(heatmap_figure(panels), folder / "heatmap")
    save(forgetting_figure(lines), folder / "forgetting")
    if stored := _stored(found):
        save(storage_figure(stored), folder / "storage")
    counted = [run for group in groups for run in group.runs]
    benchmarks = sorted({r.record.benchmark for r in counted})
    texts: dict[str, str] = {}
    for run in counted:
        texts |= dict(zip(run.record.tasks, short_labels(run.record.instructions), strict=True))
    return {
        "title": f"{len(groups)} methods on {', '.join(benchmarks)}" if len(groups) > 1 else groups[0].label,
        "facts": [
            ("runs", len(counted)),
            ("seeds", ", ".join(map(str, sorted({r.record.seed for r in counted})))),
            *[
                ("tasks learned together first", n)
                for n in sorted({_base_tasks(r.record) for r in counted})
                if n
            ],
        ],
        "notes": [f"{os.path.relpath(r.path, folder)}: {note}" for r in runs for note in r.notes]
        + [
            f"{os.path.relpath(r.path, folder)}: a further run of seed {r.record.seed} of {g.label}; it is not counted"
            for g in groups
            for r in g.repeats
        ]
        + found["conditions"],
        "groups": found["groups"],
        "metrics": {label: group["metrics"] for label, group in found["groups"].items()},
        "later": later,
        "metric_texts": _metric_texts(counted),
        "other_conventions": method_table(found, "other_conventions", 1),
        "spreads": Table(
            ("method", "order of tasks", "demonstrations", "seed"),
            [
                [label, *(percent(factor["auc"]) for factor in group["spreads"].values())]
                for label, group in found["groups"].items()
                if any(np.isfinite(group["spreads"][factor]["auc"]) for factor in ("order", "demonstrations"))
            ],
        ),
        "differences": found["differences"],
        "findings": _findings(found),
        "margin": plan.margin,
        "later_findings": _findings(later),
        "published": [
            (label, group["published"])
            for label, group in found["groups"].items()
            if np.isfinite(group["published"]["fwt"])
            and any(
                percent(v) != percent(group["metrics"][name]["mean"])
                for name, v in group["published"].items()
            )
        ],
        "transfer": " ".join(dict.fromkeys(TRANSFER_TEXTS[_compared_transfer(r, counted)] for r in counted)),
        "forgotten_tasks": method_table(found, "forgetting_by_task", 0, texts),
        "forgotten_subgoals": method_table(found, "subgoals", 0),
        "shifted": shift_tables(found, plan.references),
        "costs": cost_table("method", [(label, group["costs"]) for label, group in found["groups"].items()]),
        "cost_columns": COST_COLUMNS,
        "spent": [
            name
            for name in ("kept_share", "updates")
            if any(name in group["costs"] for group in found["groups"].values())
        ],
        "heatmaps": heatmaps,
        "forgetting": as_svg(forgetting_figure(lines)),
        "storage": as_svg(storage_figure(stored)) if stored else None,
        "triangles": {name: rows for name in METRIC_TEXTS if (rows := triangle(found, name))},
        "runs": [_run_row(run, group.label, folder) for group in groups for run in group.runs],
    }


def _comparable(groups: Sequence[Group]) -> list[Group]:
    """Return the groups with the metrics by which their runs are compared."""
    counted = [run for group in groups for run in group.runs]

    def compared(run: Run) -> Run:
        scores = run.results.scores(transfer=_compared_transfer(run, counted)) if run.metrics else None
        return replace(run, metrics=lifelong_metrics(scores)) if scores else run

    return [replace(group, runs=tuple(map(compared, group.runs))) for group in groups]


def _compared_transfer(run: Run, runs: Sequence[Run]) -> Transfer:
    return compared_transfer(run.results.transfer, {r.results.transfer for r in runs if r.metrics})


def _success_of(group: Group) -> tuple[Panel, dict[str, Any], Line]:
    """Return a method's success: mean over its runs as a panel and as a table, and of each run task by task."""
    labels, runs = group.labels, group.runs
    matrices = np.stack([run.results.success_matrix()[0] for run in runs])
    present = ~np.isnan(matrices)
    mean = np.where(present, matrices, 0).sum(0) / np.where(present.any(0), present.sum(0), np.nan)
    table = run_heatmap(runs[0].results, labels) if len(runs) == 1 else mean_heatmap(matrices, mean, labels)
    values = np.stack([run.results.average_success() for run in runs])
    titled = table | {"title": group.label, "seeds": [run.record.seed for run in runs]}
    return Panel(group.label, mean, labels), titled, Line(group.label, values)


def _rank(group: Group) -> tuple[float, float]:
    """Return by what methods are sorted, best first: mean AUC, of those without one mean final success."""
    found = [r.metrics for r in group.runs if r.metrics is not None]
    values = [(m.auc.value, m.final_success.value) for m in found] or [(np.nan, np.nan)]
    return tuple(-np.nan_to_num(np.mean(values, axis=0), nan=-np.inf))


def _metric_texts(runs: Sequence[Run]) -> dict[str, tuple[str, str, str]]:
    """Return name, meaning and direction of each metric; FWT's meaning names the points that it is the mean of."""
    name, meaning, better = METRIC_TEXTS["fwt"]
    points = dict.fromkeys(text for run in runs if (text := _points(run.results)))
    return METRIC_TEXTS | {"fwt": (name, "; or ".join([meaning, *points]).replace("; or ", ": ", 1), better)}


def _points(results: Results) -> str:
    """Return the epochs and starts of the learning curves; empty without any."""
    curves = [r for r in results.evaluations() if r.phase == "curve"]
    if not curves:
        return ""
    epochs, counts = sorted({r.epoch for r in curves}), {len(r.successes) for r in curves}
    shown = ", ".join(map(str, epochs if len(epochs) < 8 else [*epochs[:3], "…", epochs[-1]]))
    starts = {state for r in curves for state in r.init_states}
    apart = starts.isdisjoint(
        state for r in results.evaluations() if r.phase == "matrix" for state in r.init_states
    )
    which = (
        f"{'–'.join(map(str, sorted({min(counts), max(counts)})))} starts{' of their own' if apart else ''}"
    )
    return f"epochs {shown}, from {which}"


def _kept(run: Run) -> dict[int, int]:
    """Return the epoch whose weights are kept of each task that is learned."""
    results, tasks = run.results, range(len(run.record.tasks))
    return {t: end.best_epoch for t in tasks if (end := results.task_end(results.last_of_group(t)))}


def _facts(run: Run) -> list[tuple[str, Any]]:
    record, found = run.record, run.results.demonstrations
    facts = {
        "policy": record.policy,
        "preset": record.preset,
        "seed": str(record.seed),
        "last task under": record.perturbed[-1] if any(record.perturbed) else "",
        "simulated by": record.backend if record.backend != MUJOCO else "",
        "tasks": len(record.tasks),
        "started": record.started.replace("T", " ").replace("+00:00", " UTC"),
        "demonstrations by": ", ".join(dict.fromkeys(filter(None, found.generators))) if found else "",
        "CPUs": record.cpu_count,
        "commit": (record.commit or "")[:10],
    }
    return [(name, value) for name, value in facts.items() if value]


def _base_tasks(record: RunRecord) -> int:
    """Return the number of tasks of the base stage, 0 without one."""
    return len(record.groups[0]) if record.has_base_stage else 0


def _published(run: Run) -> dict[str, float] | None:
    """Return FWT and AUC as eq. 3 is written; None if these are the run's own, or unknown."""
    if run.metrics is None or run.results.transfer == "published":
        return None
    values = published_metrics([run])
    same = all(percent(values[name]) == percent(getattr(run.metrics, name).value) for name in values)
    return values if np.isfinite(values["fwt"]) and not same else None


def _stored(found: dict[str, Any]) -> dict[str, tuple[float, Estimate]]:
    """Return the bytes that methods keep, and their AUC; nothing where fewer than two have both."""
    points = {}
    for label, group in found["groups"].items():
        auc, size = group["metrics"]["auc"], group["costs"].get("stored_bytes", np.nan)
        if np.isfinite([size, auc["mean"]]).all():
            points[label] = size, Estimate(auc["mean"], auc["low"], auc["high"])
    return points if len(points) > 1 else {}


def _run_row(run: Run, label: str, folder: Path) -> dict[str, Any]:
    page = run.path / "report.html"
    return {
        "label": label,
        "seed": run.record.seed,
        "metrics": run.metrics,
        "learned": f"{run.learned} of {len(run.record.tasks)}",
        "time": duration(sum(run.results.seconds_by_phase().values())),
        "path": os.path.relpath(run.path, folder),
        "link": os.path.relpath(page, folder) if page.is_file() else None,
    }


def _task_rows(run: Run, rates: np.ndarray) -> list[dict[str, Any]]:
    rows = []
    for task, (name, text) in enumerate(zip(run.record.tasks, run.record.instructions, strict=True)):
        row = run.results.last_of_group(task)
        end, done = run.results.task_end(row), task < run.learned
        last = row == run.learned - 1
        rows.append(
            {
                "name": name,
                "instruction": text,
                "best_epoch": end.best_epoch if end else None,
                "learned": rates[row, task] if done else np.nan,
                "final": rates[run.learned - 1, task] if done else np.nan,
                "fwt": run.metrics.fwt_by_task[task] if done and run.metrics else np.nan,
                "nbt": run.metrics.nbt_by_task[task] if done and run.metrics and not last else np.nan,
                "seconds": duration(end.seconds) if end and row == task else None,
            }
        )
    return rows
