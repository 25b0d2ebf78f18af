"""Judging any policy: protocols, policy servers, resumable evaluations, comparisons, robustness.

The names below are loaded when they are first used.
"""

import lazy_loader

from libero_env import __distribution__ as __distribution__
from libero_env import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
