"""Where models come from: the builtin pack, rooms and robot, or the files of the original LIBERO."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
