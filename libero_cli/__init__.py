"""The `libero` command: the only package that names all others."""

from libero_env import __distribution__ as __distribution__
