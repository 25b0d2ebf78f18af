"""Import paths of the original benchmark, for code that was written for it; adapters to `libero_env`."""

from libero_env import __distribution__ as __distribution__
from libero_env import __version__ as __version__
