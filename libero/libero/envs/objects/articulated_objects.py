"""What opens, closes and turns."""

from libero.libero.envs.base_object import BuiltinObject, declare, register_visual_change_object


class ArticulatedObject(BuiltinObject):
    """What opens, closes and turns; see `libero.libero.envs.base_object.BaseObject`."""

    family = "articulated_objects"
    in_folders = False


NAMES = (
    "BasinFaucet Faucet FlatStove Microwave ShortCabinet ShortFridge SlideCabinet WhiteCabinet Window "
    "WoodenCabinet"
)
CLASSES = declare(ArticulatedObject, NAMES)
globals().update(CLASSES)
register_visual_change_object(CLASSES["FlatStove"])
