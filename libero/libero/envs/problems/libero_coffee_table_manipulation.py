"""Path of the original; see `libero.libero.envs.problems`."""

from libero.libero.envs.problems import Libero_Coffee_Table_Manipulation  # noqa: F401
