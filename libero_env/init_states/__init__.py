"""How an episode starts: sampled and settled placements, the stored states of each task, the original's files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
