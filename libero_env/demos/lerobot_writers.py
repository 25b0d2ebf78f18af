"""Writers of LeRobot data sets: v3.0 with many episodes to a Parquet or MP4 file, v2.0 with a file for each.

Statistics can be added over episodes; those of images follow from the histograms of their channels.
"""

import io
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from libero_env.demos.contents import EXPORTED_STATE
from libero_env.demos.lerobot_layout import INDICES, Layout
from libero_env.demos.read import Episode
from libero_env.demos.video import H264, Codec, Mp4Writer, import_av
from libero_env.errors import DemoError, LiberoError
from libero_env.storage import atomic_write_text

ROBOT_TYPE = "panda"
FILES_PER_CHUNK = 1000
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
_V2_DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
_V2_VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_V2_STATISTICS = ("max", "mean", "min", "std")
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_QUANTILE_NAMES = tuple(f"q{round(100 * q):02d}" for q in QUANTILES)


@dataclass(frozen=True)
class NumberStatistics:
    """Statistics of numbers, over the first axis.

    Attributes:
        samples: The numbers, each array (N, D) float64.
    """

    samples: tuple[np.ndarray, ...]

    @classmethod
    def from_values(cls, values: np.ndarray) -> "NumberStatistics":
        """Return the statistics of values (N,) or (N, D)."""
        return cls((values.reshape(len(values), -1).astype(np.float64),))

    def __add__(self, other: "NumberStatistics") -> "NumberStatistics":
        return NumberStatistics(self.samples + other.samples)

    def summary(self) -> dict[str, list]:
        """Return each statistic as D numbers, by name; `count` is one number."""
        x = np.concatenate(self.samples)
        summary = {"min": x.min(axis=0), "max": x.max(axis=0), "mean": x.mean(axis=0), "std": x.std(axis=0)}
        summary |= dict(zip(_QUANTILE_NAMES, np.quantile(x, QUANTILES, axis=0), strict=True))
        return {**{key: value.tolist() for key, value in summary.items()}, "count": [len(x)]}


@dataclass(frozen=True)
class ImageStatistics:
    """Statistics of the colours of images, which follow exactly from the histograms of the channels.

    Attributes:
        counts: Number of pixels of each channel and value, (3, 256) int64.
        frames: Number of images.
    """

    counts: np.ndarray
    frames: int

    @classmethod
    def from_frames(cls, frames: np.ndarray) -> "ImageStatistics":
        """Return the statistics of frames (T, H, W, 3) uint8."""
        counts = [np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)]
        return cls(np.array(counts, np.int64), len(frames))

    def __add__(self, other: "ImageStatistics") -> "ImageStatistics":
        return ImageStatistics(self.counts + other.counts, self.frames + other.frames)

    def summary(self) -> dict[str, list]:
        """Return each statistic as nested lists (3, 1, 1) in [0, 1], by name; `count` is the number of frames."""
        levels, total = np.arange(256) / 255.0, self.counts.sum(axis=1)
        below = np.cumsum(self.counts, axis=1)
        mean = self.counts @ levels / total
        std = np.sqrt(np.maximum(self.counts @ levels**2 / total - mean**2, 0.0))
        summary = {"min": levels[(self.counts > 0).argmax(axis=1)], "mean": mean, "std": std}
        summary["max"] = levels[255 - (self.counts[:, ::-1] > 0).argmax(axis=1)]
        for name, q in zip(_QUANTILE_NAMES, QUANTILES, strict=True):
            summary[name] = levels[(below >= q * total[:, None]).argmax(axis=1)]
        return {
            **{key: value.reshape(3, 1, 1).tolist() for key, value in summary.items()},
            "count": [self.frames],
        }


class _Writer:
    """Base of the writers: what they count, and the statistics of the data set.

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

    def add(self, episode: Episode, language: str, where: str) -> None:
        """Append an episode.

        Args:
            episode: Its actions and observations; other observations than images and `EXPORTED_STATE` are left out.
            language: The instruction.
            where: File and demonstration, for error messages.

        Raises:
            DemoError: It has other images than the episodes before.
        """
        images = {
            self.layout.image_feature(key): frames
            for key, frames in episode.obs.items()
            if key.endswith("_rgb")
        }
        shapes = {key: frames.shape[1:] for key, frames in images.items()}
        if self._shapes and shapes != self._shapes:
            raise DemoError(f"{where} has images {shapes}; expected {self._shapes} as in the first")
        self._shapes = shapes
        columns = self._columns(episode, self._tasks.setdefault(language, len(self._tasks)))
        stats: dict[str, Any] = {key: NumberStatistics.from_values(values) for key, values in columns.items()}
        stats |= {key: ImageStatistics.from_frames(frames) for key, frames in images.items()}
        for key, one in stats.items():
            self._stats[key] = one if key not in self._stats else self._stats[key] + one
        entry = {"episode_index": len(self._episodes), "tasks": [language], "length": len(episode)}
        self._episodes.append(entry | self._write(columns, images, stats))
        self._frames += len(episode)

    def finish(self) -> tuple[int, int]:
        """Write the metadata of the data set; return the number of episodes and the number of frames."""
        if not self._episodes:
            raise DemoError("no demonstrations to export")
        summaries = {key: stats.summary() for key, stats in self._stats.items()}
        self._write_metadata(self.root / "meta", summaries)
        return len(self._episodes), self._frames

    def _columns(self, episode: Episode, task: int) -> dict[str, np.ndarray]:
        """Return the columns of the next episode, without images."""
        steps, layout = len(episode), self.layout
        state = np.concatenate([episode.obs[key] for key in EXPORTED_STATE], axis=1)
        columns = {
            layout.state: state.astype(np.float32),
            layout.action: episode.actions.astype(np.float32),
            "timestamp": (np.arange(steps) / layout.fps).astype(np.float32),
        }
        if layout.outcome:
            last = np.arange(steps) == steps - 1
            columns |= {"next.reward": (last * float(episode.success)).astype(np.float32), "next.done": last}
        return columns | {
            "frame_index": np.arange(steps),
            "episode_index": np.full(steps, len(self._episodes)),
            "index": self._frames + np.arange(steps),
            "task_index": np.full(steps, task),
        }

    def _info(self, **more: Any) -> dict[str, Any]:
        return {
            "codebase_version": self.layout.version,
            "robot_type": ROBOT_TYPE,
            "total_episodes": len(self._episodes),
            "total_frames": self._frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            "fps": float(self.layout.fps) if self.layout.states_fps else self.layout.fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "features": self.layout.features(self._shapes),
            **more,
        }

    def _write(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray], stats: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Write the next episode; return what the table of episodes says about it beside its length and task."""
        raise NotImplementedError

    def _write_metadata(self, meta: Path, summaries: Mapping[str, Mapping[str, Any]]) -> None:
        raise NotImplementedError

    def close(self) -> None:
        """Close all files."""


class ImageDatasetWriter(_Writer):
    """Writes a data set v2.0: a Parquet file for each episode, with its images as PNG."""

    def _write(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray], _: Mapping[str, Any]
    ) -> dict[str, Any]:
        number = len(self._episodes)
        arrays = {key: self._image_array(frames) for key, frames in images.items()}
        arrays |= _arrays(self._pa, columns)
        schema = {"info": {"features": self._hub_features()}}  # by which `datasets` decodes the images
        table = self._pa.table(arrays).replace_schema_metadata({"huggingface": json.dumps(schema)})
        path = self.root / _V2_DATA_PATH.format(episode_chunk=number // FILES_PER_CHUNK, episode_index=number)
        path.parent.mkdir(parents=True, exist_ok=True)
        self._pq.write_table(table, path)
        return {}

    def _image_array(self, frames: np.ndarray) -> Any:
        pa = self._pa
        kind = pa.struct({"bytes": pa.binary(), "path": pa.string()})
        rows = [{"bytes": _png(frame), "path": f"frame_{t:06d}.png"} for t, frame in enumerate(frames)]
        return pa.array(rows, kind)

    def _hub_features(self) -> dict[str, Any]:
        layout = self.layout
        features: dict[str, Any] = {key: {"_type": "Image"} for key in self._shapes}
        number = {"dtype": "float32", "_type": "Value"}
        for key, length in ((layout.state, 8), (layout.action, 7)):
            features[key] = {"feature": number, "length": length, "_type": "Sequence"}
        features["timestamp"] = number
        return features | {key: {"dtype": "int64", "_type": "Value"} for key in INDICES}

    def _write_metadata(self, meta: Path, summaries: Mapping[str, Mapping[str, Any]]) -> None:
        tasks = ({"task_index": index, "task": task} for task, index in self._tasks.items())
        _write_lines(meta / "episodes.jsonl", self._episodes)
        _write_lines(meta / "tasks.jsonl", tasks)
        stats = {key: {name: one[name] for name in _V2_STATISTICS} for key, one in summaries.items()}
        write_json(meta / "stats.json", stats)
        info = self._info(
            total_videos=0,
            total_chunks=-(-len(self._episodes) // FILES_PER_CHUNK),
            data_path=_V2_DATA_PATH,
            video_path=_V2_VIDEO_PATH,
        )
        write_json(meta / "info.json", info)


class VideoDatasetWriter(_Writer):
    """Writes a data set v3.0: numbers in Parquet, images in MP4, many episodes to a file.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.
        video_mb: Size from which a video is continued in another file, [MiB]; None is that of the layout.
    """

    def __init__(self, root: Path, layout: Layout, video_mb: float | None = None):
        super().__init__(root, layout)
        import_av()
        self._videos: dict[str, CameraVideo] = {}
        self._video_mb = layout.video_mb if video_mb is None else video_mb
        self._data = ParquetTable(root, layout.data_mb)

    def _write(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray], stats: Mapping[str, Any]
    ) -> dict[str, Any]:
        steps, first = len(columns["index"]), self._frames
        entry = self._data.add(columns)
        entry |= {"dataset_from_index": first, "dataset_to_index": first + steps}
        for key, frames in images.items():
            entry |= self._video(key).add(frames)
        for key, one in stats.items():
            entry |= {f"stats/{key}/{name}": value for name, value in one.summary().items()}
        return {**entry, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}

    def _video(self, key: str) -> "CameraVideo":
        if key not in self._videos:
            codec = self.layout.codec or H264
            self._videos[key] = CameraVideo(self.root, key, self._video_mb, self.layout.fps, codec)
        return self._videos[key]

    def close(self) -> None:
        """Close all files."""
        self._data.close()
        for video in self._videos.values():
            video.close()

    def _write_metadata(self, meta: Path, summaries: Mapping[str, Mapping[str, Any]]) -> None:
        (self.root / _EPISODES_PATH).parent.mkdir(parents=True)
        self._pq.write_table(self._pa.Table.from_pylist(self._episodes), self.root / _EPISODES_PATH)
        self._pq.write_table(self._task_table(), meta / "tasks.parquet")
        write_json(meta / "stats.json", summaries)
        info = self._info(
            data_files_size_in_mb=self.layout.data_mb,
            video_files_size_in_mb=self.layout.video_mb,
            data_path=DATA_PATH,
            video_path=VIDEO_PATH if self._shapes else None,
        )
        write_json(meta / "info.json", info)

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


def import_arrow() -> tuple[ModuleType, ModuleType]:
    """Import PyArrow and return it with its module for Parquet.

    Raises:
        LiberoError: PyArrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise LiberoError("the export needs PyArrow: pip install 'libero-lifelong[export]'") from error
    return pyarrow, pyarrow.parquet


class _GrowingFile:
    """A file that episodes are appended to, and that is continued in another one when it is large.

    Args:
        root: Folder of the data set.
        pattern: Path of a file in it, with chunk and index.
        limit_mb: Size from which a file is continued in another one, [MiB].
    """

    _writer: Any

    def __init__(self, root: Path, pattern: str, limit_mb: float):
        self._root, self._pattern, self._limit_mb = root, pattern, limit_mb
        self._number = 0
        self._writer: Any = None

    def _place(self, size: int) -> tuple[Path, dict[str, int]]:
        """Return the path of the file that the next episode is in, and its indices for the table of episodes.

        Args:
            size: Size of the open file, bytes.
        """
        if size > self._limit_mb * 2**20:
            self.close()
            self._number += 1
        chunk, index = divmod(self._number, FILES_PER_CHUNK)
        place = {"chunk_index": chunk, "file_index": index}
        path = self._root / self._pattern.format(**place)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path, place

    def close(self) -> None:
        """Close the open file. Idempotent."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


class ParquetTable(_GrowingFile):
    """Writes the Parquet files of the data, one row group per episode."""

    def __init__(self, root: Path, limit_mb: float):
        super().__init__(root, DATA_PATH, limit_mb)
        self._pa, self._pq = import_arrow()
        self._bytes = 0

    def add(self, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Append an episode; return the metadata that tell where it is."""
        table = self._pa.table(_arrays(self._pa, columns))
        path, place = self._place(self._bytes)
        if self._writer is None:
            self._writer = self._pq.ParquetWriter(path, table.schema, compression="snappy")
            self._bytes = 0
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return {f"data/{key}": value for key, value in place.items()}


class CameraVideo(_GrowingFile):
    """Writes the MP4 files of a camera.

    Args:
        root: Folder of the data set.
        key: Feature of the camera.
        limit_mb: As for `ParquetTable`.
        fps: Frames per second.
        codec: How frames are encoded.
    """

    def __init__(self, root: Path, key: str, limit_mb: float, fps: int, codec: Codec):
        super().__init__(root, VIDEO_PATH.replace("{video_key}", key), limit_mb)
        self._key, self._fps, self._codec = key, fps, codec

    def add(self, frames: np.ndarray) -> dict[str, Any]:
        """Append an episode; return the metadata that tell where it is."""
        path, place = self._place(self._writer.path.stat().st_size if self._writer is not None else 0)
        if self._writer is None:
            self._writer = Mp4Writer(path, self._fps, self._codec)
        first = self._writer.frames
        self._writer.add(frames)
        times = {"from_timestamp": first / self._fps, "to_timestamp": self._writer.frames / self._fps}
        return {f"videos/{self._key}/{name}": value for name, value in {**place, **times}.items()}


def _arrays(pa: ModuleType, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return columns as arrays of Arrow; rows of a matrix become lists of fixed length."""
    return {
        key: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        if values.ndim == 2
        else pa.array(values)
        for key, values in columns.items()
    }


def _png(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, format="PNG", compress_level=1)
    return buffer.getvalue()


def _write_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    atomic_write_text(path, "".join(json.dumps(row) + "\n" for row in rows))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON that people can read."""
    atomic_write_text(path, json.dumps(content, indent=4))
