"""Costs of an algorithm besides training time: floating-point operations, memory and storage.

Records hold these numbers under the names of `lifelong.report.tables.COST_COLUMNS`; the wall time of training and of
evaluation has records of its own.
"""

import copy
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from typing import Any

import psutil
import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from lifelong.algorithms.base import Algorithm
from lifelong.data.fake import fake_batch
from lifelong.data.memory import ReplayMemory, TaskMemory
from lifelong.data.windows import WindowDataset
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.seeding import generator, seeded

_SMALL_BATCH = 2  # [windows] least size of the smaller of the two batches whose operations are counted


def step_costs(
    policy: Policy, algorithm: Algorithm, windows: WindowDataset, batch_size: int
) -> dict[str, float]:
    """Count the parameters, and the floating-point operations of one training step.

    Real steps are made, on copies and in float32, with replay and penalties: matrix products and convolutions count,
    and element-wise operations of a penalty that has none of these, such as that of EWC. Those of layers, clipping, the
    optimiser and what follows it do not. Policy and algorithm are unchanged afterwards. The number of operations is
    linear in the batch size, so two small batches determine that of any; they are such that replay has its exact share
    of both.

    Args:
        policy: Policy in the middle of training.
        algorithm: Algorithm in the middle of training.
        batch_size: Number of windows per step.
    """
    trained = algorithm.trained(policy)
    sizes = {id(p): p.numel() for p in (*policy.parameters(), *trained)}
    small = Fraction(getattr(algorithm, "ratio", 1)).limit_denominator(batch_size).denominator
    small *= -(-_SMALL_BATCH // small)
    few, many = (_step_flops(policy, algorithm, windows, size) for size in (small, 2 * small))
    return {
        "parameters": sum(sizes.values()),
        "parameters_trained": algorithm.count_trained(policy),
        "flops_per_step": few + (many - few) * (batch_size - small) / small,
    }


def _step_flops(policy: Policy, algorithm: Algorithm, windows: WindowDataset, size: int) -> float:
    device, policy, algorithm = device_of(policy), copy.deepcopy(policy), copy.copy(algorithm)
    batch = windows.batch(torch.arange(size) % len(windows))
    trained = algorithm.trained(policy)
    algorithm.mode_train(policy)
    elementwise = _Elementwise()
    with seeded(0, device=device):
        with count_flops() as counter:
            mixed = algorithm.mix(batch, generator(0)).to(device)
            loss, before = policy.loss(mixed), counter.get_total_flops()
            with elementwise:
                penalty = algorithm.penalty(policy)
            of_weights = counter.get_total_flops() == before
        if penalty is not None and of_weights and penalty.requires_grad:
            with elementwise:
                torch.autograd.grad(penalty, trained, retain_graph=True, allow_unused=True)
        with count_flops() as after:
            (loss if penalty is None else loss + penalty).backward()
            algorithm.after_backward(policy)
    for parameter in trained:  # the algorithm's own parameters are not copied
        parameter.grad = None
    products = counter.get_total_flops() + after.get_total_flops()
    return float(products + (elementwise.count if of_weights else 0))


class _Elementwise(TorchDispatchMode):
    """Counts an operation for each number that an element-wise function gives or a sum takes, two for a product's."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        found = func(*args, **(kwargs or {}))
        if func.overloadpacket in (torch.ops.aten.sum, torch.ops.aten.dot):
            self.count += args[0].numel() * (1 + (func.overloadpacket is torch.ops.aten.dot))
        elif func.overloadpacket.__name__.startswith("_foreach_"):
            self.count += sum(tensor.numel() for tensor in args[0])
        elif torch.Tag.pointwise in func.tags and isinstance(found, Tensor):
            self.count += found.numel()
        return found


def action_costs(policy: Policy, language: Tensor) -> dict[str, float]:
    """Count the operations of one action in one simulation with a full history: the mean over those of one plan.

    Args:
        policy: Policy to measure. Its history is reset; its mode and weights stay.
        language: Embedding of an instruction that it has learned, (L,).
    """
    draws = generator(0)
    policy.reset(1)
    observation = fake_batch(policy.spec, 1, draws, steps=1).to(device_of(policy)).observation
    observation = replace(observation, language=language[None].to(observation.language))
    with in_mode(policy, training=False):
        for _ in range(policy.spec.seq_len):
            policy.act(observation, [draws])
        with count_flops() as counter:
            for _ in range(policy.execute):
                policy.act(observation, [draws])
    return {"flops_per_action": counter.get_total_flops() / policy.execute}


@contextmanager
def count_flops() -> Iterator[FlopCounterMode]:
    """Count the floating-point operations within the context: two for each multiplication with its addition.

    Torch has no formula for recurrent layers, so they are given here, nor for one of its attention kernels, so
    attention is computed as plain matrix products within the context.
    """
    formulas = {
        torch.ops.aten.mkldnn_rnn_layer: lambda x, w0, w1, *_, **__: _recurrent_flops(x, [w0, w1]),
        torch.ops.aten.mkldnn_rnn_layer_backward: lambda x, w0, w1, *_, **__: (
            2 * _recurrent_flops(x, [w0, w1])
        ),
        torch.ops.aten._cudnn_rnn: lambda x, weights, *_, **__: _recurrent_flops(x, weights),
        torch.ops.aten._cudnn_rnn_backward: lambda x, weights, *_, **__: 2 * _recurrent_flops(x, weights),
    }
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False, custom_mapping=formulas) as counter:
        yield counter


def _recurrent_flops(x: torch.Size, weights: Sequence[torch.Size]) -> int:
    """Count the products of every weight matrix with a vector, at each step of x (T, B, D) or (B, T, D)."""
    return 2 * x[0] * x[1] * sum(shape[0] * shape[1] for shape in weights if len(shape) == 2)


def stored_bytes(algorithm: Algorithm) -> int:
    """Count the bytes an algorithm keeps from task to task: tensors of its state, and frames of its memory.

    A memory stores indices only, because the demonstrations stay available. The frames of its windows count with the
    size they would have without the demonstrations, uncompressed, and once where windows overlap.
    """
    total = _count_bytes(algorithm.state_dict())
    for memory in vars(algorithm).values():
        if isinstance(memory, ReplayMemory) and len(memory):
            windows = memory.sample(1, generator(0))
            read = [windows.observation.images, *windows.observation.proprio.values(), windows.actions]
            total += memory.count_frames() * _count_bytes(read) // windows.actions[..., 0].numel()
    return total


def windows_kept(algorithm: Algorithm) -> int:
    """Count the windows of earlier tasks that an algorithm replays, as they are or compressed or as latents."""
    return sum(len(memory) for memory in vars(algorithm).values() if isinstance(memory, TaskMemory))


def reset_peak(device: torch.device) -> None:
    """Reset the GPU's peak memory statistics."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_costs(device: torch.device) -> dict[str, float]:
    """Return the peak memory of the process since its start, and of the GPU since `reset_peak`, [bytes]."""
    peaks = {"peak_memory_bytes": float(_peak_memory())}
    if device.type == "cuda":
        peaks["peak_gpu_bytes"] = float(torch.cuda.max_memory_allocated(device))
    return peaks


def _peak_memory() -> int:
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _count_bytes(node: Any) -> int:
    if isinstance(node, Tensor):
        return node.numel() * node.element_size()
    if isinstance(node, Mapping):
        return sum(map(_count_bytes, node.values()))
    return sum(map(_count_bytes, node)) if isinstance(node, list | tuple) else 0
