"""Catalog of objects: a category name gives a MuJoCo model with the figures that placement needs.

The builtin pack is generated in code; users add their own with `register_object`, `register_object_file` or
`add_object`.
"""

from libero_env.objects.catalog import get_object, object_names, register_object
from libero_env.objects.from_file import add_object, register_object_file
from libero_env.objects.model import ObjectModel

__all__ = [
    "ObjectModel",
    "add_object",
    "get_object",
    "object_names",
    "register_object",
    "register_object_file",
]
