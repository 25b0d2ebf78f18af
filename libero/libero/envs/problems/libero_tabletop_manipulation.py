"""Path of the original; see `libero.libero.envs.problems`."""

from libero.libero.envs.problems import Libero_Tabletop_Manipulation  # noqa: F401
