"""Random data from a policy's spec, for tests and speed measurements that need no files."""

import torch
from torch import Tensor

from lifelong.types import Batch, Observation, PolicySpec


def fake_observation(
    spec: PolicySpec, batch_size: int, generator: torch.Generator, steps: int | None = None
) -> Observation:
    """A random observation.

    Args:
        spec: what the policy sees.
        batch_size: B.
        generator: a CPU generator.
        steps: T; None: the spec's `seq_len`.
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
    """A random batch: see `fake_observation`; actions are uniform in [-1, 1], task ids 0."""
    observation = fake_observation(spec, batch_size, generator, steps)
    actions: Tensor = 2 * torch.rand(*observation.images.shape[:2], spec.action_dim, generator=generator) - 1
    ids = torch.arange(batch_size)
    return Batch(observation, actions, torch.zeros_like(ids), ids)
