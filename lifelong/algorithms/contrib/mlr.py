"""Replay of quantised latents through frozen features, with features of similar tasks held apart."""

import math
from collections.abc import Mapping
from functools import cache
from itertools import combinations
from typing import Annotated, Any

import torch
from pydantic import Field
from torch import Tensor, nn
from torch.nn import functional

from lifelong.algorithms.base import Algorithm
from lifelong.data.latents import LATENTS_FORM, LatentMemory
from lifelong.data.windows import TaskWindows
from lifelong.nn.tokens import ProprioScaling
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.policies.history import HistoryPolicy, with_features
from lifelong.types import Batch, Count, Natural, NonNegative, Observation, Positive, Share, to_device

_SAMPLE = 512  # windows whose features describe a task
_CHUNK = 64  # windows of a forward pass
_EPS = 1e-6  # keeps the derivative of the angle finite


class MLR(Algorithm):
    """Freeze the encoders, replay latents of earlier tasks, and hold similar tasks apart by an angle.

    Multimodal latent replay with incremental feature adjustment (Yu et al. 2026, "Lifelong imitation learning with
    multimodal latent replay and incremental adjustment", CVPR, arXiv:2603.10929). With f the frozen features of
    frames (`encode`) and g the rest of the policy (`over_time` and the head), the loss of a later task is

        L(present) + ratio E_M L(g(f'), y) + adjustment sum_j max(0, angle(z, a) - angle(z, a_j) + margin angle(a, a_j))

    * M holds the features f of earlier windows, f' in eight bits with a range for each feature of each task.
    * z is the latent of a present window's last step, a the feature of its instruction, and a_j those of earlier
      instructions that are similar to the present one: among all pairs of tasks the pair is in the more similar half
      both by the features of the instructions and by those of the first camera (cosines, mean over all pairs of
      frames). So z is at least a share `margin` of the angle between two tasks nearer to its own instruction.

    The first `base_tasks` train the whole policy, without M; or none of them where it is pretrained.

    Departures from the paper and its released code: the frozen encoders there are CLIP's with adapters, pretrained on
    six tasks, and only tasks after these are replayed; here the policy's own encoders are frozen with the base, and
    the base's windows are replayed too. There latents of the present task are computed once; here its frames are
    encoded at each step, so that they can be augmented. There the windows of M and of the present task are shuffled
    together; here their shares are fixed. There latents are not quantised. Where z and a differ in size, a is
    projected by a fixed random matrix, which keeps angles approximately.
    """

    state_form = {
        "base_left": int,
        "frozen": [str],
        "memory": LATENTS_FORM,
        "instructions": Tensor,
        "images": Tensor,
        "near": Tensor,
    }

    tuned = {"adjustment": (0.0, 0.03, 0.1, 0.3), "margin": (0.4, 0.72, 1.0)}

    def __init__(
        self,
        *,
        budget: Count = 10_000,
        keep: Annotated[float, Field(gt=0, le=1)] = 1.0,
        ratio: Positive = 1.0,
        adjustment: NonNegative = 0.1,
        margin: Share = 0.72,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            budget: Largest number of windows kept over all tasks.
            keep: Largest share of a task's windows that is kept.
            ratio: Number of latent windows replayed for each window of the present task.
            adjustment: Weight of the adjustment of features; 0 switches it off.
            margin: Share of the angle between two similar instructions by which features are held apart.
            base_tasks: Number of tasks (stages, where tasks are learned together) that train the whole policy; 0 for
                a pretrained policy.
        """
        self.keep, self.adjustment, self.margin = keep, adjustment, margin
        self.ratio = ratio
        self.memory = LatentMemory(budget)
        self.base_left = base_tasks
        self.frozen: list[str] = []  # parameters that features depend on; empty while the base is learned
        self.instructions = torch.zeros(0, 0)  # (K, F) directions of the features of all instructions so far
        self.images = torch.zeros(0, 0)  # (K, G) mean directions of the first camera's features
        self.near = torch.zeros(0, 0)  # (J, F) of earlier instructions that are similar to the present ones
        # set by `mix`, used by `penalty`: what is observed; latents (B, T, ...) and actions (B, T, A)
        self._present: Observation | None = None
        self._replayed: tuple[Tensor, Tensor] | None = None

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Freeze the encoders once the base is learned, and find the earlier tasks that are similar."""
        policy = with_features(policy)
        if self.base_left:
            self.base_left -= 1
            return
        if not self.frozen:
            self.frozen = feature_parameters(policy, dataset.batch(torch.tensor([0])))
        if self.adjustment and len(self.instructions):
            self.near = self._similar(*describe(policy, dataset))

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the parameters after the features; all of them while the base is learned."""
        for name, parameter in policy.named_parameters():
            if name in self.frozen:
                parameter.requires_grad_(False)
                parameter.grad = None  # of the base
        return super().trained(policy)

    def mode_train(self, policy: Policy) -> None:
        """Set training mode, but for modules that are frozen whole: no dropout and no statistics change features."""
        policy.train()
        frozen = {id(p) for name, p in policy.named_parameters() if name in self.frozen}
        for module in policy.modules():
            own = [id(p) for p in module.parameters()]
            if (own and frozen.issuperset(own)) or (frozen and isinstance(module, ProprioScaling)):
                module.eval()

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch unchanged; latents of earlier windows are drawn."""
        if self.frozen and len(self.memory):
            self._replayed = self.memory.sample(max(1, round(self.ratio * len(batch))), generator)
            self._present = batch.observation if len(self.near) else None
        return batch

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return the loss of the drawn latents and the adjustment of the present features, a scalar."""
        if self._replayed is None:
            return None
        policy, device = with_features(policy), device_of(policy)
        latents, actions = (
            to_device(x.pin_memory() if device.type == "cuda" else x, device) for x in self._replayed
        )
        losses = policy.head.losses(policy.head(policy.over_time(latents)), actions)
        total = self.ratio * losses.mean()
        if self._present is not None:
            total = total + self.adjustment * self._adjust(policy, self._present.to(device))
        self._replayed = self._present = None
        return total

    def _adjust(self, policy: HistoryPolicy, observation: Observation) -> Tensor:
        """Return how far present features are on the wrong side of the margin, mean over windows, a scalar."""
        with torch.no_grad():
            features = policy.encode(observation)
        z = policy.over_time(features)[:, -1]
        own = _direction(policy.modalities(features)["language"][:, 0].float().flatten(1))
        return adjust(z, own, to_device(self.near, own.device), self.margin)

    def _similar(self, instructions: Tensor, images: Tensor) -> Tensor:
        """Return the directions (J, F) of earlier instructions that are similar to a task's, see `similar_pairs`."""
        count = len(self.instructions)
        every = torch.cat([self.instructions, instructions]), torch.cat([self.images, images])
        pairs = similar_pairs(*every)
        return self.instructions[sorted({i for i, j in pairs if i < count <= j})]

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store latents of the task; none before the last base task, as features still change."""
        if self.base_left:
            return
        policy = with_features(policy)
        count = min(max(1, round(self.keep * len(dataset))), self.memory.budget)
        kept = torch.randperm(len(dataset), generator=generator)[:count]
        self.memory.add(task_index, encoded(policy, dataset, kept), _actions(dataset, kept))
        known = [x for x in (self.instructions, self.images) if len(x)]
        described = describe(policy, dataset)
        self.instructions, self.images = (
            described if not known else map(torch.cat, zip(known, described, strict=True))
        )
        self.near = self.near[:0]

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned; no dataset is read."""
        on_host = {name: state[name].cpu() for name in ("instructions", "images", "near")}
        super().load_state_dict({**state, **on_host}, datasets)


def feature_parameters(policy: HistoryPolicy, batch: Batch) -> list[str]:
    """Return the names of the parameters that the features of frames depend on.

    Args:
        batch: Windows whose features are computed, one at least.
    """
    named = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    with in_mode(policy, training=False), torch.enable_grad():
        features = policy.encode(batch.to(device_of(policy)).observation)
        gradients = torch.autograd.grad(features.float().sum(), list(named.values()), allow_unused=True)
    return [name for name, gradient in zip(named, gradients, strict=True) if gradient is not None]


@torch.no_grad()
def encoded(policy: HistoryPolicy, dataset: TaskWindows, windows: Tensor) -> Tensor:
    """Return the features of windows in evaluation mode, on the CPU, (n,) -> (n, T, ...)."""
    device = device_of(policy)
    with in_mode(policy, training=False):
        parts = [policy.encode(dataset.batch(rows).to(device).observation) for rows in windows.split(_CHUNK)]
    return torch.cat([part.float().cpu() for part in parts])


def describe(policy: HistoryPolicy, dataset: TaskWindows) -> tuple[Tensor, Tensor]:
    """Return directions of the features of a task, or of each of several that are learned together.

    Args:
        dataset: Windows of the task, of which at most 512 are used.

    Returns:
        For each instruction the direction of its features (K, F), and the mean direction of the first camera's features
        (K, G): the product of two rows is the mean cosine over all pairs of frames.
    """
    count = min(len(dataset), _SAMPLE)
    windows = torch.linspace(0, len(dataset) - 1, count).round().long()
    parts = policy.modalities(encoded(policy, dataset, windows))
    words = _direction(parts["language"][:, 0].flatten(1))  # (n, F)
    view = next(
        (part for name, part in parts.items() if name not in ("language", "proprio")), parts["language"]
    )
    seen = _direction(view.flatten(2)).mean(1)  # (n, G)
    texts = torch.cat([dataset.batch(rows).observation.language.cpu() for rows in windows.split(_CHUNK)])
    _, which = texts.unique(dim=0, return_inverse=True)
    of_each = [which == k for k in range(int(which.max()) + 1)]
    return torch.stack([words[k][0] for k in of_each]), torch.stack([seen[k].mean(0) for k in of_each])


def similar_pairs(instructions: Tensor, images: Tensor) -> list[tuple[int, int]]:
    """Return the pairs of tasks that are in the more similar half by their instructions and by their images.

    Args:
        instructions: Directions (K, F) of the tasks' instructions.
        images: Mean directions (K, G) of their images.
    """
    pairs = list(combinations(range(len(instructions)), 2))
    half = math.ceil(len(pairs) / 2)
    similar = set(range(len(pairs)))
    for directions in (instructions, images):
        cosines = torch.stack([directions[i] @ directions[j] for i, j in pairs])
        similar &= set(cosines.topk(half).indices.tolist())
    return [pairs[k] for k in sorted(similar)]


def adjust(z: Tensor, own: Tensor, near: Tensor, margin: float) -> Tensor:
    """Return sum_j max(0, angle(z, own) - angle(z, near_j) + margin angle(own, near_j)), mean over windows, a scalar.

    Args:
        z: Latents of the policy, (B, E).
        own: Direction of each window's instruction, (B, F).
        near: Directions of similar instructions, (J, F).
        margin: Share of the angle between own and similar.
    """
    with torch.autocast(z.device.type, enabled=False):
        gap = _angle(own @ near.T)  # (B, J)
        own, near, z = _fitted(own, z.shape[-1]), _fitted(near, z.shape[-1]), _direction(z.float())
        wrong = _angle((z * own).sum(-1, keepdim=True)) - _angle(z @ near.T) + margin * gap
        return wrong.relu().sum(-1).mean()


def _fitted(directions: Tensor, size: int) -> Tensor:
    """Return directions (K, F) in a space of `size` numbers: as they are, or projected by a fixed random matrix."""
    if directions.shape[-1] == size:
        return directions
    return _direction(directions @ _projection(directions.shape[-1], size, directions.device))


@cache
def _projection(inputs: int, outputs: int, device: torch.device) -> Tensor:
    """Return the fixed random matrix (inputs, outputs)."""
    return torch.randn(inputs, outputs, generator=torch.Generator().manual_seed(0)).to(device)


def _angle(cosine: Tensor) -> Tensor:
    return cosine.clamp(-1 + _EPS, 1 - _EPS).acos()


def _direction(x: Tensor) -> Tensor:
    return functional.normalize(x, dim=-1)


def _actions(dataset: TaskWindows, windows: Tensor) -> Tensor:
    """Return the actions of windows on the CPU, (n,) -> (n, T, A)."""
    return torch.cat([dataset.batch(rows).actions.cpu() for rows in windows.split(_CHUNK)])
