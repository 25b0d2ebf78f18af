"""The files of a LeRobotDataset that grow by episodes: Parquet for numbers, MP4 for images."""

from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from libero_env.demos.lerobot_layout import FILES_PER_CHUNK
from libero_env.demos.video import H264, Codec, Mp4Writer
from libero_env.errors import LiberoError

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


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


def chunk_and_file(file: int) -> dict[str, int]:
    """Return the indices of the n-th file, for the patterns of paths above."""
    return {"chunk_index": file // FILES_PER_CHUNK, "file_index": file % FILES_PER_CHUNK}


class ParquetTable:
    """Writes the Parquet files of the data, one row group per episode.

    Args:
        root: Folder of the data set.
        limit_mb: Size from which a table is continued in another file, [MiB].
    """

    def __init__(self, root: Path, limit_mb: float):
        self._limit_mb = limit_mb
        self._pa, self._pq = import_arrow()
        self._root = root
        self._writer: Any = None
        self._file, self._bytes = 0, 0

    def add(self, columns: dict[str, np.ndarray]) -> dict[str, int]:
        """Append an episode; return the metadata that tell where it is."""
        pa = self._pa
        arrays = {
            key: pa.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])
            if values.ndim == 2
            else values
            for key, values in columns.items()
        }
        table = pa.table(arrays)
        if self._bytes > self._limit_mb * 2**20:
            self.close()
            self._file, self._bytes = self._file + 1, 0
        place = chunk_and_file(self._file)
        if self._writer is None:
            path = self._root / DATA_PATH.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._pq.ParquetWriter(path, table.schema, compression="snappy")
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return {f"data/{key}": value for key, value in place.items()}

    def close(self) -> None:
        """Close the open file. Idempotent."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


@dataclass
class CameraVideo:
    """Writes the MP4 files of a camera.

    Attributes:
        root: Folder of the data set.
        key: Feature of the camera.
        limit_mb: Size from which a video is continued in another file, [MiB].
        fps: Frames per second.
        codec: How frames are encoded.
        file: Number of the file that is being written.
        writer: The open file.
    """

    root: Path
    key: str
    limit_mb: float
    fps: int
    codec: Codec = H264
    file: int = 0
    writer: Mp4Writer | None = field(default=None, repr=False)

    def add(self, frames: np.ndarray) -> dict[str, Any]:
        """Append an episode; return the metadata that tell where it is."""
        if self.writer is not None and self.writer.path.stat().st_size > self.limit_mb * 2**20:
            self.close()
            self.file += 1
        place = chunk_and_file(self.file)
        if self.writer is None:
            path = self.root / VIDEO_PATH.format(video_key=self.key, **place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.writer = Mp4Writer(path, self.fps, self.codec)
        first = self.writer.frames
        self.writer.add(frames)
        times = {"from_timestamp": first / self.fps, "to_timestamp": self.writer.frames / self.fps}
        return {f"videos/{self.key}/{name}": value for name, value in {**place, **times}.items()}

    def close(self) -> None:
        """Close the open file. Idempotent."""
        if self.writer is not None:
            self.writer.close()
            self.writer = None
