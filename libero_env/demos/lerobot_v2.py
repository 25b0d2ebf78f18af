"""Writer of LeRobot data sets v2.0: a Parquet file for each episode, with its images as PNG."""

import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from libero_env.demos.lerobot_files import import_arrow
from libero_env.demos.lerobot_layout import (
    FILES_PER_CHUNK,
    INDICES,
    ROBOT_TYPE,
    ExportedEpisode,
    Layout,
    episode_columns,
)
from libero_env.demos.lerobot_v3 import check_shapes, write_json
from libero_env.demos.statistics import ImageStatistics, NumberStatistics
from libero_env.errors import DemoError
from libero_env.storage import atomic_write_text

_DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_STATISTICS = ("max", "mean", "min", "std")


class ImageDatasetWriter:
    """Writes a data set episode by episode.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.
    """

    def __init__(self, root: Path, layout: Layout):
        self._pa, self._pq = import_arrow()
        self.root, self.layout, self._frames = root, layout, 0
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._stats: dict[str, Any] = {}  # NumberStatistics or ImageStatistics

    def add(self, episode: ExportedEpisode, language: str) -> None:
        """Append an episode."""
        images = {self.layout.image_feature(key): frames for key, frames in episode.images.items()}
        self._shapes = check_shapes(self._shapes, images, episode.where)
        number, steps = len(self._episodes), len(episode.action)
        task = self._tasks.setdefault(language, len(self._tasks))
        columns = episode_columns(self.layout, episode, number, self._frames, task)
        self._write_table(number, columns, images)
        own: dict[str, Any] = {key: NumberStatistics.from_values(values) for key, values in columns.items()}
        own |= {key: ImageStatistics.from_frames(frames) for key, frames in images.items()}
        for key, stats in own.items():
            self._stats[key] = stats if key not in self._stats else self._stats[key] + stats
        self._episodes.append({"episode_index": number, "tasks": [language], "length": steps})
        self._frames += steps

    def _write_table(
        self, number: int, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray]
    ) -> None:
        pa = self._pa
        arrays = {key: self._images(frames) for key, frames in images.items()}
        for key, values in columns.items():
            flat = pa.array(values.ravel())
            arrays[key] = (
                pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim == 2 else flat
            )
        schema = {"info": {"features": self._hub_features()}}  # by which `datasets` decodes the images
        table = pa.table(arrays).replace_schema_metadata({"huggingface": json.dumps(schema)})
        path = self.root / _DATA_PATH.format(episode_chunk=number // FILES_PER_CHUNK, episode_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._pq.write_table(table, path)

    def _images(self, frames: np.ndarray) -> Any:
        pa = self._pa
        kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        rows = [{"bytes": _png(frame), "path": f"frame_{t:06d}.png"} for t, frame in enumerate(frames)]
        return pa.array(rows, kind)

    def _hub_features(self) -> dict[str, Any]:
        layout = self.layout
        found: dict[str, Any] = {key: {"_type": "Image"} for key in self._shapes}
        number = {"dtype": "float32", "_type": "Value"}
        for key, length in ((layout.state, 8), (layout.action, 7)):
            found[key] = {"feature": number, "length": length, "_type": "Sequence"}
        found["timestamp"] = number
        return found | {key: {"dtype": "int64", "_type": "Value"} for key in INDICES}

    def close(self) -> None:
        """Do nothing: every file is complete when its episode has been added."""

    def finish(self) -> tuple[int, int]:
        """Write the metadata of the data set; return the number of episodes and the number of frames."""
        if not self._episodes:
            raise DemoError("no demonstrations to export")
        meta = self.root / "meta"
        _write_lines(meta / "episodes.jsonl", self._episodes)
        tasks = ({"task_index": index, "task": task} for task, index in self._tasks.items())
        _write_lines(meta / "tasks.jsonl", tasks)
        summaries = {key: stats.summary() for key, stats in self._stats.items()}
        write_json(
            meta / "stats.json", {key: {n: found[n] for n in _STATISTICS} for key, found in summaries.items()}
        )
        write_json(meta / "info.json", self._info())
        return len(self._episodes), self._frames

    def _info(self) -> dict[str, Any]:
        count = len(self._episodes)
        return {
            "codebase_version": self.layout.version,
            "robot_type": ROBOT_TYPE,
            "total_episodes": count,
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "total_videos": 0,
            "total_chunks": -(-count // FILES_PER_CHUNK),
            "chunks_size": FILES_PER_CHUNK,
            "fps": self.layout.fps,
            "splits": {"train": f"0:{count}"},
            "data_path": _DATA_PATH,
            "video_path": _VIDEO_PATH,
            "features": self.layout.features(self._shapes),
        }


def _png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def _write_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    atomic_write_text(path, "".join(json.dumps(row) + "\n" for row in rows))
