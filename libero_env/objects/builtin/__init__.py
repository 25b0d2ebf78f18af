"""The builtin pack: objects generated from YAML, `parameters/` for their physics and `appearance/` for what is seen."""

from libero_env.objects.builtin.assemble import build, builtin_names

__all__ = ["build", "builtin_names"]
