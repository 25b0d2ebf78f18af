"""Adapters that are retrieved by the state."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.algorithms.frozen_base import RoutedExperts
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.nn.experts import adapted_layers, rows_per_sample, weights_of
from lifelong.nn.routing import cluster_centres, groups_of_rows, nearest_key
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.types import Count, Natural, NonNegative, Observation, Width

_CHUNK = 32  # windows per forward pass of the base


class IsCiL(RoutedExperts):
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
      was learned with, which need no adapter. Without such tasks (`base_tasks=0`) there are none; of several that are
      learned one after the other, those of all but the last embed with a base that then went on learning.
    * Linear layers and convolutions have adapters; an LSTM stays as in the base.
    """

    state_form = {**RoutedExperts.state_form, "prototypes": {int: Tensor}}

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
        super().__init__(rank=rank, alpha=alpha, adapted=adapted, base_tasks=base_tasks)
        self.bases, self.states = bases, states
        self.prototypes: dict[int, Tensor] = {}  # task -> (bases, F)

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Compute the task's prototypes and start its adapter, once the base is learned."""
        layers, draws = adapted_layers(policy, self.adapted), self._begin(task_index, policy)
        if draws is None:
            return
        states, nearest = self._embed_windows(dataset, policy, draws), None
        if self.prototypes:
            nearest = int(nearest_key(states, self.prototypes).mode().values)
        self.library.add(task_index, weights_of(layers), self.rank, draws, start=nearest)
        self.prototypes[task_index] = cluster_centres(states, self.bases, draws)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Compute the prototypes of the base, which were not known before it was learned."""
        if task_index not in self.library:
            states = self._embed_windows(dataset, policy, generator)
            self.prototypes[task_index] = cluster_centres(states, self.bases, generator)
        self._draw_seed(generator)

    def retrieve(self, states: Tensor) -> Tensor:
        """Return the task whose adapter acts on each embedding (B, F), (B,) int64 on the CPU."""
        return nearest_key(states, self.prototypes)

    def _hooks(self, policy: Policy) -> tuple[Any, Any, Any]:
        """Return the layers with adapters, what is added to their outputs, and the `encode` that retrieves."""

        def add(name: str, layer: nn.Module, x: Tensor) -> Tensor | None:
            if self._now is None:
                return None
            rows = self._now.repeat_interleave(rows_per_sample(x, len(self._now)))
            return self._grouped_output(name, layer, x, groups_of_rows(rows))

        def encode(policy: Any, own: Any, observation: Observation) -> Tensor:
            size = len(observation.images)
            self._now = None
            if self._learning is not None:
                self._now = torch.full((size,), self._learning)
            else:
                self._now = self.retrieve(_embedding(own(observation)))
            return own(observation)

        return adapted_layers(policy, self.adapted), add, encode

    @torch.no_grad()
    def _embed_windows(self, dataset: TaskWindows, policy: Policy, draws: torch.Generator) -> Tensor:
        """Return the embeddings of some of a task's windows, (n, F), in evaluation mode."""
        device, encode = device_of(policy), policy.encode  # type: ignore[attr-defined]
        chosen = torch.randperm(len(dataset), generator=draws)[: self.states]
        with in_mode(policy, training=False):
            seen = (dataset.batch(part).to(device).observation for part in chosen.split(_CHUNK))
            return torch.cat([_embedding(encode(observation)) for observation in seen])

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
        super().load_state_dict(state, datasets)


def _embedding(features: Tensor) -> Tensor:
    """Return the mean over time of features (B, T, ...), flattened to (B, F)."""
    return features.float().mean(1).flatten(1)
