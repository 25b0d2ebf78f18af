"""Demonstrations as windows of training data, and the memory of past tasks."""

from lifelong.data.dataset import SequenceVLDataset, batches
from lifelong.data.fake import fake_batch, fake_observation
from lifelong.data.loading import open_windows
from lifelong.data.memory import ReplayMemory
from lifelong.data.source import DemoSource

__all__ = [
    "DemoSource",
    "ReplayMemory",
    "SequenceVLDataset",
    "batches",
    "fake_batch",
    "fake_observation",
    "open_windows",
]
