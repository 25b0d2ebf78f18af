"""The LIBERO benchmark in headless MuJoCo: tasks, objects, simulation, a scripted expert, demonstrations.

The names below are loaded when they are first used; importing this package loads neither MuJoCo nor anything else.
"""

import lazy_loader

__distribution__ = "libero-lifelong"  # its packages import this name
__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
