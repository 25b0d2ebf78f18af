from .generate import ensure_demos
from .read import Demo, demo_lengths, iter_demos, read_demos
from .replay import rerender
from .write import DemoWriter, Episode

__all__ = [
    "Demo",
    "DemoWriter",
    "Episode",
    "demo_lengths",
    "ensure_demos",
    "iter_demos",
    "read_demos",
    "rerender",
]
