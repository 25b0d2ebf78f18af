"""Moving pictures: GIF and WebP with Pillow, MP4 with PyAV (`pip install libero-lifelong[export]`)."""

from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from libero_env.errors import LiberoError

CODEC, PIXELS = "libx264", "yuv420p"  # what every player and every decoder of data sets reads


def import_av() -> ModuleType:
    """PyAV.

    Raises:
        LiberoError: it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise LiberoError("MP4 needs PyAV: pip install 'libero-lifelong[export]', or write a .gif") from error
    return av


class Mp4:
    """An MP4 file that grows frame by frame; use it as a context manager.

    Frame i is shown at i / fps, exactly, and every second one can be decoded on its own, for random access.

    Args:
        path: the file.
        fps: frames per second.
        crf: quality of H.264, lower is better; 18 looks like the original.
    """

    def __init__(self, path: Path, fps: int, crf: int = 18):
        self._av, self.path, self.frames = import_av(), path, 0
        self._fps, self._crf = fps, crf
        self._container = self._av.open(str(path), "w")
        self._stream: Any = None

    def add(self, frames: np.ndarray) -> None:
        """Append frames (T, H, W, 3) uint8.

        Raises:
            LiberoError: H or W is odd, which H.264 has no room for.
        """
        if self._stream is None:
            self._stream = self._open(*frames.shape[1:3])
        for pixels in frames:
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame.pts, frame.time_base = self.frames, Fraction(1, self._fps)
            self._container.mux(self._stream.encode(frame))
            self.frames += 1

    def close(self) -> None:
        """Write what is pending. Idempotent."""
        if self._container is not None:
            if self._stream is not None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            self._container = None

    def __enter__(self) -> "Mp4":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, height: int, width: int) -> Any:
        if height % 2 or width % 2:
            raise LiberoError(
                f"{self.path}: frames of {height}x{width} pixels; MP4 needs even numbers, or write a .gif"
            )
        stream = self._container.add_stream(CODEC, rate=self._fps)
        stream.height, stream.width, stream.pix_fmt = height, width, PIXELS
        stream.time_base = Fraction(1, self._fps)
        stream.codec_context.options = {"crf": str(self._crf), "g": "2", "bf": "0"}
        stream.codec_context.thread_count = 1
        return stream


def write_video(path: Path, frames: np.ndarray, fps: int) -> Path:
    """Write frames (T, H, W, 3) uint8 as .webp, .gif or .mp4.

    Raises:
        LiberoError: another ending, or PyAV is not installed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in (".gif", ".webp"):
        pictures = [Image.fromarray(frame) for frame in frames]
        pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=round(1000 / fps), loop=0)
    elif path.suffix == ".mp4":
        with Mp4(path, fps) as video:
            video.add(frames)
    else:
        raise LiberoError(f"{path}: videos are .mp4, .webp or .gif")
    return path
