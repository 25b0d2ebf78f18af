"""The original's helpers, with its second copy of the paths."""

from libero.libero import get_libero_path, get_path_dict
from libero.libero import set_libero_default_path as set_libero_path
