"""Loading of run directories: single runs, finished or not, and groups that differ in seed and order only."""

import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from libero_env.demos.agreement import UNSTATED, differing
from libero_env.errors import InvalidInputError
from libero_env.storage import MAX_YAML_BYTES, parse_yaml_text, read_bounded
from lifelong.errors import LifelongError, ResultsError
from lifelong.results.log import ResultLog
from lifelong.results.provenance import few_of, result_relevant, resume_notes
from lifelong.results.records import RunRecord, TaskEndRecord
from lifelong.results.results import Results
from lifelong.stats.metrics import Metrics, lifelong_metrics

_TOLD = ("packnet", "lora", "omla", "singletask")
BASICS = ("algo", "benchmark", "policy", "preset")
# of keys that change no result by themselves, besides those of `lifelong.results.provenance.VOLATILE`
_IGNORED = (
    "benchmark.order",
    "benchmark.order_seed",
    "benchmark.horizon",
    "data.seed",
    "eval.cells_seed",
    "eval.record_every",
    "eval.reuse",
    "eval.transfer",
)
# sections of the config
_COMPARED = (
    "algo", "policy", "augmentation", "train", "data", "eval", "language", "benchmark", "stream", "pretrain"
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """A run, as far as it could be read.

    Attributes:
        path: Directory of the run.
        config: Its configuration; empty if it cannot be read.
        config_text: The configuration as text.
        notes: Remarks for the reader, such as that the run is not finished.
        metrics: Metrics over these; None before the first task is learned.
    """

    path: Path
    results: Results
    record: RunRecord
    config: dict[str, Any]
    config_text: str
    notes: tuple[str, ...]
    learned: int
    metrics: Metrics | None


@dataclass(frozen=True)
class Group:
    """Runs that differ only in their seed, the seed of their demonstrations and the order of their tasks.

    Attributes:
        label: Name of the method.
        runs: One run of each, of those that have learned most tasks.
        repeats: Further runs of these, which add no evidence and are not counted.
        behind: Runs that have learned fewer tasks, which are not counted.
    """

    label: str
    runs: tuple[Run, ...]
    repeats: tuple[Run, ...] = ()
    behind: tuple[Run, ...] = ()

    @property
    def labels(self) -> list[str]:
        """Short names of the positions in the sequence: those of the tasks, or numbers if the orders differ."""
        first = self.runs[0].record
        if all(r.record.tasks == first.tasks for r in self.runs):
            return short_labels(first.instructions)
        return [f"task {i + 1}" for i in range(len(first.tasks))]

    @property
    def told_task(self) -> bool:
        """Whether its policies are told the number of the task at test time, which most methods are not."""
        adapters = settings_of(self.runs[0]).get("algo.adapters", "own")
        return algorithm_of(self.runs[0]) in _TOLD and adapters == "own"


def load_run(path: Path) -> Run:
    """Read a run directory.

    Raises:
        LifelongError: The directory or its results are missing or cannot be read.
    """
    if not path.is_dir():
        raise LifelongError(f"{path}: no such run directory")
    log = path / "results.jsonl"
    if not log.is_file():
        present = ", ".join(sorted(p.name for p in path.iterdir())[:8]) or "nothing"
        for levels in ("*", "*/*", "*/*/*"):
            if count := len(list(path.glob(f"{levels}/{log.name}"))):
                inner = path / levels
                raise LifelongError(
                    f"{path} is not a run: it holds {count}, in {inner}; write libero report {inner}"
                )
        raise LifelongError(
            f"{path}: {log.name} is missing, so this is not a run directory (it contains: {present})"
        )
    results = ResultLog(log).read()
    try:
        record = results.run
    except ResultsError as error:
        raise LifelongError(f"{log}: {error}") from error
    config, text, notes = _load_config(path / "config.yaml")
    learned = results.learned_tasks()
    metrics = lifelong_metrics(results.scores()) if learned else None
    if not results.finished:
        so_far = f"{learned} of {len(record.tasks)} tasks are learned"
        notes.insert(0, f"This run is not finished: {so_far}, and the metrics are over these.")
    remarks = (
        *notes,
        *_untrained(results),
        *_unlike_origins(results),
        *resume_notes(results),
        *results.error_notes,
        *results.problems,
    )
    return Run(path, results, record, config, text, remarks, learned, metrics)


def _untrained(results: Results) -> list[str]:
    """Return sentences about the tasks that next to nothing was learned on, though they count as learned."""
    ends = [end for end in results.of(TaskEndRecord) if end.best_epoch == 0 and results.has_loss(end.task, 1)]
    kept = [f"task {end.task + 1}" for end in ends]
    counts = {t: costs.get("parameters_trained", math.inf) for t, costs in results.costs_by_task().items()}
    usual = max((count for task, count in counts.items() if task and count < math.inf), default=0.0)
    full = [f"task {task + 1}" for task, count in counts.items() if count < max(1.0, 0.01 * usual)]
    told = {
        "No epoch was better than none, so the weights from before are kept of": kept,
        "Next to no weight was free, so nothing was trained on, or hardly anything:": full,
    }
    return [f"{text} {few_of(list(dict.fromkeys(tasks)))}." for text, tasks in told.items() if tasks]


def _unlike_origins(results: Results) -> list[str]:
    """Return sentences about demonstrations that differ from each other, or from what the run was evaluated with."""
    if (found := results.demonstrations) is None:
        return []
    columns = {"models": found.models, "expert": found.generators, "labels": found.labels}
    facts = {
        task: {name: values[i] or UNSTATED for name, values in columns.items() if values}
        for i, task in enumerate(results.run.tasks)
    }
    versions = results.run.versions
    here = f"{versions.get('models')} {versions.get('models_digest')}"
    others = [models for models in dict.fromkeys(found.models) if models not in (UNSTATED, here)]
    return [
        *(f"Its demonstrations differ in {line}." for line in differing(facts)),
        *(f"Demonstrations show the models {models}; it was evaluated on {here}." for models in others),
    ]


def short_labels(instructions: Sequence[str]) -> list[str]:
    """Return the instructions without their common first and last words, or whole if nothing would remain."""
    words = [text.split() for text in instructions]
    start = len(os.path.commonprefix(words)) if len(words) > 1 else 0
    end = len(os.path.commonprefix([w[::-1] for w in words])) if len(words) > 1 else 0
    cut = [w[start : len(w) - end] for w in words]
    fits = all(cut) and all(len(w) >= start + end for w in words)
    return [" ".join(w) for w in (cut if fits else words)]


def group_runs(runs: Sequence[Run]) -> list[Group]:
    """Group runs that differ only in seed and order of tasks; the labels name what differs between groups."""
    alike: dict[tuple[tuple[str, Any], ...], list[Run]] = {}
    for run in runs:
        alike.setdefault(tuple(settings_of(run).items()), []).append(run)
    groups: dict[tuple[tuple[str, Any], ...], list[Run]] = {}
    for settings, members in alike.items():
        learned = {(_factors(r), d.digests if (d := r.results.demonstrations) else ()) for r in members}
        several = len(learned) > len({_factors(r) for r in members})  # with one seed, from several folders
        for run in members:
            folder = (run.config.get("data") or {}).get("folder") if several else None
            key = (*settings, ("data.folder", str(folder))) if folder else settings
            groups.setdefault(key, []).append(run)
    identities = [dict(key) for key in groups]
    short = [_label(identity, identities) for identity in identities]
    whole = [_label(identity, identities, whole=True) for identity in identities]
    labels = [a if short.count(a) == 1 else b for a, b in zip(short, whole, strict=True)]
    return [_one_of_each(label, members) for label, members in zip(labels, groups.values(), strict=True)]


def _one_of_each(label: str, members: Sequence[Run]) -> Group:
    """Return the group with one run of each seed and order: that which learned most tasks, of these the latest."""
    kept: dict[tuple[Any, ...], Run] = {}
    for run in sorted(members, key=lambda r: (r.learned, r.record.started)):
        kept[*_factors(run), str(run.config.get("init_from"))] = run
    most = max(run.learned for run in members)
    kinds: dict[str, list[Run]] = {"runs": [], "repeats": [], "behind": []}
    for run in members:
        one_of_each = any(run is k for k in kept.values())
        kinds["repeats" if not one_of_each else "runs" if run.learned == most else "behind"].append(run)
    return Group(label, *map(tuple, kinds.values()))


def _factors(run: Run) -> tuple[Any, ...]:
    """Return what runs of one method are samples of: order of tasks, demonstrations, and all else that is drawn."""
    return run.record.tasks, run.record.demonstrations_seed, run.record.seed


def _label(identity: dict[str, Any], others: Sequence[dict[str, Any]], *, whole: bool = False) -> str:
    """Return the algorithm's name and what else distinguishes the group; settings only within one algorithm.

    Args:
        identity: What the group's runs have in common.
        others: That of all groups.
        whole: Whether to name all settings by their whole keys, so that no other group has the label.
    """
    rivals = [o for o in others if o["algo"] == identity["algo"]]
    differs = {
        k: v
        for k, v in identity.items()
        if k != "algo" and any(o.get(k) != v for o in (others if k in BASICS else rivals))
    }
    words = [str(v) if k in BASICS else f"{k.rpartition('.')[2]} {v}" for k, v in differs.items()]
    if whole:
        words = [f"{key} {value!r}" for key, value in differs.items()]
    elif len(words) > 3:
        words = [*words[:3], "…"]
    return f"{identity['algo']} ({', '.join(words)})" if words else str(identity["algo"])


def algorithm_of(run: Run) -> str:
    """Return the class of a run's algorithm as one word in lower case; its name where no configuration tells that."""
    return str(settings_of(run).get("algo.", run.record.algo)).replace("_", "").lower()


def stage_of(run: Run, task: int) -> range:
    """Return the positions of the tasks that are learned together with a task."""
    return range(len(run.record.tasks)) if algorithm_of(run) == "multitask" else run.record.group(task)


def settings_of(run: Run) -> dict[str, Any]:
    """Return what two runs of one method have in common: names and settings, without seeds, orders and places."""
    record = run.record
    settings: dict[str, Any] = {}
    for key, value in result_relevant({k: v for k, v in run.config.items() if k in _COMPARED}).items():
        section, _, name = key.rpartition(".")
        if key in _IGNORED or name == "_partial_" or not section:
            continue
        if name == "_target_":  # a component goes by the name of its class
            key, value = f"{section}.", str(value).rpartition(".")[2]
        if value is not None:  # an older run may not have the key
            settings[key] = value if isinstance(value, str | int | float | bool) else str(value)
    if "eval.backend" in settings:  # device and memory aside
        settings["eval.backend"] = record.backend
    if not run.config:
        settings["tasks"] = len(record.tasks)
    if init_from := run.config.get("init_from"):  # each seed may start from a run of the same seed
        settings["init_from"] = re.sub(r"seed\d+", "seed", str(init_from))
    return {n: getattr(record, n) for n in BASICS} | dict(sorted(settings.items()))


def _load_config(path: Path) -> tuple[dict[str, Any], str, list[str]]:
    try:
        text = read_bounded(path, MAX_YAML_BYTES, within=path.parent).decode(errors="replace")
    except FileNotFoundError:
        return {}, "", [f"{path.name} is missing; the configuration is not shown."]
    except OSError as error:
        return {}, "", [f"{path.name} is not read: {error}; the configuration is not shown."]
    try:
        config = parse_yaml_text(text, path.name).data
    except InvalidInputError as error:
        return {}, text, [f"{error}."]
    return (config if isinstance(config, dict) else {}), text, []
