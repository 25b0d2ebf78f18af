"""Adapters that are added and chosen layer by layer, by how well autoencoders know a layer's inputs."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from lifelong.algorithms.frozen_base import RoutedExperts
from lifelong.data.windows import TaskWindows
from lifelong.errors import CheckpointError
from lifelong.nn.experts import Add, adaptable_modules, matrix_of
from lifelong.nn.routing import Discriminator, groups_of_rows
from lifelong.policies.base import Policy, device_of, in_mode
from lifelong.types import Count, Natural, NonNegative, Positive, Width

BASE = -1  # in place of a task whose adapter is used: none
_CHUNK = 32  # windows per forward pass
_ROWS = 512  # samples of a layer's inputs that an autoencoder learns from

Samples = dict[str, Tensor]  # layer -> its inputs (n, tokens, D)


class CLARE(RoutedExperts):
    """Add adapters where a task's features are new, and let autoencoders choose among them.

    Römer, Zhang and Schoellig 2026, "CLARE: continual learning for vision-language-action models via autonomous
    adapter routing and expansion", arXiv:2601.09512. A layer computes `FFN(x) + B relu(A x)` with the base frozen.
    Every layer has an autoencoder for each task, trained on its inputs after the task, which belongs to an adapter.
    The adapter of the autoencoder with the smallest reconstruction error acts, in each layer and for each sample by
    itself; no task number is needed.

    Before a new task, its samples pass through the policy as it is. A layer gets a new adapter if the mean z-score of
    the errors, |e - mean| / std, exceeds `threshold` for all of its autoencoders; otherwise the task uses the adapter
    of the one with the smallest mean error. If no layer is new, the first one gets an adapter. Only new adapters learn,
    and only while their task is learned: the base and earlier adapters never change.

    Departures:

    * The paper adapts feed-forward networks of a pretrained transformer. Here `adapted` says which, and may name
      other linear layers and convolutions; of a convolution's input, a sample is the mean over the image.
    * Inputs of the base's own task have autoencoders as well, which choose the base without an adapter. A pretrained
      base (`base_tasks=0`) has none, as in the paper. Of several tasks that the base learns one after the other, those
      of all but the last are of a base that then went on learning.
    * Mean and standard deviation of the errors are those of the samples after training, not running averages.
    * The autoencoders learn from up to 512 samples of a layer, collected from `windows` windows.
    """

    relu = True
    state_form = {
        **RoutedExperts.state_form,
        "discriminators": {int: {str: Discriminator.form}},
        "chosen": {int: {str: int}},
    }

    def __init__(
        self,
        *,
        rank: Width = 16,
        alpha: NonNegative = 16.0,
        adapted: Sequence[str] = ("*",),
        threshold: NonNegative = 2.5,
        hidden: Width = 16,
        discriminator_steps: Natural = 200,
        discriminator_lr: Positive = 5e-3,
        windows: Count = 500,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            rank: Rank of an adapter.
            alpha: Numerator of the adapters' scale alpha / rank.
            adapted: Patterns of names of feed-forward networks, and of linear layers and convolutions outside of them,
                e.g. `transformer.layers.*.mlp`, `head.*`.
            threshold: Mean z-score from which a layer's inputs count as new.
            hidden: Number of hidden units of an autoencoder.
            discriminator_steps: Number of steps that autoencoders are trained for, after the task.
            discriminator_lr: Learning rate of the autoencoders.
            windows: Number of a task's windows that are looked at before and after it is learned.
            base_tasks: Number of tasks (stages, where tasks are learned together) that train the whole policy, which
                is frozen afterwards; 0 for a pretrained policy.
        """
        super().__init__(rank=rank, alpha=alpha, adapted=adapted, base_tasks=base_tasks)
        self.threshold, self.hidden, self.windows = threshold, hidden, windows
        self.discriminator_steps, self.discriminator_lr = discriminator_steps, discriminator_lr
        self.discriminators: dict[int, dict[str, Discriminator]] = {}  # task -> layer -> autoencoder
        self.chosen: dict[int, dict[str, int]] = {}  # task -> layer -> task whose adapter it uses, or BASE

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Decide which layers get adapters; none while the base is learned."""
        modules = adaptable_modules(policy, self.adapted)
        draws = self._begin(task_index, policy)
        if draws is None:
            self.chosen[task_index] = dict.fromkeys(modules, BASE)
            return
        uses = dict.fromkeys(modules, task_index)
        if self.discriminators:
            compared = self.compare(self._collect(dataset, policy, draws))
            uses = {name: compared[name] for name in modules}
        if task_index not in uses.values():
            uses[next(iter(uses))] = task_index
        self.chosen[task_index] = uses
        new = {name: matrix_of(modules[name]) for name, used in uses.items() if used == task_index}
        self.library.add(task_index, new, self.rank, draws)

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Train the task's autoencoders on the inputs that the layers have with its adapters."""
        samples = self._collect(dataset, policy, generator, task_index)
        settings = self.hidden, self.discriminator_steps, self.discriminator_lr
        self.discriminators[task_index] = {
            name: Discriminator.fit(x, *settings, generator) for name, x in samples.items()
        }
        self._draw_seed(generator)

    def _acting(self) -> int | None:
        """Return the present task while it is learned, as it has no autoencoders yet; then each sample chooses."""
        unfinished = self.task_index in self.library and self.task_index not in self.discriminators
        return self.task_index if unfinished else None

    def route(self, name: str, samples: Tensor) -> Tensor:
        """Return the task whose adapter acts on each sample (n, tokens, D) of an input, (n,) int64 on the CPU."""
        known = [(t, of[name]) for t, of in self.discriminators.items()]
        uses = torch.tensor([self.chosen[t][name] for t, _ in known])
        return uses[torch.stack([d.errors(samples) for _, d in known]).argmin(0).cpu()]

    def compare(self, samples: Samples) -> dict[str, int]:
        """Return for each layer the task whose adapter the present task uses: its own where the samples are new."""
        uses = {}
        for name, x in samples.items():
            known = {t: of[name] for t, of in self.discriminators.items()}
            new = all(d.z_scores(x).mean() > self.threshold for d in known.values())
            nearest = min(known, key=lambda t: float(known[t].errors(x).mean()))
            uses[name] = self.task_index if new else self.chosen[nearest][name]
        return uses

    def _hooks(self, policy: Policy) -> tuple[Mapping[str, nn.Module], Add]:
        """Return the layers with adapters, and what is added to their outputs."""
        return adaptable_modules(policy, self.adapted), self._added

    def _added(self, name: str, layer: nn.Module, x: Tensor) -> Tensor | None:
        """Return the adapters' outputs, each on its rows; None where all rows use the base alone."""
        if self._learning is not None:
            groups: list[tuple[int, Tensor | None]] = [(self.chosen[self._learning][name], None)]
        else:
            groups = groups_of_rows(self.route(name, _samples(layer, x)))
        return self._grouped_output(name, layer, x, groups)

    @torch.no_grad()
    def _collect(
        self, dataset: TaskWindows, policy: Policy, draws: torch.Generator, task: int | None = None
    ) -> Samples:
        """Return inputs of the layers on some of a task's windows, with its adapters or, without it, chosen ones."""
        inputs: dict[str, list[Tensor]] = {}
        device = device_of(policy)
        chosen = torch.randperm(len(dataset), generator=draws)[: self.windows]

        def added(name: str, layer: nn.Module, x: Tensor) -> Tensor | None:
            inputs.setdefault(name, []).append(_samples(layer, x)[: max(1, _ROWS * _CHUNK // len(chosen))])
            return self._added(name, layer, x)

        layers = adaptable_modules(policy, self.adapted)
        with in_mode(policy, training=False), self._using(task, policy, layers, added):
            for part in chosen.split(_CHUNK):
                policy.predict(dataset.batch(part).to(device))
        return {name: torch.cat(parts) for name, parts in inputs.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return all adapters and autoencoders, and which belong together."""
        known = {task: {n: d.weights for n, d in of.items()} for task, of in self.discriminators.items()}
        return {**super().state_dict(), "discriminators": known}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: Adapters, autoencoders and what connects them do not go together.
        """
        library, chosen, known = state["library"], state["chosen"], state["discriminators"]
        used = [(task, name) for of in chosen.values() for name, task in of.items() if task != BASE]
        fits = all(name in library.get(task, {}) for task, name in used)
        if not fits or any(of.keys() != chosen.get(task, {}).keys() for task, of in known.items()):
            raise CheckpointError("the adapters and their autoencoders do not go together")
        super().load_state_dict(state, datasets)
        self.discriminators = {t: {n: Discriminator(w) for n, w in of.items()} for t, of in known.items()}


def _samples(layer: nn.Module, x: Tensor) -> Tensor:
    """Return a layer's input as samples of tokens, (n, tokens, D): of an image the mean, of a vector one token."""
    if isinstance(layer, nn.Conv2d):
        return x.detach().mean((2, 3))[:, None]
    return x.detach().reshape(len(x), -1, x.shape[-1])
