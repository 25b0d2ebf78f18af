"""Groceries of the HOPE data set."""

from libero.libero.envs.base_object import BuiltinObject, declare


class HopeBaseObject(BuiltinObject):
    """Groceries of the HOPE data set; see `libero.libero.envs.base_object.BaseObject`."""

    family = "stable_hope_objects"


NAMES = (
    "AlphabetSoup BbqSauce Butter Cherries ChocolatePudding Cookies Corn CreamCheese Ketchup "
    "MacaroniAndCheese Mayo Milk NewSaladDressing OrangeJuice Popcorn SaladDressing TomatoSauce"
)
globals().update(declare(HopeBaseObject, NAMES))
