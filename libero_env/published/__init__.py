"""Robustness suites that others have published: LIBERO-Plus and LIBERO-PRO, as tasks of this package.

Their files are read where the user has them; none is part of this package.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
