"""Kitchenware of the Google scanned objects."""

from libero.libero.envs.base_object import BuiltinObject, declare


class GoogleScannedObject(BuiltinObject):
    """Kitchenware of the Google scanned objects; see `libero.libero.envs.base_object.BaseObject`."""

    family = "stable_scanned_objects"


(
    AkitaBlackBowl,
    Basket,
    Chefmate8Frypan,
    GlazedRimPorcelainRamekin,
    Plate,
    Rack,
    WhiteBowl,
) = declare(
    GoogleScannedObject,
    __name__,
    "AkitaBlackBowl Basket Chefmate8Frypan GlazedRimPorcelainRamekin Plate Rack WhiteBowl",
)
