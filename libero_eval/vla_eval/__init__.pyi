from .benchmark import LiberoBenchmark
from .server import RunServer

__all__ = ["LiberoBenchmark", "RunServer"]
