"""The training loop, its settings, one optimiser step, and what training costs."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
