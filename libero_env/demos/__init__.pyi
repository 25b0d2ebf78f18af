from .config import DemoConfig, RenderConfig, Variation
from .generate import RecordingJob, ensure_demos, make_demos
from .read import DemoOrigin, Episode, demo_lengths, demo_origin, iter_demos, read_demos
from .write import DemoWriter

__all__ = [
    "DemoConfig",
    "DemoOrigin",
    "DemoWriter",
    "Episode",
    "RecordingJob",
    "RenderConfig",
    "Variation",
    "demo_lengths",
    "demo_origin",
    "ensure_demos",
    "iter_demos",
    "make_demos",
    "read_demos",
]
