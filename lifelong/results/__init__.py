"""What a run leaves on disk: records, metrics, the summary, the run directory."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
