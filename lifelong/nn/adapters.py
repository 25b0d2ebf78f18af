"""Low-rank adapters: which weights get them, how they start, what frozen layers must not do."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import torch
from torch import Tensor, nn

from lifelong.errors import ConfigError

_WITH_STATISTICS = (nn.modules.batchnorm._BatchNorm, nn.modules.instancenorm._InstanceNorm)


def start_pair(out: int, inputs: int, rank: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """A (rank, inputs) at random and B (out, rank) zero, so that B A is zero at first (Hu et al. 2022, section 4.1).

    A is uniform within 1 / sqrt(inputs), as PyTorch starts linear layers.
    """
    a = (torch.rand(rank, inputs, generator=generator) * 2 - 1) / inputs**0.5
    return a, torch.zeros(out, rank)


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Whether one of the patterns (`*`, `?`, `[...]`) fits the whole name."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def check_found(found: Sequence[str], patterns: Sequence[str], names: Sequence[str], kind: str) -> None:
    """Complain where patterns fit nothing.

    Raises:
        ConfigError: `found` is empty; the message gives some of the names that there are.
    """
    if not found:
        some = ", ".join(list(names)[:5])
        raise ConfigError(
            f"algo.adapted={list(patterns)} fits no {kind} of the policy, which has {some}, ..."
        )


def freeze_statistics(policy: nn.Module) -> None:
    """Put layers with running statistics in evaluation mode, so that training does not move these."""
    for module in policy.modules():
        if isinstance(module, _WITH_STATISTICS):
            module.eval()
