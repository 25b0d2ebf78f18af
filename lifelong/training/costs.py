"""What an algorithm costs beside the time it trains: floating-point operations, memory, what it stores.

Records hold these numbers under the names of `COSTS`; the wall time of training and evaluation is in their own
records.
"""

import copy
import resource
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.utils.flop_counter import FlopCounterMode

from lifelong.algorithms.base import Algorithm, WindowDataset
from lifelong.data.fake import fake_batch
from lifelong.data.memory import ReplayMemory
from lifelong.policies.base import Policy
from lifelong.seeding import generator, seeded

COSTS: Mapping[str, str] = {
    "parameters": "of the policy and of what the algorithm adds and trains",
    "parameters_trained": "that the optimiser moves",
    "flops_per_step": "floating-point operations of a training step, replay and penalties included",
    "flops_per_action": "floating-point operations of one action, with a full history",
    "stored_bytes": "what the algorithm keeps from task to task: its state, and the windows it may replay",
    "end_task_seconds": "wall time of what the algorithm does between two tasks",
    "peak_gpu_bytes": "largest memory held on the GPU while learning the task",
    "peak_memory_bytes": "largest memory of the process so far",
}

_FEW = 2  # windows of the smaller batch that is counted


def step_costs(
    policy: Policy, algorithm: Algorithm, windows: WindowDataset, batch_size: int
) -> dict[str, float]:
    """Parameters, and the operations of one training step.

    Steps are really made, on copies and in float32, with everything that an algorithm adds to them; optimiser and
    clipping have no matrix products and do not count. Policy and algorithm are as before afterwards. Operations
    are a constant and so many for each window, so two small batches tell those of any.

    Args:
        policy: As in the middle of training.
        algorithm: Likewise.
        windows: Of the task.
        batch_size: Windows of a step.
    """
    trained = algorithm.trained(policy)
    own = {id(p): p.numel() for p in policy.parameters()}
    every = own | {id(p): p.numel() for p in trained}
    few, many = (_step_flops(policy, algorithm, windows, size) for size in (_FEW, 2 * _FEW))
    return {
        "parameters": sum(every.values()),
        "parameters_trained": sum(p.numel() for p in trained),
        "flops_per_step": few + (many - few) * (batch_size - _FEW) / _FEW,
    }


def _step_flops(policy: Policy, algorithm: Algorithm, windows: WindowDataset, size: int) -> float:
    device, policy, algorithm = _device(policy), copy.deepcopy(policy), copy.copy(algorithm)
    batch = windows.batch(torch.arange(size) % len(windows))
    trained = algorithm.trained(policy)
    algorithm.mode_train(policy)
    with counting() as counter, seeded(0, device=device):
        mixed = algorithm.mix(batch, generator(0)).to(device)
        loss, penalty = policy.loss(mixed), algorithm.penalty(policy)
        (loss if penalty is None else loss + penalty).backward()
        algorithm.after_backward(policy)
    for parameter in trained:  # those of the algorithm are no copies
        parameter.grad = None
    return float(counter.get_total_flops())


def action_costs(policy: Policy) -> dict[str, float]:
    """Operations of one action of one simulation, averaged over `seq_len` of them with a full history.

    Args:
        policy: As it acts. Its history is lost; its mode and weights stay.
    """
    was_training, draws, steps = policy.training, generator(0), policy.spec.seq_len
    policy.eval()
    policy.reset(1)
    observation = fake_batch(policy.spec, 1, draws, steps=1).to(_device(policy)).observation
    for _ in range(steps):
        policy.act(observation, [draws])
    with counting() as counter:
        for _ in range(steps):
            policy.act(observation, [draws])
    policy.train(was_training)
    return {"flops_per_action": counter.get_total_flops() / steps}


@contextmanager
def counting() -> Iterator[FlopCounterMode]:
    """Within the context, floating-point operations are counted: two for each multiplication with its addition.

    Torch knows no formula for recurrent layers and for one kind of attention: the former are given here, and
    attention takes its plain form meanwhile.
    """
    formulas = {
        torch.ops.aten.mkldnn_rnn_layer: lambda x, w0, w1, *_, **__: _recurrent(x, [w0, w1]),
        torch.ops.aten.mkldnn_rnn_layer_backward: lambda x, w0, w1, *_, **__: 2 * _recurrent(x, [w0, w1]),
        torch.ops.aten._cudnn_rnn: lambda x, weights, *_, **__: _recurrent(x, weights),
        torch.ops.aten._cudnn_rnn_backward: lambda x, weights, *_, **__: 2 * _recurrent(x, weights),
    }
    with sdpa_kernel(SDPBackend.MATH), FlopCounterMode(display=False, custom_mapping=formulas) as counter:
        yield counter


def _recurrent(x: torch.Size, weights: Sequence[torch.Size]) -> int:
    """Products of every weight matrix with a vector, at each of the steps of x (T, B, inputs) or (B, T, inputs)."""
    return 2 * x[0] * x[1] * sum(shape[0] * shape[1] for shape in weights if len(shape) == 2)


def stored_bytes(algorithm: Algorithm) -> int:
    """Bytes an algorithm keeps from task to task: tensors of its state, and windows of its memory.

    A memory keeps indices only, as the demonstrations are at hand; its windows count with what it would have to
    store without them, uncompressed.
    """
    total = _bytes(algorithm.state_dict())
    for memory in vars(algorithm).values():
        if isinstance(memory, ReplayMemory) and len(memory):
            window = memory.sample(1, generator(0))
            frames = (window.observation.images, *window.observation.proprio.values(), window.actions)
            total += len(memory) * _bytes(list(frames))
    return total


def reset_peak(device: torch.device) -> None:
    """Begin to measure the GPU's peak memory anew."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)


def peak_costs(device: torch.device) -> dict[str, float]:
    """Peak memory: of the process since it began, and of the GPU since `reset_peak`."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found = {"peak_memory_bytes": float(peak if sys.platform == "darwin" else 1024 * peak)}
    if device.type == "cuda":
        found["peak_gpu_bytes"] = float(torch.cuda.max_memory_allocated(device))
    return found


def _device(policy: Policy) -> torch.device:
    return next(policy.parameters()).device


def _bytes(node: Any) -> int:
    if isinstance(node, Tensor):
        return node.numel() * node.element_size()
    if isinstance(node, Mapping):
        return sum(map(_bytes, node.values()))
    return sum(map(_bytes, node)) if isinstance(node, list | tuple) else 0
