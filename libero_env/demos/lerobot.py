"""Demonstrations as a LeRobotDataset v3.0: low-dimensional data in Parquet, images in MP4, many episodes to a file.

Needs the extra `export` (PyArrow and PyAV). Names are those of LeRobot's own LIBERO environment: `observation.state`
(8: grip site position, hand axis-angle, fingers), `action` (7), `observation.images.image` for agentview,
`observation.images.image2` for the hand, `observation.images.<camera>` for others. Images are upright, and each
action is paired with the observation on which it was chosen.
"""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tqdm import tqdm

from libero_env.demos.curate import read_episodes, read_header, recorded_task
from libero_env.demos.lerobot_files import (
    DATA_MB,
    DATA_PATH,
    FILES_PER_CHUNK,
    VIDEO_MB,
    VIDEO_PATH,
    CameraVideo,
    ParquetTable,
    import_arrow,
)
from libero_env.demos.read import BrokenDemoError
from libero_env.demos.statistics import ImageStatistics, NumberStatistics
from libero_env.demos.video import PIXEL_FORMAT, import_av
from libero_env.demos.write import Episode
from libero_env.errors import DemoError
from libero_env.storage import atomic_folder
from libero_env.timing import CONTROL_HZ

VERSION = "v3.0"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_STATE = ("x", "y", "z", "axis_angle1", "axis_angle2", "axis_angle3", "finger1", "finger2")
_ACTION = ("x", "y", "z", "axis_angle1", "axis_angle2", "axis_angle3", "gripper")
_CAMERAS = {"agentview": "image", "eye_in_hand": "image2"}
_INDICES = ("frame_index", "episode_index", "index", "task_index")


def export_lerobot(
    files: Sequence[Path],
    root: Path,
    *,
    labels: Literal["expert", "executed"] = "expert",
    video_mb: float = VIDEO_MB,
    progress: bool | None = None,
) -> tuple[int, int]:
    """Write demonstration files as one data set.

    Args:
        files: Files to read, in this order; all have the same cameras and image size.
        root: Folder to write; it must not exist.
        labels: As for `read_demos`.
        video_mb: Size from which a video is continued in another file, [MiB].
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        Number of episodes and number of frames.

    Raises:
        DemoError: A file is broken or has other images than the first, or the folder exists.
        LiberoError: PyArrow or PyAV is not installed.
    """
    if root.exists():
        raise DemoError(f"{root} exists; choose another folder or remove it")
    with atomic_folder(root) as folder, closing(_DatasetWriter(folder, video_mb)) as dataset:
        for file in tqdm(files, unit="file", disable=None if progress is None else not progress):
            language, pairing = _language(file), read_header(file).get("pairing", "libero")
            for name, episode in read_episodes(file):
                dataset.add(_exported(f"{file}: {name}", episode, pairing, labels), language)
        dataset.close()
        return dataset.finish()


@dataclass(frozen=True)
class _ExportedEpisode:
    """One episode as it is exported.

    Attributes:
        state: (T, 8) float32.
        action: (T, 7) float32.
        success: Whether the goal was reached.
        images: Feature to (T, H, W, 3) uint8.
        where: File and demonstration, for error messages.
    """

    state: np.ndarray
    action: np.ndarray
    success: bool
    images: dict[str, np.ndarray]
    where: str


def _language(file: Path) -> str:
    header = read_header(file)
    try:
        return json.loads(header["problem_info"])["language_instruction"]
    except (KeyError, ValueError):
        return recorded_task(file).language


def _exported(where: str, episode: Episode, pairing: str, labels: str) -> _ExportedEpisode:
    actions = episode.labels if labels == "expert" else episode.actions
    obs = episode.obs
    for key in ("ee_pos", "ee_ori", "gripper_states"):
        if key not in obs:
            raise BrokenDemoError(f"{where}/obs/{key} is missing; expected it beside {', '.join(obs)}")
    if pairing == "libero":  # the observation before action t + 1 is the one after action t
        obs, actions = {key: values[:-1] for key, values in obs.items()}, actions[1:]
    if not len(actions):
        raise BrokenDemoError(f"{where} has one step; expected a second one to pair it with")
    state = np.concatenate([obs["ee_pos"], obs["ee_ori"], obs["gripper_states"]], axis=1).astype(np.float32)
    images = {feature_name(key): values for key, values in obs.items() if key.endswith("_rgb")}
    return _ExportedEpisode(state, actions.astype(np.float32), episode.success, images, where)


def feature_name(key: str) -> str:
    """Return the data set's name of a camera's images: `eye_in_hand_rgb` -> `observation.images.image2`."""
    camera = key.removesuffix("_rgb")
    return f"observation.images.{_CAMERAS.get(camera, camera)}"


class _DatasetWriter:
    """Writes a data set episode by episode."""

    def __init__(self, root: Path, video_mb: float):
        self._pa, self._pq = import_arrow()
        import_av()
        self.root, self._frames = root, 0
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._videos: dict[str, CameraVideo] = {}
        self._video_mb = video_mb
        self._data = ParquetTable(root)
        self._stats: dict[str, Any] = {}  # NumberStatistics or ImageStatistics

    def add(self, episode: _ExportedEpisode, language: str) -> None:
        """Append an episode."""
        shapes = {key: frames.shape[1:] for key, frames in episode.images.items()}
        self._shapes = self._shapes or shapes
        if shapes != self._shapes:
            raise DemoError(f"{episode.where} has images {shapes}; expected {self._shapes} as in the first")
        number, steps = len(self._episodes), len(episode.action)
        task = self._tasks.setdefault(language, len(self._tasks))
        first = self._frames
        columns = {
            "observation.state": episode.state,
            "action": episode.action,
            "timestamp": (np.arange(steps) / CONTROL_HZ).astype(np.float32),
            "next.reward": np.append(np.zeros(steps - 1), float(episode.success)).astype(np.float32),
            "next.done": np.append(np.zeros(steps - 1, bool), True),
            "frame_index": np.arange(steps),
            "episode_index": np.full(steps, number),
            "index": first + np.arange(steps),
            "task_index": np.full(steps, task),
        }
        entry: dict[str, Any] = {"episode_index": number, "tasks": [language], "length": steps}
        entry |= self._data.add(columns)
        entry |= {"dataset_from_index": first, "dataset_to_index": first + steps}
        for key, frames in episode.images.items():
            if key not in self._videos:
                self._videos[key] = CameraVideo(self.root, key, self._video_mb)
            entry |= self._videos[key].add(frames)
        entry |= self._add_statistics(columns, episode.images)
        self._episodes.append({**entry, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        self._frames += steps

    def _add_statistics(
        self, columns: dict[str, np.ndarray], images: dict[str, np.ndarray]
    ) -> dict[str, Any]:
        """Return the statistics of an episode, and add them to those of the data set."""
        own: dict[str, Any] = {key: NumberStatistics.from_values(values) for key, values in columns.items()}
        own |= {key: ImageStatistics.from_frames(frames) for key, frames in images.items()}
        for key, stats in own.items():
            self._stats[key] = stats if key not in self._stats else self._stats[key] + stats
        return {f"stats/{key}/{name}": v for key, stats in own.items() for name, v in stats.summary().items()}

    def close(self) -> None:
        """Close all files."""
        self._data.close()
        for video in self._videos.values():
            video.close()

    def finish(self) -> tuple[int, int]:
        """Write the metadata of the data set; return the number of episodes and the number of frames."""
        if not self._episodes:
            raise DemoError("no demonstrations to export")
        pa, meta = self._pa, self.root / "meta"
        (self.root / _EPISODES_PATH).parent.mkdir(parents=True)
        self._pq.write_table(pa.Table.from_pylist(self._episodes), self.root / _EPISODES_PATH)
        self._pq.write_table(self._task_table(), meta / "tasks.parquet")
        _write_json(meta / "stats.json", {key: stats.summary() for key, stats in self._stats.items()})
        _write_json(meta / "info.json", self._info())
        return len(self._episodes), self._frames

    def _task_table(self) -> Any:
        """Return the table of task indices; its pandas index are the instructions, as LeRobot expects."""
        pa, integer = self._pa, {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
        table = pa.table(
            {"task_index": pa.array(self._tasks.values(), pa.int64()), "task": list(self._tasks)}
        )
        text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
        pandas = {
            "index_columns": ["task"],
            "column_indexes": [{"name": None, "field_name": None, **text}],
            "columns": [
                {"name": "task_index", "field_name": "task_index", **integer},
                {"name": "task", "field_name": "task", **text},
            ],
            "creator": {"library": "pyarrow", "version": pa.__version__},
            "pandas_version": "2.0.0",
        }
        return table.replace_schema_metadata({"pandas": json.dumps(pandas)})

    def _info(self) -> dict[str, Any]:
        number = {"shape": [1], "names": None}
        features: dict[str, Any] = {key: _video_feature(*shape) for key, shape in self._shapes.items()}
        features |= {
            "observation.state": {"dtype": "float32", "shape": [8], "names": list(_STATE)},
            "action": {"dtype": "float32", "shape": [7], "names": list(_ACTION)},
            "timestamp": {"dtype": "float32", **number},
            "next.reward": {"dtype": "float32", **number},
            "next.done": {"dtype": "bool", **number},
            **{key: {"dtype": "int64", **number} for key in _INDICES},
        }
        return {
            "codebase_version": VERSION,
            "robot_type": "panda",
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": DATA_MB,
            "video_files_size_in_mb": VIDEO_MB,
            "fps": CONTROL_HZ,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self._shapes else None,
            "features": features,
        }


def _video_feature(height: int, width: int, channels: int) -> dict[str, Any]:
    info = {
        "video.height": height,
        "video.width": width,
        "video.channels": channels,
        "video.codec": "h264",
        "video.pix_fmt": PIXEL_FORMAT,
        "video.fps": CONTROL_HZ,
        "video.is_depth_map": False,
        "has_audio": False,
    }
    return {
        "dtype": "video",
        "shape": [height, width, channels],
        "names": ["height", "width", "channel"],
        "info": info,
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=4))
