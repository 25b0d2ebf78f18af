"""Tasks: the suites of the benchmark, built from the YAML files in `data/`, and user-defined task files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
