"""Videos: GIF and WebP with Pillow, MP4 with PyAV (extra `export`)."""

import io
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import numpy as np
from PIL import Image

from libero_env.errors import LiberoError, install_command
from libero_env.storage import atomic_path

_SUFFIXES = (".mp4", ".webp", ".gif")
PIXEL_FORMAT = "yuv420p"  # every player and data set library can decode it


@dataclass(frozen=True)
class Codec:
    """How an MP4 file is encoded. Every second frame is a key frame, for random access.

    Attributes:
        name: Name of the format, such as `h264`.
        encoder: FFmpeg's name of the encoder.
        options: Options of the encoder; of `crf`, the quality, lower is better.
    """

    name: str
    encoder: str
    options: Mapping[str, str]


# Visually lossless, and every player decodes it.
H264 = Codec("h264", "libx264", MappingProxyType({"crf": "18", "g": "2", "bf": "0"}))
# LeRobot's defaults (lerobot/datasets/video_utils.py: _get_codec_options).
AV1 = Codec("av1", "libsvtav1", MappingProxyType({"crf": "30", "g": "2", "preset": "12"}))


def import_av() -> ModuleType:
    """Import PyAV and return it.

    Raises:
        LiberoError: PyAV is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise LiberoError(f"MP4 needs PyAV: {install_command('export')}, or write a .gif") from error
    return av


class Mp4Writer:
    """Writes an MP4 file frame by frame; use it as a context manager.

    Frame i is shown at exactly i / fps.

    Args:
        fps: Frames per second.
        codec: How frames are encoded.
    """

    def __init__(self, path: Path, fps: int, codec: Codec = H264):
        self._av, self.path, self.frames = import_av(), path, 0
        self._fps, self._codec = fps, codec
        self._container = self._av.open(str(path), "w", format="mp4")
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
        container, self._container = self._container, None
        if container is not None:
            if self._stream is not None:
                container.mux(self._stream.encode(None))
            container.close()

    def __enter__(self) -> "Mp4Writer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self, height: int, width: int) -> Any:
        if height % 2 or width % 2:
            raise LiberoError(
                f"{self.path}: frames of {height}x{width} pixels; MP4 needs an even height and width, or write a .gif"
            )
        try:
            stream = self._container.add_stream(self._codec.encoder, rate=self._fps)
        except ValueError as error:  # FFmpeg's "unknown codec"
            raise LiberoError(
                f"this build of PyAV has no encoder {self._codec.encoder}; its wheels have it: pip install --force av"
            ) from error
        stream.height, stream.width, stream.pix_fmt = height, width, PIXEL_FORMAT
        stream.time_base = Fraction(1, self._fps)
        stream.codec_context.options = dict(self._codec.options)
        stream.codec_context.thread_count = 1
        with _tame_encoder():
            stream.codec_context.open()
        return stream


@contextmanager
def _tame_encoder() -> Iterator[None]:
    """Keep SVT-AV1 from printing its settings, and from making this process a real-time one where root runs it.

    It takes the level of its messages from the environment only. To see whether it may, it gives the calling thread
    the highest real-time priority, and then its own: whatever else runs on the machine waits for them.
    """
    before = os.environ.get("SVT_LOG")
    os.environ.setdefault("SVT_LOG", "1")  # errors
    on_linux = sys.platform == "linux"
    if on_linux:
        policy, priority = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        if before is None:
            del os.environ["SVT_LOG"]
        for thread in os.listdir("/proc/self/task") if on_linux else ():
            with suppress(OSError):  # one that has ended, or a container that allows no change
                os.sched_setscheduler(int(thread), policy, priority)


def check_video_path(path: Path) -> None:
    """Raise LiberoError unless a video can have this name: before the work of making its frames.

    Args:
        path: File to write, .webp, .gif or .mp4.
    """
    if path.suffix not in _SUFFIXES:
        raise LiberoError(f"{path}: videos are .mp4, .webp or .gif")
    if path.suffix == ".mp4":
        import_av()
    with _errors_named(path):
        path.parent.mkdir(parents=True, exist_ok=True)


@contextmanager
def _errors_named(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:  # those of FFmpeg too
        raise LiberoError(
            f"{path} cannot be written ({error.strerror or error}); choose another folder"
        ) from error


def encode_image(image: np.ndarray, form: str, **options: Any) -> bytes:
    """Return an image (H, W, 3) uint8 as a file of a format of Pillow, with its options."""
    file = io.BytesIO()
    Image.fromarray(image).save(file, form, **options)
    return file.getvalue()


def write_video(path: Path, frames: np.ndarray, fps: int) -> Path:
    """Write frames (T, H, W, 3) uint8 as .webp, .gif or .mp4, in one step.

    Raises:
        LiberoError: The path has another suffix or cannot be written, or PyAV is not installed.
    """
    check_video_path(path)
    with _errors_named(path), atomic_path(path) as temporary:
        if path.suffix == ".mp4":
            with Mp4Writer(temporary, fps) as video:
                video.add(frames)
        else:
            images = [Image.fromarray(frame) for frame in frames]
            form, duration = path.suffix[1:], round(1000 / fps)
            images[0].save(
                temporary, form, save_all=True, append_images=images[1:], duration=duration, loop=0
            )
    return path
