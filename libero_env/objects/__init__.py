"""Catalog of objects: a category name gives a MuJoCo model with the parameters that placement needs.

The builtin pack is generated in code; users define more with `register_object`, or with `add_object` and
`register_object_file` of `libero_env.design.objects`.
"""

from libero_env.objects.catalog import get_object, object_names, register_object
from libero_env.objects.model import ObjectModel

__all__ = ["ObjectModel", "get_object", "object_names", "register_object"]
