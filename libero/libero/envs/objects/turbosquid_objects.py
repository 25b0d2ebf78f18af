"""Furniture, books and tableware."""

from libero.libero.envs.base_object import BuiltinObject, declare


class TurbosquidObjects(BuiltinObject):
    """Furniture, books and tableware; see `libero.libero.envs.base_object.BaseObject`."""

    family = "turbosquid_objects"


NAMES = (
    "BlackBook BowlDrainer DeskCaddy DiningSetGroup MokaPot PorcelainMug RedCoffeeMug WhiteStorageBox "
    "WhiteYellowMug WineBottle WineRack WoodenShelf WoodenTray WoodenTwoLayerShelf YellowBook"
)
globals().update(declare(TurbosquidObjects, NAMES))
