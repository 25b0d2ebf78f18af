"""Adapters that are retrieved by the state."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.nn.adapters import freeze_statistics
from lifelong.nn.experts import (
    Attachment,
    ExpertLibrary,
    adapted_layers,
    expert_output,
    rows_per_sample,
    weights_of,
)
from lifelong.nn.routing import cluster_centres, groups_of_rows, nearest_key
from lifelong.policies.base import Policy
from lifelong.types import Count, Natural, NonNegative, Observation, Width

_CHUNK = 32  # windows per forward pass of the base


class IsCiL(Algorithm):
    """Learn an adapter for each task, and retrieve the one whose states are most like the present one.

    Lee et al., "Incremental learning of retrievable skills for efficient continual task adaptation", NeurIPS 2024,
    arXiv:2410.22658. The features of the frozen base embed a state. A skill is a low-rank adapter with several
    prototypes: `bases` centres of k-means clusters of its demonstrations' embeddings. The adapter of the prototype
    with the largest cosine similarity acts (section 3); no task number is needed. A new adapter starts as a copy of
    the one that the task's states retrieve most often. The base and earlier adapters never change, so the actions on
    states that retrieve an earlier adapter stay bit-identical.

    An embedding is the mean over a window's frames of what `policy.encode` returns without adapters. Windows in
    training use the task's adapter; otherwise every window, and every step of an episode, retrieves its own. Features
    of earlier frames, which a policy keeps while it acts, stay as the adapter of their time computed them.

    Departures:

    * A task is one skill, as in the adaptation of IsCiL to LIBERO by Lei et al. 2025 (arXiv:2506.05985); the paper
      divides demonstrations into skills by annotated sub-goals.
    * The paper embeds states with given encoders; here the base does it, so its prototypes are those of the tasks it
      was learned with, which need no adapter. Without such tasks (`base_tasks=0`) there are none.
    * Linear layers and convolutions have adapters; an LSTM stays as in the base.
    """

    state_form = {
        **dict.fromkeys(("task_index", "base_left", "seed"), int),
        "library": ExpertLibrary.form,
        "prototypes": {int: Tensor},
    }

    def __init__(
        self,
        *,
        rank: Width = 16,
        alpha: NonNegative = 32.0,
        adapted: Sequence[str] = ("*",),
        bases: Width = 20,
        states: Count = 1000,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            rank: Rank of an adapter.
            alpha: Numerator of the adapters' scale alpha / rank.
            adapted: Patterns of names of the weights whose layers get adapters, e.g. `transformer.*`, `head.*`.
            bases: Number of prototypes of an adapter.
            states: Number of a task's windows that the prototypes are computed from.
            base_tasks: Number of tasks (stages, where tasks are learned together) that train the whole policy, which
                is frozen afterwards; 0 for a pretrained policy.
        """
        self.rank, self.scale, self.adapted = rank, alpha / rank, tuple(adapted)
        self.bases, self.states = bases, states
        self.task_index, self._base_left, self._seed = -1, base_tasks, 0
        self._library, self._attachment = ExpertLibrary(), Attachment()
        self._prototypes: dict[int, Tensor] = {}  # task -> (bases, F)
        self._learning: int | None = None  # task whose adapter all windows use; None: each retrieves its own
        self._now: Tensor | None = None  # (B,), task of each row's adapter; None: the base alone

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Compute the task's prototypes and start its adapter, once the base is learned."""
        self.task_index, layers = task_index, adapted_layers(policy, self.adapted)
        if self._base_left:
            self._base_left -= 1
            return
        policy.zero_grad()
        draws = torch.Generator().manual_seed(self._seed)
        states, nearest = self._embed_windows(dataset, policy, draws), None
        if self._prototypes:
            nearest = int(nearest_key(states, self._prototypes).mode().values)
        self._library.add(task_index, weights_of(layers), self.rank, draws, start=nearest)
        self._prototypes[task_index] = cluster_centres(states, self.bases, draws)

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the parameters of the task's adapter; everything while the base is learned."""
        if self.task_index not in self._library:
            return super().trained(policy)
        policy.requires_grad_(False)
        self._learning = self.task_index
        self._attachment.attach(policy, *self._hooks(policy))
        return self._library.parameters(self.task_index)

    def mode_train(self, policy: Policy) -> None:
        """Set training mode, with running statistics frozen with the base."""
        policy.train()
        if self._library:
            freeze_statistics(policy)

    def end_phase(self, phase: Any, policy: Policy) -> None:
        """Remove the adapter from the policy's layers."""
        self._attachment.detach(policy)
        self._learning = self._now = None

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Compute the prototypes of the base, which were not known before it was learned."""
        if task_index not in self._library:
            states = self._embed_windows(dataset, policy, generator)
            self._prototypes[task_index] = cluster_centres(states, self.bases, generator)
        self._seed = int(torch.randint(2**62, (), generator=generator))

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy that retrieves adapters, the same for every task."""
        if not self._library:
            yield policy
            return
        learning, self._learning = self._learning, None
        try:
            with self._attachment.within(policy, *self._hooks(policy)):
                yield policy
        finally:
            self._learning, self._now = learning, None

    def retrieve(self, states: Tensor) -> Tensor:
        """Return the task whose adapter acts on each embedding (B, F), (B,) int64."""
        return nearest_key(states, self._prototypes)

    def _hooks(self, policy: Policy) -> tuple[Any, Any, Any]:
        """Return the layers with adapters, what is added to their outputs, and the `encode` that retrieves."""

        def add(name: str, layer: nn.Module, x: Tensor) -> Tensor | None:
            return None if self._now is None else self._added(name, layer, x, self._now)

        def encode(policy: Any, own: Any, observation: Observation) -> Tensor:
            size = len(observation.images)
            self._now = None
            if self._learning is not None:
                self._now = torch.full((size,), self._learning)
            else:
                self._now = self.retrieve(_embedding(own(observation)))
            return own(observation)

        return adapted_layers(policy, self.adapted), add, encode

    def _added(self, name: str, layer: nn.Module, x: Tensor, tasks: Tensor) -> Tensor | None:
        """Return the adapters' outputs, each on its rows; None where all rows use the base alone."""
        total: Tensor | None = None
        for task, rows in groups_of_rows(tasks.repeat_interleave(rows_per_sample(x, len(tasks)))):
            if task not in self._library:
                continue
            part = self.scale * expert_output(
                layer, x if rows is None else x[rows], [self._library[task][name]]
            )
            if rows is None:
                return part
            if total is None:
                total = part.new_zeros(len(x), *part.shape[1:])
            total[rows] = part
        return total

    @torch.no_grad()
    def _embed_windows(self, dataset: TaskWindows, policy: Policy, draws: torch.Generator) -> Tensor:
        """Return the embeddings of some of a task's windows, (n, F), in evaluation mode."""
        device, was_training = next(policy.parameters()).device, policy.training
        policy.eval()
        chosen = torch.randperm(len(dataset), generator=draws)[: self.states]
        encode: Any = policy.encode  # type: ignore[attr-defined]
        found = [
            _embedding(encode(dataset.batch(part).to(device).observation)) for part in chosen.split(_CHUNK)
        ]
        policy.train(was_training)
        return torch.cat(found)

    def sizes(self) -> dict[int, int]:
        """Return the number of parameters of each task's adapter."""
        return self._library.sizes()

    def state_dict(self) -> dict[str, Any]:
        """Return all adapters and prototypes."""
        place = {"task_index": self.task_index, "base_left": self._base_left, "seed": self._seed}
        return {**place, "library": self._library.state(), "prototypes": dict(self._prototypes)}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: Adapters and prototypes do not go together.
        """
        prototypes, library = state["prototypes"], list(state["library"].values())
        fits = all(p.dim() == 2 and len(p) for p in prototypes.values())
        fits = fits and len({p.shape[1] for p in prototypes.values()}) <= 1
        fits &= state["library"].keys() <= prototypes.keys()
        if not fits or any(of_task.keys() != library[0].keys() for of_task in library):
            raise CheckpointError("the adapters and their prototypes do not go together")
        self.task_index, self._base_left = int(state["task_index"]), int(state["base_left"])
        self._seed, self._prototypes = int(state["seed"]), dict(prototypes)
        self._library.load(state["library"])


def _embedding(features: Tensor) -> Tensor:
    """Return the mean over time of features (B, T, ...), flattened to (B, F)."""
    return features.float().mean(1).flatten(1)
