"""The memory that a configuration needs at least, compared with the machine's before anything is built.

What is counted is certain, so nothing that runs is refused: a policy's weights, their gradients and Adam's moments; a
batch's images, as bytes and in half precision, as the first layer keeps them; the frames of a task's demonstrations
where `data.memory` keeps them in memory (`FRAMES` of each); the images of the episodes that run at the same time.
Activations, the simulator and copies come on top.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from libero_env.memory import memory_limit
from lifelong.data.settings import DataSettings
from lifelong.errors import ConfigError
from lifelong.settings import Configuration
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec

FRAMES = 20  # of a demonstration; fewer than any task takes


@dataclass(frozen=True)
class Need:
    """Memory that something needs at least.

    Attributes:
        what: What needs it, with the keys on which it depends.
        nbytes: Number of bytes.
    """

    what: str
    nbytes: int


def policy_bytes(config: Configuration, spec: PolicySpec) -> int | None:
    """Return the number of bytes of a policy's weights, without making them; None for one with parts of a user's own.

    Sizes that do not work together are found on the way, before anything slow.

    Args:
        config: A configuration that was checked.
        spec: What the policy observes and does.

    Raises:
        PolicyError: The policy cannot be built with these sizes.
        ConfigError: The policy is beyond all memory.
    """
    if not config.is_own("policy"):
        return None
    try:
        with torch.random.fork_rng(devices=[]), torch.device("meta"):
            policy = config.build("policy", spec=spec)
    except RuntimeError as error:
        if "overflow" not in str(error):
            raise
        raise ConfigError("policy: its sizes give more weights than any memory holds; lower them") from error
    return sum(tensor.nbytes for tensor in (*policy.parameters(), *policy.buffers()))


def training_needs(
    data: DataSettings,
    fit: FitSettings,
    weights: int | None,
    demos: int,
    episodes: int,
    replayed: float,
) -> list[Need]:
    """Return what training and evaluation need at least.

    Args:
        data: Images and windows.
        fit: Batch.
        weights: Bytes of the policy's weights; None where they are not known, nor whether it sees images.
        demos: Largest number of demonstrations of a task.
        episodes: Number of episodes that run at the same time.
        replayed: Windows that the algorithm adds for each of the batch.
    """
    pixels = len(data.views) * data.image_size**2 * 3
    windows = int(fit.batch_size * (1 + replayed))
    images = windows * data.seq_len * pixels
    if weights is not None:
        images += 2 * (images // fit.accumulate)
    shape = f"data.image_size={data.image_size}"
    needs = [
        Need(f"a batch (train.batch_size={fit.batch_size}, data.seq_len={data.seq_len}, {shape})", images),
        Need(f"the images of {episodes} episodes ({shape})", episodes * pixels),
    ]
    if weights is not None:
        needs.append(Need("the policy's weights, their gradients and Adam's moments (policy)", 4 * weights))
    if data.memory in ("host", "pinned", "device"):
        frames = demos * FRAMES * pixels
        needs.append(Need(f"demonstrations (data.demos={demos}, data.memory={data.memory}, {shape})", frames))
    return needs


def check_memory(needs: Sequence[Need], available: int | None = None) -> None:
    """Refuse what this machine's memory cannot hold.

    Args:
        needs: What is needed at the same time.
        available: Number of bytes that there are. None: of this machine.

    Raises:
        ConfigError: It does not fit; the message has the estimate of each part.
    """
    total, available = sum(need.nbytes for need in needs), memory_limit() if available is None else available
    if total > available:
        parts = [need for need in sorted(needs, key=lambda n: -n.nbytes) if need.nbytes * 20 >= total]
        listed = ", ".join(f"{_amount(need.nbytes)} for {need.what}" for need in parts)
        raise ConfigError(
            f"this needs at least {_amount(total)} of memory, and there are {_amount(available)}: {listed}. "
            "Lower one of these"
        )


def _amount(nbytes: int) -> str:
    amount, units = float(nbytes), ["bytes", "KiB", "MiB", "GiB", "TiB", "PiB", "EiB"]
    while amount >= 1024 and len(units) > 1:
        amount, units = amount / 1024, units[1:]
    return f"{amount:.3g} {units[0]}" if amount < 1e4 else f"{amount:.0e} {units[0]}"
