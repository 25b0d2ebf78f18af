"""Recording demonstrations so that a killed process or a full disk costs at most the one being written.

Each demonstration is first a file of its own, written under another name, flushed to the disk and then renamed, in
the folder `<file>.parts` beside the file to be. `DemoWriter.finish` joins the parts into the one file and removes
them. A part is a demonstration file like any other: `read_demos` reads it, or the whole folder.
"""

import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from textwrap import shorten
from typing import Any

import h5py
import numpy as np

from libero_env.demos.read import (
    LOW_DIM_KEYS,
    BrokenDemoError,
    check_demo,
    demo_files,
    demo_names,
    is_picture,
    opened,
)
from libero_env.errors import DemoError

TAG = "libero-v1"
FRAMES_PER_CHUNK = 8
# What demonstrations of one file have in common.
_MADE_WITH = (
    "bddl_file_name",
    "bddl_file_content",
    "seed",
    "camera_size",
    "cameras",
    "pictures",
    "pairing",
    "generator",
    "disturbed",
    "variation",
    "model_digest",
    "filter",
)


@dataclass(frozen=True)
class Episode:
    """What is recorded of one attempt. Images are upright; `libero_env.demos.read` explains the arrays."""

    actions: np.ndarray  # (T, 7)
    states: np.ndarray  # (T, 1 + nq + nv), before each action
    robot_states: np.ndarray | None  # (T, 9)
    obs: Mapping[str, np.ndarray] = field(repr=False)  # agentview_rgb, ..., joint_states, ee_pos, ee_ori, ...
    expert_actions: np.ndarray | None = None  # (T, 7) where the executed ones were disturbed
    success: bool = True
    attrs: Mapping[str, Any] = field(default_factory=dict)  # more attributes of the demonstration's group


class DemoWriter:
    """Writes one demonstration file.

    Args:
        path: the file to be.
        header: attributes of the group `data`; `make_header` makes those of the original.
        compression: "gzip" (level 1 with the shuffle filter; every HDF5 reader has it), "lzf" or None.
    """

    def __init__(self, path: str | Path, header: Mapping[str, Any], *, compression: str | None = "gzip"):
        self.path = Path(path)
        self.parts = self.path.with_name(self.path.name + ".parts")
        self.header = dict(header)
        self.compression = compression

    def recorded(self) -> set[int]:
        """Numbers of the demonstrations that are on disk whole, in the file or among the parts.

        Raises:
            DemoError: what is there was made otherwise (another task, seed, camera size, ...).
        """
        return {int(name[5:]) for _, name in self._sources()}

    def write(self, index: int, episode: Episode) -> Path:
        """Record demonstration number `index`; it is on disk, whole, when this returns.

        Raises:
            DemoError: it cannot be written (disk full, no permission); nothing that was there before is harmed.
        """
        target = self.parts / f"demo_{index:05d}.hdf5"
        partial = target.with_name(f".{target.name}.{os.getpid()}")
        try:
            self.parts.mkdir(parents=True, exist_ok=True)
            with h5py.File(partial, "w") as handle:
                data = handle.create_group("data")
                data.attrs.update(self.header)
                self._write_demo(data.create_group(f"demo_{index}"), episode)
                _count(data)
            _sync(partial)
            partial.replace(target)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise DemoError(
                f"{target}: demonstration {index} cannot be written ({error}); what was recorded before stays "
                f"readable in {self.parts}. Make room and start again, it goes on from there"
            ) from error
        return target

    def finish(self) -> Path:
        """Join everything recorded into the one file and remove the parts.

        Raises:
            DemoError: nothing was recorded, or the file cannot be written.
        """
        sources = list(self._sources())
        if not sources:
            raise DemoError(f"{self.path}: no demonstrations were recorded; nothing to write")
        partial = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            with h5py.File(partial, "w") as handle:
                data = handle.create_group("data")
                data.attrs.update(self.header)
                for file, name in sorted(sources, key=lambda source: int(source[1][5:])):
                    with h5py.File(file, "r") as part:
                        part.copy(f"data/{name}", data)  # copies compressed bytes as they are
                _count(data)
            _sync(partial)
            partial.replace(self.path)
        except OSError as error:
            partial.unlink(missing_ok=True)
            raise DemoError(
                f"{self.path}: cannot be written ({error}); all is still in {self.parts}"
            ) from error
        shutil.rmtree(self.parts, ignore_errors=True)
        return self.path

    def _sources(self) -> Iterator[tuple[Path, str]]:
        """(file, name) of each whole demonstration; a broken part is left out, a broken or foreign file refused."""
        seen: set[str] = set()
        if self.path.is_file():
            yield from self._demos_in(self.path, seen)
        for part in demo_files(self.parts) if self.parts.is_dir() else []:
            try:
                yield from self._demos_in(part, seen)
            except BrokenDemoError:
                part.unlink(missing_ok=True)  # to be recorded again

    def _demos_in(self, file: Path, seen: set[str]) -> Iterator[tuple[Path, str]]:
        with opened(file) as handle:
            names = demo_names(handle, file)
            for name in names:
                check_demo(handle["data"][name], file, name, handle["data"][name].get("obs", ()))
            self._check_header(file, dict(handle["data"].attrs))
        for name in names:
            if name not in seen:
                seen.add(name)
                yield file, name

    def _check_header(self, file: Path, found: Mapping[str, Any]) -> None:
        for key in _MADE_WITH if self.header else ():
            here, wanted = (_plain(values.get(key)) for values in (found, self.header))
            if here != wanted:
                raise DemoError(
                    f"{file}: was recorded with {key} = {shorten(repr(here), 80)}, not {shorten(repr(wanted), 80)}; "
                    f"choose another file or remove this one"
                )

    def _write_demo(self, group: h5py.Group, episode: Episode) -> None:
        steps = len(episode.actions)
        ends = np.zeros(steps, np.uint8)
        ends[-1] = episode.success
        put = group.create_dataset
        put("actions", data=np.asarray(episode.actions, np.float64))
        if episode.expert_actions is not None:
            put("expert_actions", data=np.asarray(episode.expert_actions, np.float64))
        put("states", data=np.asarray(episode.states, np.float64))
        if episode.robot_states is not None:
            put("robot_states", data=np.asarray(episode.robot_states, np.float64))
        put("rewards", data=ends)
        put("dones", data=ends)
        obs = group.create_group("obs")
        for key, values in _with_ee_states(episode.obs).items():
            if is_picture(key):
                obs.create_dataset(
                    key,
                    data=values[:, ::-1],
                    chunks=(min(FRAMES_PER_CHUNK, steps), *values.shape[1:]),
                    compression=self.compression,
                    compression_opts=1 if self.compression == "gzip" else None,
                    shuffle=self.compression is not None and values.dtype != np.uint8,
                )
            elif key in LOW_DIM_KEYS:
                obs.create_dataset(key, data=np.asarray(values, np.float64))
        group.attrs["num_samples"] = steps
        group.attrs["init_state"] = np.asarray(episode.states[0], np.float64)
        group.attrs["success"] = bool(episode.success)
        group.attrs.update(episode.attrs)


def make_header(
    *,
    problem_name: str,
    language: str,
    bddl_name: str,
    bddl_text: str,
    env_kwargs: Mapping[str, Any],
    **more: Any,
) -> dict[str, Any]:
    """Attributes of the group `data` as the original has them, and `more` of one's own.

    Args:
        problem_name: as in the task file, e.g. `LIBERO_Floor_Manipulation`.
        language: the instruction.
        bddl_name: `libero_object/pick_up_..._basket.bddl`.
        bddl_text: the task file.
        env_kwargs: robots, controller, cameras, control frequency.
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
        **more,
    }


def _count(data: h5py.Group) -> None:
    demos = [group for name, group in data.items() if name.startswith("demo_")]
    data.attrs["num_demos"] = len(demos)
    data.attrs["total"] = int(sum(group.attrs["num_samples"] for group in demos))
    data.attrs["num_failed_attempts"] = int(sum(group.attrs.get("failed_attempts", 0) for group in demos))


def _with_ee_states(obs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    if "ee_pos" in obs and "ee_ori" in obs:
        return {**obs, "ee_states": np.concatenate([obs["ee_pos"], obs["ee_ori"]], axis=1)}
    return dict(obs)


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _sync(path: Path) -> None:
    """Make sure that the file is on the disk before it gets its name."""
    with open(path, "rb+") as handle:
        os.fsync(handle.fileno())
