"""How images are turned, in one place.

Here images are upright: the first row is on top. OpenGL, the original's environments and files, and LeRobot's
environments have the lowest row first. OpenVLA and openpi turn the original's by 180 degrees.
"""

import numpy as np


def flip_rows(images: np.ndarray, rows: int = 0) -> np.ndarray:
    """Return a view of images with their rows in the other order.

    Args:
        images: Images, (..., H, W, ...).
        rows: Axis of the rows; that of the columns follows.
    """
    return np.flip(images, rows)


def rotate_180(images: np.ndarray, rows: int = 0) -> np.ndarray:
    """Return a view of images that are turned by 180 degrees; for the arguments see `flip_rows`."""
    return np.flip(images, (rows, rows + 1))
