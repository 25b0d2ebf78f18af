"""Writer of LeRobot data sets v3.0: numbers in Parquet, images in MP4, many episodes to a file."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.lerobot_files import DATA_PATH, VIDEO_PATH, CameraVideo, ParquetTable, import_arrow
from libero_env.demos.lerobot_layout import (
    FILES_PER_CHUNK,
    ROBOT_TYPE,
    ExportedEpisode,
    Layout,
    episode_columns,
)
from libero_env.demos.statistics import ImageStatistics, NumberStatistics
from libero_env.demos.video import import_av
from libero_env.errors import DemoError
from libero_env.storage import atomic_write_text

_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"


class DatasetWriter:
    """Writes a data set episode by episode.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.
        video_mb: Size from which a video is continued in another file, [MiB]; None is that of the layout.
    """

    def __init__(self, root: Path, layout: Layout, video_mb: float | None = None):
        self._pa, self._pq = import_arrow()
        import_av()
        self.root, self.layout, self._frames = root, layout, 0
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._videos: dict[str, CameraVideo] = {}
        self._video_mb = layout.video_mb if video_mb is None else video_mb
        self._data = ParquetTable(root, layout.data_mb)
        self._stats: dict[str, Any] = {}  # NumberStatistics or ImageStatistics

    def add(self, episode: ExportedEpisode, language: str) -> None:
        """Append an episode."""
        images = {self.layout.image_feature(key): frames for key, frames in episode.images.items()}
        self._shapes = check_shapes(self._shapes, images, episode.where)
        number, first = len(self._episodes), self._frames
        task = self._tasks.setdefault(language, len(self._tasks))
        columns = episode_columns(self.layout, episode, number, first, task)
        steps = len(episode.action)
        entry: dict[str, Any] = {"episode_index": number, "tasks": [language], "length": steps}
        entry |= self._data.add(columns)
        entry |= {"dataset_from_index": first, "dataset_to_index": first + steps}
        for key, frames in images.items():
            entry |= self._video(key).add(frames)
        entry |= self._add_statistics(columns, images)
        self._episodes.append({**entry, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0})
        self._frames += steps

    def _video(self, key: str) -> CameraVideo:
        if key not in self._videos:
            assert self.layout.codec is not None
            self._videos[key] = CameraVideo(
                self.root, key, self._video_mb, self.layout.fps, self.layout.codec
            )
        return self._videos[key]

    def _add_statistics(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray]
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
        write_json(meta / "stats.json", {key: stats.summary() for key, stats in self._stats.items()})
        write_json(meta / "info.json", self._info())
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
        layout = self.layout
        return {
            "codebase_version": layout.version,
            "robot_type": ROBOT_TYPE,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": layout.data_mb,
            "video_files_size_in_mb": layout.video_mb,
            "fps": float(layout.fps) if layout.states_fps else layout.fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH if self._shapes else None,
            "features": layout.features(self._shapes),
        }


def check_shapes(
    expected: dict[str, tuple[int, ...]], images: Mapping[str, np.ndarray], where: str
) -> dict[str, tuple[int, ...]]:
    """Return the shapes of images, (height, width, channels).

    Args:
        expected: Shapes of the episodes before; empty for the first one.
        images: Feature -> (T, H, W, 3).
        where: File and demonstration, for the error message.

    Raises:
        DemoError: They are not those of the episodes before.
    """
    shapes = {key: frames.shape[1:] for key, frames in images.items()}
    if expected and shapes != expected:
        raise DemoError(f"{where} has images {shapes}; expected {expected} as in the first")
    return shapes


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON that people can read."""
    atomic_write_text(path, json.dumps(content, indent=4))
