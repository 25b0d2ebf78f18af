"""Videos of episodes."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from libero_env.curating.video import write_video
from libero_env.errors import LiberoError
from libero_env.images import flip_rows

Obs = Mapping[str, np.ndarray]

_TINT = np.array([0, 255, 0])  # RGB, mixed into the pictures after success
_TINT_WEIGHT = 0.2


class VideoWriter:
    """Collects pictures, and writes them as a video on `save` or at the end of its block.

    The format is MP4 with PyAV (`pip install libero-lifelong[export]`), otherwise GIF.

    Args:
        video_path: Folder of the files.
        save_video: Whether pictures are collected at all.
        fps: Pictures per second.
        single_video: Whether all environments are in one file, `video`, one after the other; or in `0`, `1`, ...
    """

    def __init__(
        self, video_path: str | Path, save_video: bool = False, fps: int = 30, single_video: bool = True
    ):
        self.video_path, self.save_video = Path(video_path), save_video
        self.fps, self.single_video = fps, single_video
        self.image_buffer: dict[int, list[np.ndarray]] = {}
        self.last_images: dict[int, np.ndarray] = {}

    def __enter__(self) -> "VideoWriter":
        return self

    def __exit__(self, *error: object) -> None:
        self.save()

    def reset(self) -> None:
        """Start a new episode."""
        self.last_images.clear()

    def append_image(self, img: np.ndarray, idx: int = 0) -> None:
        """Add a picture (H, W, 3), upper row first, of environment `idx`."""
        if self.save_video:
            self.image_buffer.setdefault(idx, []).append(np.asarray(img, np.uint8))

    def append_obs(self, obs: Obs, done: bool, idx: int = 0, camera_name: str = "agentview_image") -> None:
        """Add the picture of an observation, lowest row first; after success the last picture, tinted green."""
        image = np.asarray(obs[camera_name])
        if done:
            image = (1 - _TINT_WEIGHT) * self.last_images.get(idx, image) + _TINT_WEIGHT * _TINT
        else:
            self.last_images[idx] = image
        self.append_image(flip_rows(image), idx)

    def append_vector_obs(
        self, obs: Sequence[Obs], dones: Sequence[bool], camera_name: str = "agentview_image"
    ) -> None:
        """Add the pictures of several environments."""
        for i, (one, done) in enumerate(zip(obs, dones, strict=True)):
            self.append_obs(one, bool(done), i, camera_name)

    def save(self) -> list[Path]:
        """Write the videos and return their paths."""
        if not self.save_video or not self.image_buffer:
            return []
        self.video_path.mkdir(parents=True, exist_ok=True)
        videos = {str(i): images for i, images in self.image_buffer.items()}
        if self.single_video:
            videos = {"video": [image for images in self.image_buffer.values() for image in images]}
        return [_write(self.video_path / name, images, self.fps) for name, images in videos.items()]


def _write(path: Path, images: Sequence[np.ndarray], fps: int) -> Path:
    try:
        return write_video(path.with_suffix(".mp4"), np.stack(images), fps)
    except LiberoError as error:  # PyAV is missing, or the pictures have an odd size
        warnings.warn(f"{error}; writing GIF", stacklevel=3)
        path.with_suffix(".mp4").unlink(missing_ok=True)
        return write_video(path.with_suffix(".gif"), np.stack(images), fps)
