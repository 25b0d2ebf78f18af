"""A policy and a dataset small enough to compute by hand."""

import torch
from torch import Tensor, nn

from lifelong.types import Batch, Observation


def make_batch(features: Tensor, actions: Tensor, task: int = 0, ids: Tensor | None = None) -> Batch:
    """(B, D) features as proprioception, (B, A) actions; T = 1, one black 1x1 view."""
    size = len(features)
    observation = Observation(
        torch.zeros(size, 1, 1, 1, 1, 3, dtype=torch.uint8), {"x": features[:, None]}, torch.zeros(size, 2)
    )
    ids = torch.arange(size) if ids is None else ids
    return Batch(observation, actions[:, None], torch.full((size,), task), ids)


class Windows:
    """A dataset of random pairs, another for each task."""

    def __init__(self, task: int = 0, size: int = 20, dim: int = 3, actions: int = 2):
        draws = torch.Generator().manual_seed(task)
        self.task = self.task_id = task
        self.features = torch.randn(size, dim, generator=draws)
        self.targets = torch.randn(size, actions, generator=draws)

    def __len__(self) -> int:
        return len(self.features)

    def batch(self, indices: Tensor) -> Batch:
        indices = torch.as_tensor(indices)
        return make_batch(self.features[indices], self.targets[indices], self.task, indices)


class LinearPolicy(nn.Module):
    """Squared error of a linear map."""

    def __init__(self, dim: int = 3, actions: int = 2):
        super().__init__()
        self.linear = nn.Linear(dim, actions)

    def loss(self, batch: Batch) -> Tensor:
        out = self.linear(batch.observation.proprio["x"])
        return (out - batch.actions).square().sum(-1).mean()


class DeepPolicy(nn.Module):
    """Every kind of layer an algorithm has to treat: convolution, norms, recurrence, embedding, dropout."""

    def __init__(self, dim: int = 3, actions: int = 2, width: int = 16):
        super().__init__()
        self.inner = nn.Conv1d(1, width, dim)
        self.norm = nn.BatchNorm1d(width)
        self.place = nn.Embedding(4, width)
        self.memory = nn.LSTM(width, width, batch_first=True)
        self.layer_norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(0.2)
        self.head = nn.Linear(width, actions)

    def forward(self, x: Tensor) -> Tensor:
        b, t, d = x.shape
        h = self.norm(self.inner(x.reshape(b * t, 1, d))[:, :, 0]).reshape(b, t, -1)
        h = self.memory(h + self.place.weight[:t])[0]
        return self.head(self.dropout(self.layer_norm(h)))

    def loss(self, batch: Batch) -> Tensor:
        return (self.forward(batch.observation.proprio["x"]) - batch.actions).square().mean()
