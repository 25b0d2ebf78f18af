"""Starts of episodes: sampled and settled placements, the stored states of each task, files of the original."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
