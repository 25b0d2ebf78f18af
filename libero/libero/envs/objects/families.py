"""The classes of the builtin objects, by the family that the original has them in."""

from libero.libero.envs.base_object import BuiltinObject, declare, register_visual_change_object


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


ARTICULATED = (
    "BasinFaucet Faucet FlatStove Microwave ShortCabinet ShortFridge SlideCabinet WhiteCabinet Window "
    "WoodenCabinet"
)
SCANNED = "AkitaBlackBowl Basket Chefmate8Frypan GlazedRimPorcelainRamekin Plate Rack WhiteBowl"
HOPE = (
    "AlphabetSoup BbqSauce Butter Cherries ChocolatePudding Cookies Corn CreamCheese Ketchup "
    "MacaroniAndCheese Mayo Milk NewSaladDressing OrangeJuice Popcorn SaladDressing TomatoSauce"
)
TURBOSQUID = (
    "BlackBook BowlDrainer DeskCaddy DiningSetGroup MokaPot PorcelainMug RedCoffeeMug WhiteStorageBox "
    "WhiteYellowMug WineBottle WineRack WoodenShelf WoodenTray WoodenTwoLayerShelf YellowBook"
)
for base, names in (
    (ArticulatedObject, ARTICULATED),
    (GoogleScannedObject, SCANNED),
    (HopeBaseObject, HOPE),
    (TurbosquidObjects, TURBOSQUID),
):
    globals().update(declare(base, names))
register_visual_change_object(globals()["FlatStove"])
