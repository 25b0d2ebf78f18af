"""What a task says: suites and tasks of the benchmark from the facts in `data/`, and user-defined task files."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
