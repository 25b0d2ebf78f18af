"""Reader of LeRobot data sets, v2 and v3.0, by PyArrow and PyAV."""

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from PIL import Image
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.demos.hdf5 import BrokenDemoError, damage_named
from libero_env.demos.read import Episode
from libero_env.errors import DemoError, need
from libero_env.memory import require_memory
from libero_env.storage import read_json, regular_file
from libero_env.validation import validate
from libero_integrations.exports.layouts import PUBLISHED, RECORDED, Layout
from libero_integrations.exports.lerobot import DATA_PATH, V2_DATA_PATH, V2_VIDEO_PATH, VIDEO_PATH

_NAMES = {
    tuple(one.state_names) for one in (*PUBLISHED.values(), *RECORDED.values())
}  # of the 8 numbers of state

_MAX_BYTES = 1 << 30  # of a list of episodes


class _Info(TypedDict):
    codebase_version: str
    fps: Annotated[float, Field(gt=0)]
    data_path: str
    features: dict[str, dict[str, Any]]
    chunks_size: Annotated[int, Field(gt=0)]


class LeRobotSet:
    """A LeRobot data set. `layout` is the published one whose features it has, or None.

    Args:
        root: Its folder.

    Raises:
        DemoError: It is of another version, has no 8 numbers of state whose names are known, or no 7 of action.
        LiberoError: PyArrow is not installed.
    """

    def __init__(self, root: Path):
        self.root, self._parquet = root, need("pyarrow.parquet")
        file = root / "meta/info.json"
        stated = read_json(file, DemoError)
        known = {key: stated[key] for key in _Info.__annotations__ if key in stated}
        info: _Info = validate(_Info, known, source=str(file), error=DemoError)
        self._fps, self._chunk, features = info["fps"], info["chunks_size"], info["features"]
        version = info["codebase_version"]
        self._is_v3 = version.startswith("v3.")
        paths = (DATA_PATH, VIDEO_PATH) if self._is_v3 else (V2_DATA_PATH, V2_VIDEO_PATH)
        if not version.startswith(("v2.", "v3.")) or info["data_path"] != paths[0]:
            place = info["data_path"]
            raise DemoError(
                f"{file} has version {version!r}, data in {place!r}; expected v2 or v3.0 of LeRobot"
            )
        self._data, self._video = paths
        kinds = {key: feature.get("dtype") for key, feature in features.items() if "/" not in key}
        self._images = {key: kind for key, kind in kinds.items() if kind in ("image", "video")}
        self._state, self._action = (
            next((key for key in names if key in features), names[0])
            for names in (("observation.state", "state"), ("action", "actions"))
        )
        named = {key: _names(features.get(key, {})) for key in (self._state, self._action)}
        if named[self._state] not in _NAMES:
            raise DemoError(
                f"{file}: {self._state} is {', '.join(named[self._state]) or 'not there'}; expected the position of "
                "the grip site, its rotation vector and two fingers, with the names of libero demos export"
            )
        seen = (self._state, self._action, *named.values(), set(self._images))
        self.layout = next((one for one in PUBLISHED.values() if _features(one) == seen), None)

    def episodes(self) -> Iterator[tuple[str, Callable[[], Episode]]]:
        """Yield the instruction of each episode, and what reads it."""
        for row in self._rows():
            with damage_named(f"{self.root}/meta"):
                number, (instruction,) = int(row["episode_index"]), row["tasks"]
                yield instruction, partial(self._read, number, row)

    def _rows(self) -> Iterator[Mapping[str, Any]]:
        """Yield what the metadata say of each episode."""
        if not self._is_v3:
            file, opener = self.root / "meta/episodes.jsonl", regular_file(_MAX_BYTES)
            with damage_named(str(file)), open(file, encoding="utf-8", opener=opener) as lines:
                yield from map(json.loads, lines)
        for file in sorted(self.root.glob("meta/episodes/*/*.parquet")) if self._is_v3 else ():
            with damage_named(str(file)):
                names = [n for n in self._parquet.read_schema(file).names if not n.startswith("stats/")]
                yield from self._parquet.read_table(file, columns=names).to_pylist()

    def _read(self, number: int, row: Mapping[str, Any]) -> Episode:
        where = f"{self.root}: episode {number}"
        with damage_named(where):
            file = self.root / self._data.format(**self._place(row, "data/"))
            table = self._parquet.read_table(file, filters=[("episode_index", "=", number)])
            state, actions = (
                np.array(table[key].to_pylist(), np.float32) for key in (self._state, self._action)
            )
            if table["frame_index"].to_pylist() != list(range(int(row["length"]))) or state.shape[1:] != (8,):
                raise BrokenDemoError(
                    f"{where} has {len(table)} frames, {state.shape} of state; the set is damaged"
                )
            obs = {"ee_pos": state[:, :3], "ee_ori": state[:, 3:6], "gripper_states": state[:, 6:]}
            for key, kind in self._images.items():
                if kind == "image":
                    obs[key] = decode_images([one["bytes"] for one in table[key].to_pylist()], where)
                else:
                    path = self.root / self._video.format(video_key=key, **self._place(row, f"videos/{key}/"))
                    start = float(row.get(f"videos/{key}/from_timestamp", 0.0))
                    obs[key] = read_frames(path, start, len(table), self._fps)
            rewards = table["next.reward"].to_pylist() if "next.reward" in table.column_names else [1.0]
            name, none = f"episode {number}", np.zeros((len(table), 0))
            return Episode(actions, none, obs=obs, success=rewards[-1] > 0, name=name)

    def _place(self, row: Mapping[str, Any], prefix: str) -> dict[str, int]:
        """Return what the names of an episode's files are made of."""
        if self._is_v3:
            return {key: int(row[prefix + key]) for key in ("chunk_index", "file_index")}
        number = int(row["episode_index"])
        return {"episode_chunk": number // self._chunk, "episode_index": number}


def _features(layout: Layout) -> tuple[Any, ...]:
    names = tuple(layout.state_names), tuple(layout.action_names)
    return (layout.state, layout.action, *names, set(layout.cameras.values()))


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of a feature's entries, which some sets have in a list under a name."""
    names = feature.get("names") or ()
    names = next(iter(names.values()), ()) if isinstance(names, dict) else names
    return tuple(map(str, names))


def decode_images(codes: Sequence[bytes], where: str) -> np.ndarray:
    """Return the pictures in PNG or JPEG files, (N, H, W, 3) uint8; DemoError where they would not fit into memory."""
    frames: list[np.ndarray] = []
    for code in codes:
        with Image.open(io.BytesIO(code), formats=["PNG", "JPEG"]) as picture:
            _check_size(len(codes), picture.width * picture.height, where)
            frames.append(np.asarray(picture.convert("RGB")))
    return np.stack(frames)


def _check_size(count: int, pixels: int, where: str) -> None:
    require_memory(count * pixels * 3, f"{where}: its images", "use smaller ones", DemoError)


def read_frames(path: Path, start: float, count: int, fps: float) -> np.ndarray:
    """Return frames of a video from a time [s] on, (count, H, W, 3) uint8.

    Raises:
        BrokenDemoError: There are fewer, or they are not at the times that follow from the frames per second.
        DemoError: They would not fit into memory.
    """
    frames: list[np.ndarray] = []
    with need("av").open(str(path)) as video:
        (stream,) = video.streams.video
        video.seek(int(start / stream.time_base), stream=stream)
        _check_size(count, stream.width * stream.height, str(path))
        for frame in video.decode(video=0):
            shift = (frame.time - start) * fps - len(frames)  # [frames]
            if abs(shift) > 0.5 and not (shift < 0 and not frames):
                break
            if abs(shift) <= 0.5:
                frames.append(frame.to_ndarray(format="rgb24"))
            if len(frames) == count:
                return np.stack(frames)
    raise BrokenDemoError(f"{path} has no {count} frames from {start:g} s on at {fps:g} per second")
