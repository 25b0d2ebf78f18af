"""Helpers of scenes, under their second path."""

from collections.abc import Iterable, Sequence

from libero.libero.envs.regions import MultiRegionRandomSampler  # noqa: F401
from libero.libero.utils.utils import postprocess_model_xml  # noqa: F401


def rectangle2xyrange(rect_ranges: Iterable[Sequence[float]]) -> tuple[list[list[float]], list[list[float]]]:
    """Return the ranges along x and those along y of rectangles (x0, y0, x1, y1)."""
    rows = [tuple(row) for row in rect_ranges]
    return [[x0, x1] for x0, _, x1, _ in rows], [[y0, y1] for _, y0, _, y1 in rows]
