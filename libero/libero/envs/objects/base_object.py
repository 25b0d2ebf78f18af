"""The registry, under its second path."""

from libero.libero.envs.base_object import (
    OBJECTS_DICT,
    VISUAL_CHANGE_OBJECTS_DICT,
    get_object_dict,
    get_object_fn,
    register_object,
    register_visual_change_object,
)

__all__ = [
    "OBJECTS_DICT",
    "VISUAL_CHANGE_OBJECTS_DICT",
    "get_object_dict",
    "get_object_fn",
    "register_object",
    "register_visual_change_object",
]
