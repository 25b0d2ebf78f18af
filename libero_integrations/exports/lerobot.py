"""Writers of LeRobot data sets: v3.0 with many episodes to a Parquet or MP4 file, v2 with a file for each.

Statistics of images follow from the histograms of their channels.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from libero_env.curating.video import H264, Mp4Writer, encode_image, import_av
from libero_env.demos.read import Episode
from libero_env.errors import DemoError, need
from libero_env.storage import atomic_write_text
from libero_integrations.exports.layouts import FILES_PER_CHUNK, ROBOT_TYPE, STATE, Layout

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
V2_DATA_PATH = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
V2_VIDEO_PATH = "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4"
_V2_STATISTICS = ("max", "mean", "min", "std")
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_QUANTILE_NAMES = tuple(f"q{round(100 * q):02d}" for q in QUANTILES)


def number_statistics(values: np.ndarray) -> dict[str, list]:
    """Return each statistic of numbers (N,) or (N, D) as D numbers, by name; `count` is one number."""
    x = values.reshape(len(values), -1).astype(np.float64)
    summary = {"min": x.min(axis=0), "max": x.max(axis=0), "mean": x.mean(axis=0), "std": x.std(axis=0)}
    summary |= dict(zip(_QUANTILE_NAMES, np.quantile(x, QUANTILES, axis=0), strict=True))
    return {**{key: value.tolist() for key, value in summary.items()}, "count": [len(x)]}


def colour_counts(frames: np.ndarray) -> np.ndarray:
    """Return how many pixels of frames (T, H, W, 3) uint8 each channel and value has, (3, 256) int64."""
    return np.array([np.bincount(frames[..., channel].ravel(), minlength=256) for channel in range(3)])


def colour_statistics(counts: np.ndarray, frames: int) -> dict[str, list]:
    """Return each statistic of some frames as nested lists (3, 1, 1) in [0, 1], by name; `count` is their number.

    Args:
        counts: As from `colour_counts`, from which the statistics follow exactly.
    """
    levels, total, below = np.arange(256) / 255.0, counts.sum(axis=1), np.cumsum(counts, axis=1)
    mean = counts @ levels / total
    std = np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0.0))
    summary = {"min": levels[(counts > 0).argmax(axis=1)], "mean": mean, "std": std}
    summary["max"] = levels[255 - (counts[:, ::-1] > 0).argmax(axis=1)]
    for name, q in zip(_QUANTILE_NAMES, QUANTILES, strict=True):
        summary[name] = levels[(below >= q * total[:, None]).argmax(axis=1)]
    return {**{key: value.reshape(3, 1, 1).tolist() for key, value in summary.items()}, "count": [frames]}


class DatasetWriter:
    """Base of the writers: the images that all episodes of a data set have.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.

    Attributes:
        numbers: Names of features that images cannot have.
    """

    numbers: ClassVar[tuple[str, ...]] = ()

    def __init__(self, root: Path, layout: Layout):
        self.root, self.layout = root, layout
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._is_first = True

    def _images(self, episode: Episode, where: str) -> dict[str, np.ndarray]:
        """Return the colour images of an episode by feature; DemoError where they are not those of the first."""
        images: dict[str, np.ndarray] = {}
        for key, frames in episode.obs.items():
            if not key.endswith("_rgb"):
                continue
            feature = self.layout.image_feature(key)
            if feature in images or feature in self.numbers:
                raise DemoError(
                    f"{where} has a camera {key.removesuffix('_rgb')!r}, whose feature would be {feature}, which this "
                    "form has already; libero demos rerender draws it under another name"
                )
            if self.layout.codec is not None and any(side % 2 for side in frames.shape[1:3]):
                raise DemoError(
                    f"{where} has images of {frames.shape[1]}x{frames.shape[2]} pixels; videos need an even height and "
                    "width: libero demos rerender --size"
                )
            images[feature] = frames
        lacking = [camera for camera, key in self.layout.cameras.items() if key not in images]
        if lacking and self.layout.version != "v3.0":
            raise DemoError(
                f"{where} has no images of {', '.join(lacking)}, which this form needs; libero demos rerender "
                "draws them"
            )
        shapes = {key: frames.shape[1:] for key, frames in images.items()}
        if not self._is_first and shapes != self._shapes:
            raise DemoError(f"{where} has images {shapes}; expected {self._shapes} as in the first")
        self._shapes, self._is_first = shapes, False
        return images

    def close(self) -> None:
        """Close all files."""


class _LeRobotWriter(DatasetWriter):
    """Base of LeRobot's writers: what they count, and the statistics of the data set."""

    def __init__(self, root: Path, layout: Layout):
        super().__init__(root, layout)
        self._pa, self._pq = need("pyarrow"), need("pyarrow.parquet")
        self._frames = 0
        self._tasks: dict[str, int] = {}
        self._episodes: list[dict[str, Any]] = []
        self._numbers: dict[str, list[np.ndarray]] = {}  # of all episodes, by column
        self._colours: dict[str, np.ndarray] = {}  # see `colour_counts`

    def add(self, episode: Episode, language: str, where: str) -> None:
        """Append an episode.

        Args:
            episode: Its actions and observations; other observations than images and `STATE` are left out.
            language: The instruction.
            where: File and demonstration, for error messages.

        Raises:
            DemoError: It has other images than the episodes before.
        """
        images = self._images(episode, where)
        columns = self._columns(episode, self._tasks.setdefault(language, len(self._tasks)))
        stats = {}
        for key, values in columns.items():
            self._numbers.setdefault(key, []).append(values)
            stats[key] = number_statistics(values)
        for key, frames in images.items():
            counts = colour_counts(frames)
            self._colours[key] = self._colours.get(key, 0) + counts
            stats[key] = colour_statistics(counts, len(frames))
        entry = {"episode_index": len(self._episodes), "tasks": [language], "length": len(episode)}
        self._episodes.append(entry | self._write(columns, images, stats))
        self._frames += len(episode)

    def finish(self) -> tuple[int, int]:
        """Write the metadata of the data set; return the number of episodes and the number of frames."""
        if not self._episodes:
            raise DemoError("no demonstrations to export")
        summaries = {key: number_statistics(np.concatenate(all)) for key, all in self._numbers.items()}
        summaries |= {key: colour_statistics(all, self._frames) for key, all in self._colours.items()}
        self._write_metadata(self.root / "meta", summaries)
        return len(self._episodes), self._frames

    def _columns(self, episode: Episode, task: int) -> dict[str, np.ndarray]:
        """Return the columns of the next episode, without images."""
        steps, layout = len(episode), self.layout
        state = np.concatenate([episode.obs[key] for key in STATE], axis=1)
        actions = episode.actions.astype(np.float32)
        if layout.open_gripper:
            actions[:, -1] = 1.0 - np.clip(actions[:, -1], 0.0, 1.0)
        columns = {
            layout.state: state.astype(np.float32),
            layout.action: actions,
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


class EpisodeDatasetWriter(_LeRobotWriter):
    """Writes a data set v2.0 or v2.1: a Parquet file for each episode, its images as PNG therein or as MP4 beside it.

    Version 2.1 has statistics of each episode, too, and GR00T's meta/modality.json.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.
    """

    def __init__(self, root: Path, layout: Layout):
        super().__init__(root, layout)
        self._statistics: list[dict[str, Any]] = []  # of each episode

    def _write(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray], stats: Mapping[str, Any]
    ) -> dict[str, Any]:
        number, pa, arrays = len(self._episodes), self._pa, {}
        place = {"episode_chunk": number // FILES_PER_CHUNK, "episode_index": number}
        for key, frames in images.items():
            if self.layout.codec is None:
                pictures = [encode_image(frame, "PNG", compress_level=1) for frame in frames]
                rows = [{"bytes": png, "path": f"frame_{t:06d}.png"} for t, png in enumerate(pictures)]
                arrays[key] = pa.array(rows, pa.struct({"bytes": pa.binary(), "path": pa.string()}))
            else:
                path = self._folder(V2_VIDEO_PATH.format(video_key=key, **place))
                with Mp4Writer(path, self.layout.fps, self.layout.codec) as video:
                    video.add(frames)
        arrays |= _arrays(pa, columns)
        schema = {"info": {"features": self._hub_features(arrays)}}  # by which `datasets` decodes the images
        table = pa.table(arrays).replace_schema_metadata({"huggingface": json.dumps(schema)})
        self._pq.write_table(table, self._folder(V2_DATA_PATH.format(**place)))
        self._statistics.append({"episode_index": number, "stats": dict(stats)})
        return {}

    def _folder(self, name: str) -> Path:
        """Return the path of a file in the data set; its folder exists."""
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _hub_features(self, columns: Iterable[str]) -> dict[str, Any]:
        features: dict[str, Any] = {}
        for key, feature in self.layout.features(self._shapes).items():
            value = {"dtype": feature["dtype"], "_type": "Value"}
            if feature["dtype"] == "image":
                features[key] = {"_type": "Image"}
            elif feature["shape"] == [1]:
                features[key] = value
            elif key in columns:  # videos are no columns
                features[key] = {"feature": value, "length": feature["shape"][0], "_type": "Sequence"}
        return features

    def _write_metadata(self, meta: Path, summaries: Mapping[str, Mapping[str, Any]]) -> None:
        tasks = ({"task_index": index, "task": task} for task, index in self._tasks.items())
        _write_lines(meta / "episodes.jsonl", self._episodes)
        _write_lines(meta / "tasks.jsonl", tasks)
        stats, has_videos = summaries, self.layout.codec is not None
        if self.layout.version == "v2.0":
            stats = {key: {name: one[name] for name in _V2_STATISTICS} for key, one in summaries.items()}
        else:
            _write_lines(meta / "episodes_stats.jsonl", self._statistics)
            write_json(meta / "modality.json", self.layout.modality(self._shapes))
        write_json(meta / "stats.json", stats)
        info = self._info(
            total_videos=len(self._episodes) * len(self._shapes) * has_videos,
            total_chunks=-(-len(self._episodes) // FILES_PER_CHUNK),
            data_path=V2_DATA_PATH,
            video_path=V2_VIDEO_PATH,
        )
        write_json(meta / "info.json", info)


class VideoDatasetWriter(_LeRobotWriter):
    """Writes a data set v3.0: numbers in Parquet, images in MP4, many episodes to a file.

    Args:
        root: Folder to write into.
        layout: Names and numbers of the data set.
        video_mb: Size from which a video is continued in another file, [MiB]; None is that of the layout.
    """

    def __init__(self, root: Path, layout: Layout, video_mb: float | None = None):
        super().__init__(root, layout)
        import_av()
        self._video_mb = layout.video_mb if video_mb is None else video_mb
        self._videos: dict[str, GrowingFile] = {}  # of each camera
        self._data: GrowingFile | None = None  # one row group per episode

    def _write(
        self, columns: Mapping[str, np.ndarray], images: Mapping[str, np.ndarray], stats: Mapping[str, Any]
    ) -> dict[str, Any]:
        steps, first = len(columns["index"]), self._frames
        entry = self._add_rows(self._pa.table(_arrays(self._pa, columns)))
        entry |= {"dataset_from_index": first, "dataset_to_index": first + steps}
        for key, frames in images.items():
            entry |= self._add_frames(key, frames)
        for key, one in stats.items():
            entry |= {f"stats/{key}/{name}": value for name, value in one.items()}
        return {**entry, "meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}

    def _add_rows(self, table: Any) -> dict[str, Any]:
        if self._data is None:
            create = partial(self._pq.ParquetWriter, schema=table.schema, compression="snappy")
            self._data = GrowingFile(self.root, DATA_PATH, self.layout.data_mb, create)
        place = self._data.open()
        self._data.writer.write_table(table)
        self._data.bytes += table.nbytes
        return {f"data/{name}": value for name, value in place.items()}

    def _add_frames(self, key: str, frames: np.ndarray) -> dict[str, Any]:
        fps = self.layout.fps
        if key not in self._videos:
            create = partial(Mp4Writer, fps=fps, codec=self.layout.codec or H264)
            pattern = VIDEO_PATH.replace("{video_key}", key)
            self._videos[key] = GrowingFile(self.root, pattern, self._video_mb, create)
        video = self._videos[key]
        place = video.open()
        first = video.writer.frames
        video.writer.add(frames)
        path = video.writer.path  # AV1's encoder may hold back the first frames, and the file with them
        video.bytes = path.stat().st_size if path.exists() else 0
        times = {"from_timestamp": first / fps, "to_timestamp": video.writer.frames / fps}
        return {f"videos/{key}/{name}": value for name, value in {**place, **times}.items()}

    def close(self) -> None:
        for file in (self._data, *self._videos.values()):
            if file is not None:
                file.close()

    def _write_metadata(self, meta: Path, summaries: Mapping[str, Mapping[str, Any]]) -> None:
        (self.root / _EPISODES_PATH).parent.mkdir(parents=True)
        self._pq.write_table(self._pa.Table.from_pylist(self._episodes), self.root / _EPISODES_PATH)
        self._pq.write_table(self._task_table(), meta / "tasks.parquet")
        write_json(meta / "stats.json", summaries)
        info = self._info(
            data_files_size_in_mb=self.layout.data_mb,
            video_files_size_in_mb=self._video_mb,
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


class GrowingFile:
    """A file that episodes are appended to, and that is continued in another one when it is large.

    Args:
        root: Folder of the data set.
        pattern: Path of a file in it, with chunk and index.
        limit_mb: Size from which a file is continued in another one, [MiB].
        create: Function that opens a writer of the file at a path.

    Attributes:
        writer: Writer of the open file.
        bytes: Size of what has been written to it.
    """

    def __init__(self, root: Path, pattern: str, limit_mb: float, create: Callable[[Path], Any]):
        self._root, self._pattern, self._limit, self._create = root, pattern, limit_mb * 2**20, create
        self._number, self.bytes = 0, 0
        self.writer: Any = None

    def open(self) -> dict[str, int]:
        """Open the file that the next episode is in; return its indices for the table of episodes."""
        if self.bytes > self._limit:
            self.close()
            self._number += 1
        chunk, index = divmod(self._number, FILES_PER_CHUNK)
        place = {"chunk_index": chunk, "file_index": index}
        if self.writer is None:
            path = self._root / self._pattern.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer, self.bytes = self._create(path), 0
        return place

    def close(self) -> None:
        """Close the open file. Idempotent."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None


def _arrays(pa: ModuleType, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return columns as arrays of Arrow; rows of a matrix become lists of fixed length."""
    return {
        key: pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])
        if values.ndim == 2
        else pa.array(values)
        for key, values in columns.items()
    }


def _write_lines(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    atomic_write_text(path, "".join(json.dumps(row) + "\n" for row in rows))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON that people can read."""
    atomic_write_text(path, json.dumps(content, indent=4))
