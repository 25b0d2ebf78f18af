"""The registry, under its second path."""

from libero.libero.envs.base_object import (  # noqa: F401 - names of the original
    OBJECTS_DICT,
    VISUAL_CHANGE_OBJECTS_DICT,
    get_object_dict,
    get_object_fn,
    register_object,
    register_visual_change_object,
)
