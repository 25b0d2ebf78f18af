"""Demonstrations as windows in memory, and the memory of past tasks."""

from lifelong.data.dataset import SequenceVLDataset, batches
from lifelong.data.fake import fake_batch, fake_observation
from lifelong.data.memory import ReplayMemory

__all__ = ["ReplayMemory", "SequenceVLDataset", "batches", "fake_batch", "fake_observation"]
