"""Data-parallel training of one policy by several processes: their ranks and their communication.

    torchrun --nproc-per-node 2 train.py algo=er

All processes ("ranks") learn the same task sequence with the same weights. At each step they draw the same batch,
with the same replay and augmentation, and each computes its own rows of it; the gradients are then summed. So a step
equals that of one process with the whole batch, up to the order in which floating-point numbers are summed. Only
what a network draws itself in training (dropout, the noise of flow matching) differs between ranks.

The first rank alone writes the run's directory, records demonstrations, evaluates and prints, while the others
wait. They read its checkpoints, so on several machines the directory must be on a shared file system.

torch's DistributedDataParallel is not used: it sums gradients inside `backward`, which conflicts with algorithms
that call `backward` or `autograd.grad` themselves.
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

_TIMEOUT = timedelta(days=30)  # the others wait while the first evaluates; torchrun ends them if one fails
_TORCHRUN_VARIABLES = ("RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")


@dataclass(frozen=True)
class Ranks:
    """Rank of this process among those that train together; by default it is the only one.

    Attributes:
        rank: Number of this process; 0 is the first.
        size: Number of processes.
        local_rank: Number of this process among those on this machine.
    """

    rank: int = 0
    size: int = 1
    local_rank: int = 0

    @property
    def first(self) -> bool:
        """Whether this process writes files, evaluates and prints."""
        return self.rank == 0

    def device(self, name: str) -> torch.device:
        """Return the device this process computes on.

        Args:
            name: `auto`, `cpu`, `cuda` (a GPU for each process) or `cuda:<number>`.

        Raises:
            ConfigError: The device does not exist, or there are fewer GPUs than processes.
        """
        if name == "auto":
            name = "cuda" if torch.cuda.is_available() else "cpu"
        try:
            device = torch.device(name)
        except (RuntimeError, ValueError) as error:
            raise ConfigError(f"device is {name!r}; valid: auto, cpu, cuda, cuda:<number>") from error
        if device.type == "cpu":
            return device
        if device.type not in ("cuda", "mps"):  # such as meta, which holds no values
            raise ConfigError(f"device is {name!r}; valid: auto, cpu, cuda, cuda:<number>")
        what, found = ("GPU", torch.cuda) if device.type == "cuda" else ("Metal device", torch.backends.mps)
        if not found.is_available():
            raise ConfigError(f"device={name}, but torch finds no {what}; use device=auto or device=cpu")
        if device.type == "mps":
            return device
        if (device.index or 0) >= (count := torch.cuda.device_count()):
            raise ConfigError(f"device={name}, but this machine has {count} GPUs, counted from 0")
        return device if self.size == 1 else self._own_gpu(device)

    def _own_gpu(self, device: torch.device) -> torch.device:
        count = torch.cuda.device_count()
        if device.index is not None or self.local_rank >= count:
            raise ConfigError(
                f"{self.size} processes need a GPU each, but device={device} and this machine has {count} GPUs. "
                f"Use device=cuda with --nproc-per-node {count} at most, or device=cpu"
            )
        torch.cuda.set_device(self.local_rank)
        return torch.device("cuda", self.local_rank)

    def local_rows(self, count: int) -> slice:
        """Return this process's rows of a batch of `count`; every row belongs to exactly one rank."""
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def barrier(self) -> None:
        """Wait until all ranks have reached this call."""
        self.sum(torch.zeros(1))

    def broadcast(self, make: Callable[..., T], *args: Any) -> T:
        """Call `make(*args)` on the first rank only, and return its result on all ranks.

        The result is pickled, between processes of one run only.
        """
        if self.size == 1:
            return make(*args)
        box: list[Any] = [make(*args) if self.first else None]
        with _connection_errors():
            dist.broadcast_object_list(box, src=0, device=torch.device("cpu"))
        return box[0]

    def sum(self, value: Tensor) -> Tensor:
        """Sum a tensor over all ranks, in place, and return it."""
        if self.size > 1:
            with _connection_errors():
                dist.all_reduce(value)
        return value

    @torch.no_grad()
    def sum_gradients(self, params: Sequence[Tensor]) -> None:
        """Replace each parameter's gradient by its sum over all ranks, in one message.

        A missing gradient counts as zero; it stays missing where no rank has one.
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
    def synchronise(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite the tensors with those of the first rank, in place.

        They are equal already where kernels are deterministic, which not all GPU kernels are.
        """
        if self.size == 1:
            return
        for tensor in tensors:
            whole = tensor.detach().contiguous()
            with _connection_errors():
                dist.broadcast(whole, src=0)
            tensor.copy_(whole)


@contextmanager
def process_group() -> Iterator[Ranks]:
    """Join the processes that torchrun started, if it did, and yield the ranks; leave the group afterwards.

    GPUs communicate through NCCL, everything else through Gloo.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or not all(
        name in os.environ for name in _TORCHRUN_VARIABLES
    ):
        yield Ranks()
        return
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    with _connection_errors():
        dist.init_process_group(backend, timeout=_TIMEOUT)
    yield Ranks(dist.get_rank(), dist.get_world_size(), int(os.environ.get("LOCAL_RANK", "0")))
    dist.destroy_process_group()  # not after an error: it would wait for the others


def rank() -> int:
    """Return the rank of this process where no `Ranks` is at hand; 0 if it is the only one."""
    return dist.get_rank() if dist.is_initialized() else 0


@contextmanager
def _connection_errors() -> Iterator[None]:
    """Turn the errors of a lost connection into one TrainingError."""
    try:
        yield
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        raise TrainingError(
            f"another process of this run has ended; see its error message ({reason}). Run the same command to "
            "resume from what was saved"
        ) from error
