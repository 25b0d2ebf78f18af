"""Videos: GIF and WebP with Pillow, MP4 with PyAV (`pip install libero-lifelong[export]`)."""

from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from PIL import Image

from libero_env.errors import LiberoError

CODEC, PIXEL_FORMAT = "libx264", "yuv420p"  # every player and data set library can decode them


def import_av() -> ModuleType:
    """Import PyAV and return it.

    Raises:
        LiberoError: PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise LiberoError("MP4 needs PyAV: pip install 'libero-lifelong[export]', or write a .gif") from error
    return av


class Mp4Writer:
    """Writes an MP4 file frame by frame; use it as a context manager.

    Frame i is shown at exactly i / fps, and every second frame is a key frame, for random access.

    Args:
        path: File to write.
        fps: Frames per second.
        crf: Quality of H.264, lower is better; 18 is visually lossless.
    """

    def __init__(self, path: Path, fps: int, crf: int = 18):
        self._av, self.path, self.frames = import_av(), path, 0
        self._fps, self._crf = fps, crf
        self._container = self._av.open(str(path), "w")
        self._stream: Any = None

    def add(self, frames: np.ndarray) -> None:
        """Append frames (T, H, W, 3) uint8.

        Raises:
            LiberoError: H or W is odd, which this pixel format does not allow.
        """
        if self._stream is None:
            self._stream = self._open(*frames.shape[1:3])
        for pixels in frames:
            frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            frame.pts, frame.time_base = self.frames, Fraction(1, self._fps)
            self._container.mux(self._stream.encode(frame))
            self.frames += 1

    def close(self) -> None:
        """Write the pending frames and close the file. Idempotent."""
        if self._container is not None:
            if self._stream is not None:
                self._container.mux(self._stream.encode(None))
            self._container.close()
            self._container = None

    def __enter__(self) -> "Mp4Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, height: int, width: int) -> Any:
        if height % 2 or width % 2:
            raise LiberoError(
                f"{self.path}: frames of {height}x{width} pixels; MP4 needs an even height and width, or write a .gif"
            )
        stream = self._container.add_stream(CODEC, rate=self._fps)
        stream.height, stream.width, stream.pix_fmt = height, width, PIXEL_FORMAT
        stream.time_base = Fraction(1, self._fps)
        stream.codec_context.options = {"crf": str(self._crf), "g": "2", "bf": "0"}
        stream.codec_context.thread_count = 1
        return stream


def write_video(path: Path, frames: np.ndarray, fps: int) -> Path:
    """Write frames (T, H, W, 3) uint8 as .webp, .gif or .mp4.

    Raises:
        LiberoError: The path has another suffix, or PyAV is not installed.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in (".gif", ".webp"):
        images = [Image.fromarray(frame) for frame in frames]
        images[0].save(path, save_all=True, append_images=images[1:], duration=round(1000 / fps), loop=0)
    elif path.suffix == ".mp4":
        with Mp4Writer(path, fps) as video:
            video.add(frames)
    else:
        raise LiberoError(f"{path}: videos are .mp4, .webp or .gif")
    return path
