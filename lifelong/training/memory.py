"""The memory that a configuration needs at least, compared with the machine's before anything is built.

What is counted is certain, so nothing that runs is refused: a policy's weights, their gradients and Adam's moments; a
batch's images, as bytes and in half precision, as the first layer keeps them; the frames of a task's demonstrations
where `data.memory` keeps them in memory (`FRAMES` of each); the images of the episodes that run at the same time.
Activations, the simulator and copies come on top.
"""

from collections.abc import Mapping

import torch

from libero_env.memory import memory_limit
from libero_env.text import show_bytes
from lifelong.data.settings import DataSettings
from lifelong.errors import ConfigError
from lifelong.settings import Configuration
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec

FRAMES = 20  # of a demonstration; fewer than any task takes


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
    data: DataSettings, fit: FitSettings, weights: int | None, demos: int, episodes: int, replayed: float
) -> dict[str, int]:
    """Return the number of bytes that training and evaluation need at least, by what needs them.

    Args:
        data: Images and windows.
        fit: Batch.
        weights: Bytes of the policy's weights; None where they are not known, nor whether it sees images.
        demos: Largest number of demonstrations of a task.
        episodes: Number of episodes that run at the same time.
        replayed: Windows that the algorithm adds for each of the batch.
    """
    pixels = len(data.views) * data.image_size**2 * 3
    images = int(fit.batch_size * (1 + replayed)) * data.seq_len * pixels
    if weights is not None:
        images += 2 * (images // fit.accumulate)
    size = f"data.image_size={data.image_size}"
    needs = {
        f"a batch (train.batch_size={fit.batch_size}, data.seq_len={data.seq_len}, {size})": images,
        f"the images of {episodes} episodes ({size})": episodes * pixels,
    }
    if weights is not None:
        needs["the policy's weights, their gradients and Adam's moments (policy)"] = 4 * weights
    if data.memory in ("host", "pinned", "device"):
        where = f"demonstrations (data.demos={demos}, data.memory={data.memory}, {size})"
        needs[where] = demos * FRAMES * pixels
    return needs


def check_memory(needs: Mapping[str, int], available: int | None = None) -> None:
    """Refuse what this machine's memory cannot hold.

    Args:
        needs: Number of bytes that are needed at the same time, by what needs them.
        available: Number of bytes that there are. None: of this machine.

    Raises:
        ConfigError: It does not fit; the message has the estimate of the largest parts.
    """
    total, available = sum(needs.values()), memory_limit() if available is None else available
    if total > available:
        parts = [what for what in sorted(needs, key=lambda w: -needs[w]) if needs[what] * 20 >= total]
        listed = ", ".join(f"{show_bytes(needs[what])} for {what}" for what in parts)
        raise ConfigError(
            f"this needs at least {show_bytes(total)} of memory, and there are {show_bytes(available)}: {listed}. "
            "Lower one of these"
        )
