"""What opens, closes and turns."""

from libero.libero.envs.base_object import (
    BuiltinObject,
    declare,
    get_object_fn,
    register_visual_change_object,
)


class ArticulatedObject(BuiltinObject):
    """What opens, closes and turns; see `libero.libero.envs.base_object.BaseObject`."""

    family = "articulated_objects"
    in_folders = False


NAMES = (
    "BasinFaucet Faucet FlatStove Microwave ShortCabinet ShortFridge SlideCabinet WhiteCabinet Window "
    "WoodenCabinet"
)
globals().update(declare(ArticulatedObject, NAMES))
register_visual_change_object(get_object_fn("flat_stove"))
