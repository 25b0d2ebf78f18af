"""Demonstration files as a whole: where they are, what is in them, and files made of parts of them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from libero_env.demos.agreement import noisy_labels, other_control, recorded_frequency
from libero_env.demos.contents import (
    IMAGE_KEYS,
    count_steps,
    demo_names,
    file_attributes,
    json_attribute,
    picture_size,
    value_fault,
)
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.observe import recorded_task, task_header
from libero_env.demos.read import NOOP_THRESHOLD, Episode, noop_steps, read_episodes
from libero_env.demos.write import DemoWriter, require_absent
from libero_env.errors import DemoError
from libero_env.paths import demos_dir
from libero_env.storage import files_below
from libero_env.tasks import Task
from libero_env.text import show_bytes
from libero_env.timing import CONTROL_HZ


@dataclass(frozen=True)
class DemoStats:
    """Contents of a file.

    Attributes:
        lengths: Number of steps of each demonstration.
        successes: Number of demonstrations that reached the goal.
        noops: Number of no-op steps, see `noop_steps`.
        faults: What is wrong although it can be read.
        notes: What it cannot be used for.
        perturb: Perturbations under which it was rendered, as text.
    """

    lengths: tuple[int, ...]
    successes: int
    noops: int
    faults: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    perturb: str = ""

    def __str__(self) -> str:
        steps, n = sum(self.lengths), len(self.lengths)
        length = f"{min(self.lengths)}-{max(self.lengths)} steps (mean {steps / n:.0f})"
        done = f"{self.successes} of {n} successful, {100 * self.noops / steps:.1f} % no-ops"
        return f"{length}, {done}" + (f", rendered under {self.perturb}" if self.perturb else "")


def examine(file: Path, *, threshold: float = NOOP_THRESHOLD) -> DemoStats:
    """Read a file completely and return what is in it.

    Args:
        threshold: As for `noop_steps`.

    Raises:
        DemoError: The file is broken; the message names file, demonstration, key and what was expected.
    """
    lengths, successes, noops, faults = [], 0, 0, []
    shapes: dict[str, tuple[int, ...]] = {}
    for episode in read_episodes(file, check_values=False):
        lengths.append(len(episode))
        successes += episode.success
        noops += int(noop_steps(episode.labels, threshold).sum())
        faults += [f"{episode.name}{fault}" for fault in _faults(episode, shapes)]
    if not lengths:
        raise DemoError(f"{file}: no demonstrations; expected at least data/demo_0. Record them again")
    with open_demo_file(file) as handle:
        attributes = file_attributes(handle, file)
    for key, value in (("num_demos", len(lengths)), ("total", sum(lengths))):
        if (stated := attributes.get(key, value)) != value:
            faults.append(f"attribute {key} is {stated}; expected {value}")
    notes = []
    if unseen := [key for key in IMAGE_KEYS if f"obs/{key}" not in shapes]:
        which = f"has no {' and no '.join(unseen)}: no policy that sees them can be trained on it"
        notes.append(f"{which}; `libero demos rerender` draws them")
    try:
        recorded_task(file)
    except DemoError as error:
        notes.append(str(error).removeprefix(f"{file}: "))
    if (hz := recorded_frequency(file)) != CONTROL_HZ:
        notes.append(f"was recorded at {hz} Hz: it is neither learned from nor exported")
    if other := other_control(file):
        notes.append(f"states {other}: it is neither learned from, exported, nor replayed")
    if noisy := noisy_labels(file):
        notes.append(f"{noisy}: only data.labels=executed learns from it")
    perturb = str(attributes.get("perturb", ""))
    return DemoStats(tuple(lengths), successes, noops, tuple(faults), tuple(notes), perturb)


def _faults(episode: Episode, shapes: dict[str, tuple[int, ...]]) -> Iterator[str]:
    """Yield what is wrong with an episode; `shapes` are those of the first ones, and new keys are added to them."""
    arrays = episode.arrays | {f"obs/{key}": values for key, values in episode.obs.items()}
    for key, values in arrays.items():
        if fault := value_fault(key.removeprefix("obs/"), values):
            yield f"/{key} {fault}"
        if shapes.setdefault(key, values.shape[1:]) != values.shape[1:]:
            yield f"/{key} holds {values.shape[1:]}; expected {shapes[key]} as in the others"
    if missing := sorted(shapes.keys() - arrays.keys()):
        yield f" has no {', '.join(missing)}; expected them as in the others"
    if (largest := np.abs(episode.actions).max()) > 1.0 + 1e-6:
        yield f"/actions reach {largest:.2f}; expected numbers in [-1, 1]"


def filter_demos(
    file: Path,
    target: Path,
    *,
    success_only: bool = False,
    without_noops: bool = False,
    threshold: float = NOOP_THRESHOLD,
    task: Task | None = None,
) -> DemoStats:
    """Write some of the demonstrations or steps of a file into another one; demonstrations are numbered from 0.

    Without its no-ops a demonstration can be replayed by its states, no longer by its actions. Its last step is always
    kept.

    Args:
        target: File to write; it must not exist.
        success_only: Whether to leave out demonstrations that did not reach the goal.
        without_noops: Whether to leave out the steps of `noop_steps`.
        threshold: As for `noop_steps`.
        task: Task that was recorded, which the new file states; None for the one that the file states.

    Returns:
        Contents of the new file.

    Raises:
        DemoError: The file is broken, nothing of it is left, or the target exists.
    """
    require_absent(target)
    dropped = [key for key, on in (("failures", success_only), ("no-ops", without_noops)) if on]
    header = task_header(file, task)
    dropped_text = f"without {' and '.join(dropped) or 'nothing'}"
    if "filter" in header:
        dropped_text = f"{header['filter']}, then {dropped_text}"
    writer = DemoWriter(target, header | {"filter": dropped_text})
    writer.discard_parts()  # of an interrupted call, perhaps with another file
    count = 0
    for episode in read_episodes(file):
        if success_only and not episode.success:
            continue
        keep = ~noop_steps(episode.labels, threshold) if without_noops else np.ones(len(episode), bool)
        keep[-1] = True
        attrs = {**episode.attrs, "source_demo": episode.name}
        writer.write(count, replace(episode.select(keep), attrs=attrs))
        count += 1
    if not count:
        raise DemoError(f"{file}: no demonstration is successful; nothing to write")
    return examine(writer.finish(), threshold=threshold)


def find_demo_files(paths: Sequence[Path]) -> list[Path]:
    """Return the demonstration files among the given paths and in the given folders.

    Args:
        paths: Files and folders; none for the folder where demonstrations are kept.

    Raises:
        DemoError: There are none, or a folder is missing.
    """
    if missing := [path for path in paths if path.suffix != ".hdf5" and not path.exists()]:
        raise DemoError(f"{missing[0]} does not exist; give demonstration files, or folders that hold some")
    paths, files = paths or [demos_dir()], dict[Path, Path]()
    for path in paths:
        for file in [path] if path.suffix == ".hdf5" else sorted(files_below(path, "*.hdf5")):
            # without links and parts of unfinished recordings
            if file in paths or not (file.is_symlink() or file.parent.suffix == ".parts"):
                files.setdefault(file.resolve(), file)  # each once
    if not files:
        where = ", ".join(map(str, paths))
        raise DemoError(
            f"no demonstrations in {where}; record some with `libero demos generate --benchmark NAME`"
        )
    return list(files.values())


def describe(file: Path) -> str:
    """Return one line about a file: demonstrations, steps, image size, failed attempts, pairing, bytes.

    Raises:
        DemoError: It is not a demonstration file.
    """
    with open_demo_file(file) as handle:
        names, header = demo_names(handle, file), file_attributes(handle, file)
        steps = sum(count_steps(handle["data"][name], f"{file}: {name}") for name in names)
        size = picture_size(handle, file)
    images = "no images" if size is None else f"{size[0]}x{size[1]} pixels"
    models = json_attribute(header, "models", file).get("pack", "unknown")
    failed = header.get("num_failed_attempts", "unknown")
    parts = (f"{len(names)} demonstrations", f"{steps} steps", images, f"failed attempts: {failed}")
    pairing = header.get("pairing", "libero")
    more = f"pairing: {pairing}, models: {models}, {show_bytes(file.stat().st_size)}"
    more += f", rendered under {header['perturb']}" if "perturb" in header else ""
    return f"{file}: {', '.join(parts)}, {more}"
