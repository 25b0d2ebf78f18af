from .config import DemoConfig, RecordingJob, Variation
from .generate import ensure_demos, make_demos
from .lerobot import export_lerobot
from .observe import RenderConfig
from .read import Demo, DemoOrigin, demo_lengths, demo_origin, iter_demos, read_demos
from .replay import rerender
from .write import DemoWriter, Episode

__all__ = [
    "Demo",
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
    "export_lerobot",
    "iter_demos",
    "make_demos",
    "read_demos",
    "rerender",
]
