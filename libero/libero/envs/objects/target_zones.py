"""Zones of a workspace as objects."""

from typing import Any

import numpy as np

from libero.libero.envs.base_object import BuiltinObject, register_object


@register_object
class TargetZone(BuiltinObject):
    """A flat rectangle on which objects are placed.

    Attributes:
        size: Half size, (3,) m.
        pos: Centre in the world frame, (3,) m.
    """

    def __init__(
        self,
        name: str = "target_zone",
        zone_height: float = 0.007,
        z_offset: float = 0.02,
        rgba: Any = (1, 0, 0, 1),
        zone_size: Any = (0.15, 0.05),
        zone_centroid_xy: Any = (0.0, 0.0),
        **kwargs: Any,
    ):
        super().__init__(name, **kwargs)
        self.zone_height, self.rgba = zone_height, rgba
        self.size = np.array([*zone_size[:2], zone_height], np.float64)
        self.pos = np.array([*zone_centroid_xy[:2], z_offset], np.float64)

    def in_box(self, this_position: Any, other_position: Any) -> bool:
        """Return whether a point is in the box of the zone."""
        return bool((np.abs(np.asarray(other_position) - np.asarray(this_position)) < self.size).all())

    def on_top(self, this_position: Any, other_position: Any, other_height: float = 0.02) -> bool:
        """Return whether a point is above the zone, by less than `other_height`, m."""
        delta = np.asarray(other_position) - np.asarray(this_position)
        inside = (np.abs(delta[:2]) < self.size[:2]).all()
        return bool(inside and self.size[2] - 0.005 < delta[2] < other_height)
