"""A sweep over values of settings on short streams; what is measured is kept, so a sweep that was stopped goes on."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import yaml

from libero_env.storage import atomic_write_text
from libero_env.tasks import Task
from lifelong.errors import ConfigError
from lifelong.tuning.frontier import Errors, Frontier, Outcome
from lifelong.tuning.proxy import ProxySettings, StreamData, Trial, measure, open_stream

Config = Mapping[str, Any]


@dataclass(frozen=True)
class Candidate:
    """A configuration to be measured.

    Attributes:
        label: Name in tables and pictures.
        settings: Values that it differs in, by dotted key.
        config: Configuration of a run, as plain data.
    """

    label: str
    settings: dict[str, Any]
    config: Config


def measure_frontier(
    candidates: Sequence[Candidate],
    others: Sequence[Candidate],
    fine_tuning: Candidate,
    proxy: ProxySettings,
    folder: Path,
    report: Callable[[str], None] = print,
) -> Frontier:
    """Measure candidates on all streams and with all seeds.

    Args:
        candidates: Values to choose from, in the order of the picture's line.
        others: Algorithms to compare with.
        fine_tuning: Sequential fine-tuning, whose errors are the unit.
        proxy: Streams, seeds and length of training.
        folder: Folder of what is measured.
        report: Function that is given a line after each trial.

    Raises:
        ConfigError: A stream is too short to forget anything.
    """
    everyone = (fine_tuning, *others, *candidates)
    errors: dict[str, list[Errors]] = {one.label: [] for one in everyone}
    places = [(stream, seed) for stream in proxy.streams for seed in proxy.seeds]
    total, done = len(places) * len(everyone), 0
    for stream, seed in places:
        if len(stream) < 2:
            raise ConfigError(
                "a stream has one task; expected two or more, of which the first can be forgotten"
            )
        for one in everyone:
            began = time.perf_counter()
            trial = Trial(one.config, stream, seed, proxy.steps, proxy.held_out)
            found = measure(trial, partial(_opened, trial), folder)
            errors[one.label].append(found)
            done += 1
            shown = ", ".join(f"{error:.3f}" for error in found[-1])
            report(
                f"{done}/{total} {one.label}, {stream[0].name} and {len(stream) - 1} more, seed {seed}: "
                f"errors at the end {shown} ({time.perf_counter() - began:.0f} s)"
            )
    base = tuple(errors[fine_tuning.label])

    def outcome(one: Candidate) -> Outcome:
        return Outcome(one.label, one.settings, tuple(errors[one.label]), base)

    return Frontier(tuple(map(outcome, candidates)), tuple(map(outcome, (fine_tuning, *others))))


def _opened(trial: Trial) -> StreamData:
    """Return the demonstrations of a trial, of which those of the last one are held."""
    needed = {group: trial.config[group] for group in ("data", "language")}
    return _open(json.dumps(needed, sort_keys=True), trial.stream, trial.held_out)


@lru_cache(maxsize=1)
def _open(config: str, stream: tuple[Task, ...], held_out: float) -> StreamData:
    return open_stream(json.loads(config), stream, held_out)


def write_frontier(frontier: Frontier, path: Path, about: Mapping[str, Any]) -> None:
    """Write a frontier with all errors to a JSON file.

    Args:
        frontier: What was measured.
        path: File to write.
        about: What else is to be known: command, tasks, versions.
    """
    record = {
        **about,
        "chosen": frontier.chosen.settings,
        "values": [_row(outcome) for outcome in frontier.outcomes],
        "others": [_row(outcome) for outcome in frontier.others],
    }
    atomic_write_text(path, json.dumps(record, indent=1) + "\n")


def _row(outcome: Outcome) -> dict[str, Any]:
    return {
        "label": outcome.label,
        "settings": outcome.settings,
        **{name: asdict(getattr(outcome, name)) for name in ("kept", "learned", "score")},
        "errors": outcome.trials,
    }


def write_tuned(outcome: Outcome, path: Path, about: str) -> None:
    """Write a value of an algorithm's settings as a file of the configuration group `tuned`.

    Args:
        outcome: The chosen value.
        path: File to write.
        about: Where it comes from; a comment at the top.

    Raises:
        ConfigError: A setting is none of the algorithm.
    """
    node: dict[str, Any] = {}
    for key, value in outcome.settings.items():
        group, *names = key.split(".")
        if group != "algo" or not names:
            raise ConfigError(f"{key} is no setting of the algorithm: set it in a preset of your own instead")
        place = node
        for name in names[:-1]:
            place = place.setdefault(name, {})
        place[names[-1]] = value
    path.parent.mkdir(parents=True, exist_ok=True)
    comment = "".join(f"# {line}\n" for line in about.splitlines())
    atomic_write_text(path, comment + yaml.safe_dump(node, sort_keys=False))
