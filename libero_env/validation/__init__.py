"""Validation of what comes from outside: values against annotated types, YAML with its line numbers."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
