from .dataset import SequenceVLDataset
from .fake import fake_batch, fake_observation
from .loading import open_windows
from .memory import ReplayMemory
from .source import DemoSource

__all__ = [
    "DemoSource",
    "ReplayMemory",
    "SequenceVLDataset",
    "fake_batch",
    "fake_observation",
    "open_windows",
]
