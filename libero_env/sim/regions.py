"""Boxes of regions, and whether a point is in a box or over it."""

from typing import NamedTuple

import mujoco
import numpy as np

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.sim.scene import zone_boxes
from libero_env.sim.state import StateView
from libero_env.tasks.problem import Region

BOX_BELOW = 0.01  # [m] depth below its box in which a region still contains a point
ON_BELOW, ON_ABOVE = 0.005, 0.10  # [m] range of heights around the top of a box that are on the region


class Box(NamedTuple):
    """A box in the world.

    Attributes:
        centre: Position of its centre, (3,), m.
        mat: Orientation, box to world, (3, 3).
        half_size: Half of its edges, (3,), m.
    """

    centre: np.ndarray
    mat: np.ndarray
    half_size: np.ndarray


def region_of(view: StateView, address: str) -> Region:
    """Return a region by its address.

    Raises:
        UnknownNameError: The task has no such region.
    """
    region = view.scene.problem.region(address)
    if region is None:
        valid = [r.address for r in view.scene.problem.regions] + list(view.scene.objects)
        raise UnknownNameError("region or object", address, valid)
    return region


def region_boxes(view: StateView, address: str) -> list[Box]:
    """Return the boxes of a region: the site of that name, or a flat box over each rectangle on its surface.

    Raises:
        UnknownNameError: The task has no such region.
        LiberoError: The region has neither ranges nor a site.
    """
    region = region_of(view, address)
    if not region.ranges:
        site = mujoco.mj_name2id(view.scene.model, mujoco.mjtObj.mjOBJ_SITE, address)
        if site < 0:
            raise LiberoError(
                f"region {address}: {region.target} has no site {region.name!r}, and no ranges are given"
            )
        return [Box(view.site_pos(address), view.site_mat(address), view.scene.model.site_size[site])]
    boxes = zone_boxes(region, view.scene.workspace)
    return [Box(centre, np.eye(3), half) for centre, half in boxes]


def contains(box: Box, point: np.ndarray) -> bool:
    """Return whether a point (3,) is in a box; as in the original, along the world axes, with half size |R size|."""
    centre, mat, size = box
    half = np.abs(mat @ size)
    low, high = centre - half, centre + half
    low[2] -= BOX_BELOW
    return bool((point > low).all() and (point < high).all())


def is_over(box: Box, point: np.ndarray, above: float = ON_ABOVE) -> bool:
    """Return whether a point (3,) is on top of a box; as in the original, rotated by R instead of its inverse.

    Args:
        box: Box.
        point: Point in the world.
        above: Largest height of the point above the box, m.
    """
    centre, mat, size = box
    delta = mat @ (point - centre)
    return bool(size[2] - ON_BELOW < delta[2] < size[2] + above and (np.abs(delta[:2]) < size[:2]).all())
