"""Objects by family, and the registry. The class of each category is here too: `AlphabetSoup`, `FlatStove`, ..."""

from libero._adapters.lookup import alias_modules
from libero.libero.envs.base_object import (
    OBJECTS_DICT,
    VISUAL_CHANGE_OBJECTS_DICT,
    MujocoXMLObject,
    get_object_dict,
    get_object_fn,
    register_object,
    register_visual_change_object,
)
from libero.libero.envs.objects.families import (
    ARTICULATED,
    HOPE,
    SCANNED,
    TURBOSQUID,
    ArticulatedObject,
    GoogleScannedObject,
    HopeBaseObject,
    TurbosquidObjects,
)
from libero.libero.envs.objects.site_object import SiteObject
from libero.libero.envs.objects.target_zones import TargetZone

globals().update({cls.__name__: cls for cls in OBJECTS_DICT.values()})

alias_modules(
    __name__,
    articulated_objects=f"ArticulatedObject {ARTICULATED}",
    google_scanned_objects=f"GoogleScannedObject {SCANNED}",
    hope_objects=f"HopeBaseObject {HOPE}",
    turbosquid_objects=f"TurbosquidObjects {TURBOSQUID}",
    base_object="OBJECTS_DICT VISUAL_CHANGE_OBJECTS_DICT get_object_dict get_object_fn register_object "
    "register_visual_change_object",
)
