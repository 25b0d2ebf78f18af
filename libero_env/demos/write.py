"""Writing demonstrations so that a killed process or a full disk costs at most the one being written.

Each demonstration is first a file of its own in the folder `<file>.parts`, which appears when it is complete and on
the disk. `DemoWriter.finish` joins the parts into the one file and removes them. A part is a demonstration file like
any other: `read_demos` reads it, or the whole folder.
"""

import io
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from textwrap import shorten
from typing import Any

import h5py
import numpy as np
from typing_extensions import Buffer

from libero_env.demos.contents import (
    LOW_DIM_KEYS,
    check_demo,
    demo_motion,
    demo_names,
    demo_number,
    file_attributes,
    is_image,
    value_fault,
)
from libero_env.demos.hdf5 import BrokenDemoError, open_demo_file
from libero_env.demos.read import Episode, demo_files
from libero_env.errors import DemoError
from libero_env.images import flip_rows
from libero_env.storage import atomic_path, own_folder

TAG = "libero-v1"
FRAMES_PER_CHUNK = 8
_CONFIG_KEYS = (  # attributes in which all demonstrations of a file agree
    *("bddl_file_name", "bddl_file_content", "seed", "camera_size", "cameras", "pictures", "drawing"),
    *("pairing", "generator", "disturbed", "variation", "model_digest", "filter", "perturb", "perturb_draws"),
    *("own_models", "backend"),
)
REMEDY = "choose another file or remove this one"


def require_absent(target: Path) -> None:
    """Raise a DemoError where a file or folder that is to be written exists."""
    if target.exists():
        raise DemoError(f"{target} exists; choose another name or remove it")


class OtherRecordingError(DemoError):
    """A file that was recorded with another configuration."""


class DemoWriter:
    """Writes one demonstration file.

    Args:
        header: Attributes of the group `data`; `make_header` makes those of the original.
        agree: Further attributes in which all demonstrations have to agree.
    """

    def __init__(self, path: str | Path, header: Mapping[str, Any], agree: Sequence[str] = ()):
        self.path = Path(path)
        self.parts = self.path.with_name(self.path.name + ".parts")
        self.header, self._agree = dict(header), (*_CONFIG_KEYS, *agree)

    def recorded(self) -> set[int]:
        """Return the numbers of the demonstrations that are complete on disk, in the file or among the parts.

        Raises:
            DemoError: They were recorded with another configuration (task, seed, camera size, ...).
        """
        return {demo_number(name) for _, name in self._sources()}

    def recorded_motion(self) -> dict[int, list[np.ndarray | None]]:
        """Return states and actions of each recorded demonstration, see `demo_motion`, by its number."""
        return {demo_number(name): demo_motion(file, name) for file, name in list(self._sources())}

    def discard_parts(self) -> None:
        """Remove the parts that an interrupted recording left."""
        own_folder(self.path.parent, self.parts.name, error=DemoError)
        if self.parts.is_dir():
            shutil.rmtree(self.parts)

    def write(self, index: int, episode: Episode) -> Path:
        """Write demonstration number `index`; it is complete on the disk when this returns.

        Raises:
            DemoError: It cannot be written (disk full, no permission), or has values that no reader would take;
                earlier demonstrations are intact.
        """
        _check_values(episode, f"{self.path}: demo_{index}")
        own_folder(self.path.parent, self.parts.name, error=DemoError)
        target = self.parts / f"demo_{index:05d}.hdf5"
        try:
            with _new_file(target) as handle:
                data = handle.create_group("data")
                data.attrs.update(self.header)
                self._write_demo(data.create_group(f"demo_{index}"), episode)
                _write_counts(data)
        except (OSError, RuntimeError) as error:  # h5py raises either where the disk is full
            raise DemoError(
                f"{target}: demonstration {index} cannot be written ({error}); earlier ones stay readable in "
                f"{self.parts}. Free some space and start again: recording resumes from there"
            ) from error
        return target

    def finish(self) -> Path:
        """Join all recorded demonstrations into the one file and remove the parts.

        Raises:
            DemoError: Nothing was recorded, or the file cannot be written.
        """
        sources = list(self._sources())
        if not sources:
            raise DemoError(f"{self.path}: no demonstrations were recorded; nothing to write")
        try:
            with _new_file(self.path) as handle:
                data = handle.create_group("data")
                data.attrs.update(self.header)
                for file, name in sorted(sources, key=lambda source: demo_number(source[1])):
                    with h5py.File(file, "r") as part:
                        part.copy(f"data/{name}", data)  # copies compressed bytes as they are
                _write_counts(data)
        except (OSError, RuntimeError) as error:
            raise DemoError(
                f"{self.path}: cannot be written ({error}); all demonstrations are still in {self.parts}"
            ) from error
        shutil.rmtree(self.parts, ignore_errors=True)
        return self.path

    def _sources(self) -> Iterator[tuple[Path, str]]:
        """Yield (file, name) of each complete demonstration.

        A broken part is removed, to be recorded again; a broken file or one of another configuration is refused.
        """
        own_folder(self.path.parent, self.parts.name, error=DemoError)
        seen: set[str] = set()
        if self.path.is_file():
            yield from self._demos_in(self.path, seen)
        for part in demo_files(self.parts) if self.parts.is_dir() else []:
            try:
                yield from self._demos_in(part, seen)
            except BrokenDemoError:
                part.unlink(missing_ok=True)

    def _demos_in(self, file: Path, seen: set[str]) -> Iterator[tuple[Path, str]]:
        with open_demo_file(file) as handle:
            names = demo_names(handle, file)
            for name in names:
                group = handle["data"][name]
                keys = group.get("obs", ()) if isinstance(group, h5py.Group) else ()
                check_demo(group, f"{file}: {name}", keys)
            self._check_header(file, file_attributes(handle, file))
        for name in names:
            if name not in seen:
                seen.add(name)
                yield file, name

    def _check_header(self, file: Path, stated: Mapping[str, Any]) -> None:
        for key in self._agree if self.header else ():
            here, expected = (_plain(values.get(key)) for values in (stated, self.header))
            if here != expected:
                if key in ("model_digest", "own_models", "models"):
                    raise OtherRecordingError(f"{file}: was recorded with other models; {REMEDY}")
                raise OtherRecordingError(
                    f"{file}: was recorded with {key} = {shorten(repr(here), 80)}, not "
                    f"{shorten(repr(expected), 80)}; {REMEDY}"
                )

    def _write_demo(self, group: h5py.Group, episode: Episode) -> None:
        steps = len(episode)
        ends = np.zeros(steps, np.uint8)
        ends[-1] = episode.success
        for name, values in episode.arrays.items():
            group.create_dataset(name, data=np.asarray(values, np.float64))
        for name in ("rewards", "dones"):
            group.create_dataset(name, data=ends)
        self._write_observations(group.create_group("obs"), episode.obs, steps)
        group.attrs["num_samples"] = steps
        group.attrs["init_state"] = np.asarray(episode.states[0], np.float64)
        group.attrs["success"] = bool(episode.success)
        group.attrs.update(episode.attrs)
        if episode.fixtures is not None:
            group.attrs["fixtures"] = episode.fixtures

    def _write_observations(self, group: h5py.Group, obs: Mapping[str, np.ndarray], steps: int) -> None:
        if "ee_pos" in obs and "ee_ori" in obs:
            obs = {**obs, "ee_states": np.concatenate([obs["ee_pos"], obs["ee_ori"]], axis=1)}
        for key, values in obs.items():
            if is_image(key):
                group.create_dataset(
                    key,
                    data=flip_rows(values, 1),
                    chunks=(min(FRAMES_PER_CHUNK, steps), *values.shape[1:]),
                    compression="gzip",  # every reader of HDF5 has it
                    compression_opts=1,
                    shuffle=values.dtype != np.uint8,
                )
            elif key in LOW_DIM_KEYS:
                group.create_dataset(key, data=np.asarray(values, np.float64))


@contextmanager
def _new_file(target: Path) -> Iterator[h5py.File]:
    """Yield a new HDF5 file, which replaces `target` when it is complete and on the disk; see `atomic_path`.

    Raises:
        OSError: It cannot be written, such as to a full disk.
    """
    with atomic_path(target, fsync=True) as temporary, _Disk(temporary, "w+") as disk:
        try:
            with h5py.File(disk, "w") as handle:
                yield handle
        finally:
            if disk.error is not None:
                raise disk.error
        if target.exists():
            shutil.copymode(target, temporary)


class _Disk(io.FileIO):
    """A file for HDF5, which ends the process where a write fails: the first error is kept, what follows is dropped."""

    error: OSError | None = None

    def write(self, content: Buffer) -> int:
        left = memoryview(content)
        while left and self.error is None:
            try:
                left = left[super().write(left) :]
            except OSError as error:
                self.error = error
        return memoryview(content).nbytes

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size) if self.error is None else 0
        except OSError as error:
            self.error = error
            return 0


def make_header(
    *,
    problem_name: str,
    language: str,
    bddl_name: str,
    bddl_text: str,
    env_kwargs: Mapping[str, Any],
    **extra: Any,
) -> dict[str, Any]:
    """Return the attributes of the group `data` as the original has them, and `extra` ones.

    Args:
        problem_name: Name of the problem in the task file, such as `LIBERO_Floor_Manipulation`.
        language: The instruction.
        bddl_name: Path of the task file below `bddl_files`, such as `libero_object/pick_up_..._basket.bddl`.
        env_kwargs: Arguments of the original's environment: robots, controller, cameras, control frequency.
        extra: Further attributes.
    """
    words = problem_name.split("_")
    env_name = "_".join([words[0].capitalize(), *words[1:]])
    info = {
        "problem_name": problem_name.lower(),
        "domain_name": "robosuite",
        "language_instruction": language,
    }
    file_name = f"bddl_files/{bddl_name}"
    args = {"type": 1, "env_name": env_name, "problem_name": info["problem_name"], "bddl_file": file_name}
    return {
        "env_name": env_name,
        "problem_info": json.dumps(info),
        "macros_image_convention": "opengl",
        "bddl_file_name": file_name,
        "bddl_file_content": bddl_text,
        "env_args": json.dumps({**args, "env_kwargs": dict(env_kwargs)}),
        "tag": TAG,
        **extra,
    }


def _write_counts(data: h5py.Group) -> None:
    demos = list(data.values())
    data.attrs["num_demos"] = len(demos)
    data.attrs["total"] = int(sum(group.attrs["num_samples"] for group in demos))
    data.attrs["num_failed_attempts"] = int(sum(group.attrs.get("failed_attempts", 0) for group in demos))


def _check_values(episode: Episode, where: str) -> None:
    for key, values in {**episode.arrays, **episode.obs}.items():
        if fault := value_fault(key, np.asarray(values)):
            raise DemoError(f"{where}/{key} {fault}; it is not written")


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value
