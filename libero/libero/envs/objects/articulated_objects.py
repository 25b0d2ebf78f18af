"""What opens, closes and turns."""

from libero.libero.envs.base_object import BuiltinObject, declare, register_visual_change_object


class ArticulatedObject(BuiltinObject):
    """What opens, closes and turns; see `libero.libero.envs.base_object.BaseObject`."""

    family = "articulated_objects"
    in_folders = False


(
    BasinFaucet,
    Faucet,
    FlatStove,
    Microwave,
    ShortCabinet,
    ShortFridge,
    SlideCabinet,
    WhiteCabinet,
    Window,
    WoodenCabinet,
) = declare(
    ArticulatedObject,
    __name__,
    "BasinFaucet Faucet FlatStove Microwave ShortCabinet ShortFridge SlideCabinet WhiteCabinet "
    "Window WoodenCabinet",
)
register_visual_change_object(FlatStove)
