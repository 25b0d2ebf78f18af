"""Several processes that train one policy: which one this is, and what they tell each other.

    torchrun --nproc-per-node 2 train.py algo=er

All processes ("ranks") walk through the same sequence with the same weights. At each step they draw the same
batch, with the same replay and augmentation, and each takes its own rows of it; the gradients are then added up.
So a step is that of one process with the whole batch, up to the order in which floating-point numbers are
summed. Only what a network draws for itself in training (dropout, the noise of flow matching) is another draw
on each rank.

The first rank alone writes the run's directory, records demonstrations, evaluates and speaks, while the others
wait; they read its checkpoints, so on several machines the directory must be one that all of them see.

torch's DistributedDataParallel is not used: it adds up gradients inside `backward`, where an algorithm that
calls `backward` or `autograd.grad` of its own is in its way.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from lifelong.errors import ConfigError, TrainingError

T = TypeVar("T")

_PATIENCE = timedelta(days=30)  # others wait while the first evaluates; torchrun ends them if one fails
_ADDRESS = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")  # what torchrun sets


@dataclass(frozen=True)
class Ranks:
    """This process among those that train together; by default there is no other.

    Attributes:
        rank: Its number; 0 is the first.
        size: How many there are.
        local_rank: Its number among those of this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @property
    def first(self) -> bool:
        """Whether this process writes, evaluates and speaks."""
        return self.rank == 0

    def device(self, name: str) -> torch.device:
        """The device this process computes on: `auto`, `cpu`, `cuda` (a GPU for each process), `cuda:<number>`.

        Raises:
            ConfigError: No such device, no GPU, or fewer GPUs than processes.
        """
        if name == "auto":
            name = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            device = torch.device(name)
        except RuntimeError as error:
            raise ConfigError(f"device is {name!r}; valid: auto, cpu, cuda, cuda:<number>") from error
        if device.type != "cuda":
            return device
        if not torch.cuda.is_available():
            raise ConfigError(f"device={name}, but torch finds no GPU; use device=auto or device=cpu")
        return device if self.size == 1 else self._own_gpu(device)

    def _own_gpu(self, device: torch.device) -> torch.device:
        count = torch.cuda.device_count()
        if device.index is not None or self.local_rank >= count:
            raise ConfigError(
                f"{self.size} processes need a GPU each; device={device} and {count} GPUs here do not give "
                f"them that. Use device=cuda with --nproc-per-node {count} at most, or device=cpu"
            )
        torch.cuda.set_device(self.local_rank)
        return torch.device("cuda", self.local_rank)

    def rows(self, count: int) -> slice:
        """This process's rows of a batch of `count`; all ranks' rows are all of them, none twice."""
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def wait(self) -> None:
        """Until all ranks are here."""
        self.sum(torch.zeros(1))

    def share(self, make: Callable[..., T], *args: Any) -> T:
        """What `make(*args)` gives on the first rank, given to all; the others do not call it.

        What is given travels as a pickle, between processes of one run only.
        """
        if self.size == 1:
            return make(*args)
        box: list[Any] = [make(*args) if self.first else None]
        with _together():
            dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return box[0]

    def sum(self, value: Tensor) -> Tensor:
        """The sum over all ranks, in place."""
        if self.size > 1:
            with _together():
                dist.all_reduce(value)
        return value

    @torch.no_grad()
    def sum_gradients(self, params: Sequence[Tensor]) -> None:
        """Replace each parameter's gradient by the sum over all ranks; one message for all of them.

        A parameter without a gradient counts as zero, and is left without one where no rank has one.
        """
        if self.size == 1:
            return
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in params]
        present = torch.tensor([float(p.grad is not None) for p in params], device=params[0].device)
        *sums, present = self.sum(torch.cat([*(g.reshape(-1).float() for g in grads), present])).split(
            [*(p.numel() for p in params), len(params)]
        )
        for p, total, ranks in zip(params, sums, present.tolist(), strict=True):
            if ranks and p.grad is None:
                p.grad = torch.empty_like(p)
            if ranks:
                p.grad.copy_(total.view(p.shape))

    @torch.no_grad()
    def agree(self, tensors: Sequence[Tensor]) -> None:
        """Give the first rank's values to all, in place.

        They are equal already where equal steps have equal results, which is not so of every GPU kernel.
        """
        if self.size == 1:
            return
        for tensor in tensors:
            whole = tensor.detach().contiguous()
            with _together():
                dist.broadcast(whole, src=0)
            tensor.copy_(whole)


@contextmanager
def joined() -> Iterator[Ranks]:
    """Within the context, this process is one of those that torchrun started, or the only one.

    GPUs talk through NCCL, everything else through Gloo.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or not all(name in os.environ for name in _ADDRESS):
        yield Ranks()
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    with _together():
        dist.init_process_group(backend, timeout=_PATIENCE)
    yield Ranks(dist.get_rank(), dist.get_world_size(), int(os.environ.get("LOCAL_RANK", "0")))
    dist.destroy_process_group()  # not after an error: it would wait for the others


def rank() -> int:
    """This process's number, where nothing else tells it; 0 if there is no other."""
    return dist.get_rank() if dist.is_initialized() else 0


@contextmanager
def _together() -> Iterator[None]:
    """One error for all that a lost connection brings forth."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise TrainingError(
            f"another process of this run has ended, see what it said ({reason}). The same command goes on "
            "from what was saved"
        ) from error
