"""Lifelong robot learning: policies, algorithms, the training loop, evaluation, metrics and reports.

The names below are loaded when they are first used; importing this package does not load PyTorch.
"""

import lazy_loader

from libero_env import __distribution__ as __distribution__
from libero_env import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
