"""Embeddings of instructions by sentence encoders; those of the benchmark's instructions are part of the package."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
