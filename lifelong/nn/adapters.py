"""Low-rank adapters: which weights have them, how they are initialised, what frozen layers must not do."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import torch
from torch import Tensor, nn

from lifelong.errors import ConfigError

_WITH_STATISTICS = (nn.modules.batchnorm._BatchNorm, nn.modules.instancenorm._InstanceNorm)


def initial_pair(out: int, inputs: int, rank: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw A (rank, inputs); B (out, rank) is zero, so that B A is zero at first (Hu et al. 2022, section 4.1).

    A is uniform within 1 / sqrt(inputs), as PyTorch initialises linear layers.
    """
    a = (torch.rand(rank, inputs, generator=generator) * 2 - 1) / inputs**0.5
    return a, torch.zeros(out, rank)


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Return whether one of the patterns (`*`, `?`, `[...]`) matches the whole name."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def check_matches(found: Sequence[str], patterns: Sequence[str], names: Sequence[str], kind: str) -> None:
    """Raise an error where patterns match nothing.

    Raises:
        ConfigError: `found` is empty; the message lists some of the names that exist.
    """
    if not found:
        some = ", ".join(list(names)[:5])
        raise ConfigError(
            f"algo.adapted={list(patterns)} matches no {kind} of the policy, which has {some}, ..."
        )


def freeze_statistics(policy: nn.Module) -> None:
    """Put layers with running statistics in evaluation mode, so that training does not change these."""
    for module in policy.modules():
        if isinstance(module, _WITH_STATISTICS):
            module.eval()
