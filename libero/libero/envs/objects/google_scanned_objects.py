"""Kitchenware of the Google scanned objects."""

from libero.libero.envs.base_object import BuiltinObject, declare


class GoogleScannedObject(BuiltinObject):
    """Kitchenware of the Google scanned objects; see `libero.libero.envs.base_object.BaseObject`."""

    family = "stable_scanned_objects"


NAMES = "AkitaBlackBowl Basket Chefmate8Frypan GlazedRimPorcelainRamekin Plate Rack WhiteBowl"
globals().update(declare(GoogleScannedObject, NAMES))
