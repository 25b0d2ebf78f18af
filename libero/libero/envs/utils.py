"""Helpers of scenes."""

from collections.abc import Iterable, Sequence

from libero.libero.envs.regions.samplers import MultiRegionRandomSampler
from libero.libero.utils.utils import postprocess_model_xml

__all__ = ["MultiRegionRandomSampler", "postprocess_model_xml", "rectangle2xyrange"]


def rectangle2xyrange(rect_ranges: Iterable[Sequence[float]]) -> tuple[list[list[float]], list[list[float]]]:
    """Rectangles (x0, y0, x1, y1) -> their ranges along x and along y."""
    rows = [tuple(row) for row in rect_ranges]
    return [[x0, x1] for x0, _, x1, _ in rows], [[y0, y1] for _, y0, _, y1 in rows]
