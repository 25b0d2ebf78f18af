"""The files of a LeRobotDataset that grow by episodes: Parquet for numbers, MP4 for pictures."""

from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from libero_env.demos.video import Mp4
from libero_env.errors import LiberoError
from libero_env.timing import CONTROL_HZ

FILES_PER_CHUNK = 1000
DATA_MB, VIDEO_MB = 100, 200  # a file that has grown to this is followed by the next
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


def import_arrow() -> tuple[ModuleType, ModuleType]:
    """PyArrow, and its Parquet.

    Raises:
        LiberoError: it is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise LiberoError("this needs PyArrow: pip install 'libero-lifelong[export]'") from error
    return pyarrow, pyarrow.parquet


def place_of(file: int) -> dict[str, int]:
    """Where the n-th file is, for the patterns above."""
    return {"chunk_index": file // FILES_PER_CHUNK, "file_index": file % FILES_PER_CHUNK}


class Table:
    """The data's Parquet files, one row group for each episode."""

    def __init__(self, root: Path):
        self._pa, self._pq = import_arrow()
        self._root = root
        self._writer: Any = None
        self._file, self._bytes = 0, 0

    def add(self, columns: dict[str, np.ndarray]) -> dict[str, int]:
        """Append an episode; returns where it is."""
        pa = self._pa
        arrays = {
            key: pa.FixedSizeListArray.from_arrays(values.ravel(), values.shape[1])
            if values.ndim == 2
            else values
            for key, values in columns.items()
        }
        table = pa.table(arrays)
        if self._bytes > DATA_MB * 2**20:
            self.close()
            self._file, self._bytes = self._file + 1, 0
        place = place_of(self._file)
        if self._writer is None:
            path = self._root / DATA.format(**place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = self._pq.ParquetWriter(path, table.schema, compression="snappy")
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return {f"data/{key}": value for key, value in place.items()}

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None


@dataclass
class Video:
    """A camera's MP4 files."""

    root: Path
    key: str
    limit_mb: float
    file: int = 0
    open: Mp4 | None = field(default=None, repr=False)

    def add(self, frames: np.ndarray) -> dict[str, Any]:
        """Append an episode; returns where it is."""
        if self.open is not None and self.open.path.stat().st_size > self.limit_mb * 2**20:
            self.close()
            self.file += 1
        place = place_of(self.file)
        if self.open is None:
            path = self.root / VIDEO.format(video_key=self.key, **place)
            path.parent.mkdir(parents=True, exist_ok=True)
            self.open = Mp4(path, CONTROL_HZ)
        first = self.open.frames
        self.open.add(frames)
        times = {"from_timestamp": first / CONTROL_HZ, "to_timestamp": self.open.frames / CONTROL_HZ}
        return {f"videos/{self.key}/{name}": value for name, value in {**place, **times}.items()}

    def close(self) -> None:
        """Close the file. Idempotent."""
        if self.open is not None:
            self.open.close()
            self.open = None
