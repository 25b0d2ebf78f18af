"""Objects by family, regions as objects, and the registry.

The class of each category is here too: `AlphabetSoup`, `FlatStove`, ...
"""

from typing import Any

import numpy as np

from libero._adapters.lookup import alias_modules
from libero.libero.envs.base_object import (
    OBJECTS_DICT,
    VISUAL_CHANGE_OBJECTS_DICT,
    BuiltinObject,
    MujocoXMLObject,
    declare,
    get_object_dict,
    get_object_fn,
    register_object,
    register_visual_change_object,
)
from libero_env.assets.original import FAMILIES
from libero_env.parallel import send_to_workers
from libero_env.sim.predicates import Box, contains, is_over


class ArticulatedObject(BuiltinObject):
    """What opens, closes and turns; see `libero.libero.envs.base_object.BaseObject`."""

    family = "articulated_objects"
    in_folders = False


class GoogleScannedObject(BuiltinObject):
    """Kitchenware of the Google scanned objects; see `libero.libero.envs.base_object.BaseObject`."""

    family = "stable_scanned_objects"


class HopeBaseObject(BuiltinObject):
    """Groceries of the HOPE data set; see `libero.libero.envs.base_object.BaseObject`."""

    family = "stable_hope_objects"


class TurbosquidObjects(BuiltinObject):
    """Furniture, books and tableware; see `libero.libero.envs.base_object.BaseObject`."""

    family = "turbosquid_objects"


WITHOUT_MODEL = ("cherries", "corn", "mayo")  # of HOPE; the original registers them, but has no files of them
for base in (ArticulatedObject, GoogleScannedObject, HopeBaseObject, TurbosquidObjects):
    more = WITHOUT_MODEL if base is HopeBaseObject else ()
    globals().update(declare(base, sorted((*FAMILIES[base.family], *more))))
register_visual_change_object(globals()["FlatStove"])


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
        self.pos = self.site_pos = site_pos
        self.quat = self.site_quat = site_quat
        self.object_properties = object_properties or {"vis_site_names": {}}

    def in_box(self, this_position: Any, this_mat: Any, other_position: Any) -> bool:
        """Return whether a point is in the box of half size |R size| around the site, or up to 1 cm below it."""
        return bool(contains(self._box(this_position, this_mat), np.asarray(other_position)))

    def under(
        self, this_position: Any, this_mat: Any, other_position: Any, other_height: float = 0.1
    ) -> bool:
        """Return whether a point is above the box, by less than `other_height`, m."""
        return bool(is_over(self._box(this_position, this_mat), np.asarray(other_position), other_height))

    def on_top(self, this_position: Any, this_mat: Any, other_position: Any) -> bool:
        """Return whether a point is beyond the upper corner of the box of half size |R size|, as in the original."""
        reach = np.abs(np.asarray(this_mat).reshape(3, 3) @ self.size)
        return bool((np.asarray(other_position) > np.asarray(this_position) + reach).all())

    def _box(self, position: Any, mat: Any) -> Box:
        return Box(np.asarray(position), np.asarray(mat).reshape(3, 3), self.size)


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
        joints: Any = None,
        zone_size: Any = (0.15, 0.05),
        zone_centroid_xy: Any = (0.0, 0.0),
        **kwargs: Any,
    ):
        super().__init__(name, joints=joints, **kwargs)
        self.zone_height, self.rgba, self.quat = zone_height, rgba, np.array([1.0, 0.0, 0.0, 0.0])
        self.size = np.array([*zone_size[:2], zone_height], np.float64)
        self.pos = np.array([*zone_centroid_xy[:2], z_offset], np.float64)

    _box, in_box = SiteObject._box, SiteObject.in_box
    under, on_top = SiteObject.under, SiteObject.on_top


send_to_workers(__name__, "OBJECTS_DICT", "VISUAL_CHANGE_OBJECTS_DICT")
alias_modules(
    __name__,
    "articulated_objects google_scanned_objects hope_objects "
    "turbosquid_objects site_object target_zones base_object",
)
