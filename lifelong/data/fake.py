"""Random data that fit a policy's spec, for tests and speed measurements without files."""

import torch
from torch import Tensor

from lifelong.types import Batch, Observation, PolicySpec


def fake_observation(
    spec: PolicySpec, batch_size: int, generator: torch.Generator, steps: int | None = None
) -> Observation:
    """Return a random observation.

    Args:
        spec: Views, readings and their sizes.
        batch_size: Number of windows, B.
        generator: Draws all values, on the CPU.
        steps: Number of steps, T; None for the spec's `seq_len`.
    """
    steps = spec.seq_len if steps is None else steps
    shape = (batch_size, steps, len(spec.views), *spec.image_size, 3)
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    proprio = {k: torch.randn(batch_size, steps, d, generator=generator) for k, d in spec.proprio.items()}
    language = torch.randn(batch_size, spec.language_dim, generator=generator)
    return Observation(images, proprio, language)


def fake_batch(
    spec: PolicySpec, batch_size: int, generator: torch.Generator, steps: int | None = None
) -> Batch:
    """Return a random batch of task 0 with actions in [-1, 1]; for the arguments see `fake_observation`."""
    observation = fake_observation(spec, batch_size, generator, steps)
    actions: Tensor = 2 * torch.rand(*observation.images.shape[:2], spec.action_dim, generator=generator) - 1
    ids = torch.arange(batch_size)
    return Batch(observation, actions, torch.zeros_like(ids), ids)
