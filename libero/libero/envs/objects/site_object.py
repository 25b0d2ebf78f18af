"""Regions as objects."""

from typing import Any

import numpy as np

from libero_env.sim.predicates import Box, contains, is_over


class SiteObject:
    """A region that is a box around a named site.

    Attributes:
        name: Address of the region.
        parent_name: Object or fixture that the region belongs to.
        size: Half size, (3,) m.
        joints: Names of the joints that move it.
    """

    def __init__(
        self,
        name: str,
        parent_name: str | None = None,
        joints: Any = None,
        size: Any = (0.0, 0.0, 0.0),
        rgba: Any = None,
        site_type: str = "box",
        site_pos: Any = None,
        site_quat: Any = None,
        object_properties: dict[str, Any] | None = None,
    ):
        self.name, self.parent_name, self.joints = name, parent_name, joints
        self.size, self.rgba, self.site_type = np.asarray(size, np.float64), rgba, site_type
        self.site_pos, self.site_quat = site_pos, site_quat
        self.object_properties = object_properties or {"vis_site_names": {}}

    def in_box(self, this_position: Any, this_mat: Any, other_position: Any) -> bool:
        """Return whether a point is in the box of half size |R size| around the site, or up to 1 cm below it."""
        return contains(self._box(this_position, this_mat), np.asarray(other_position))

    def under(
        self, this_position: Any, this_mat: Any, other_position: Any, other_height: float = 0.1
    ) -> bool:
        """Return whether a point is above the box, by less than `other_height`, m."""
        return is_over(self._box(this_position, this_mat), np.asarray(other_position), other_height)

    def _box(self, position: Any, mat: Any) -> Box:
        return Box(np.asarray(position), np.asarray(mat).reshape(3, 3), self.size)
