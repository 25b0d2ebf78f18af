"""A growing library of low-rank experts and a router that mixes them."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.algorithms.frozen_base import RoutedExperts
from lifelong.data.windows import TaskWindows, of_episodes
from lifelong.errors import CheckpointError, ConfigError
from lifelong.nn.experts import adapted_layers, expert_output, weights_of
from lifelong.nn.routing import SigmoidRouter
from lifelong.nn.tokens import standardise
from lifelong.policies.base import Policy, device_of
from lifelong.types import Batch, Count, Natural, NonNegative, Observation, Positive, Width

_QUERY = "routing_query"  # key among the readings of a batch; policies read only those of their spec
_ROUTER = {"enter": Tensor, "middle": Tensor, "leave": Tensor, "bias": Tensor}


class DMPEL(RoutedExperts):
    """Add a few low-rank experts with each task, and let a router mix all experts (Lei et al. 2025).

    "Dynamic mixture of progressive parameter-efficient expert library for lifelong robot learning",
    arXiv:2506.05985: layers compute `W x + (alpha / rank) sum_i c_i B_i A_i x` with W frozen; the coefficients c come
    from a router that takes the context (instruction, images, proprioception), not the task's number; layers form
    groups with coefficients of their own. As in the authors' code, c_i is `2 sigmoid` of expert i's own logit, of which
    the best `top_k` count; every task starts with a new router at c = 1 / min(`top_k`, experts), which is learned
    with the newest experts; and after the task it learns to recall, by squared error, the coefficients that earlier
    tasks ended with on stored contexts, which are far smaller than demonstrations. Where experts compete in a softmax
    instead, the first steps of a task can take all weight from the newest one, which then never learns.

    Departures:

    * c is fixed for an episode and computed from its first frame. A policy keeps features of earlier frames while it
      acts, which other coefficients would contradict; so windows in training and single steps compute the same. A
      window belongs to the first frame of its demonstration.
    * The paper's router takes features of a frozen CLIP; this one the image in `pool` by `pool` pixels, and the whole
      context at length one (see `SigmoidRouter`).
    * The task that the base was learned with needs no expert: its contexts recall zeros.
    * While a task is learned, its own experts are always among the best `top_k`: from the fourth task with an expert
      on, the chance of the router's first weights would otherwise leave them out of some groups of layers, where they
      would never learn.
    * Recall takes all coefficients and all stored contexts at every step, not the best in batches. There is no dropout
      of coefficients, and A is initialised as in LoRA, not orthogonally to earlier experts.
    * Linear layers and convolutions have experts. An LSTM stays as in the base; its inputs and outputs pass through
      layers with experts.
    """

    state_form = {
        **RoutedExperts.state_form,
        "router": (None, _ROUTER),
        "memory": {int: {"queries": Tensor, "coefficients": Tensor}},
        "episodes": ({}, {"queries": Tensor, "of_window": Tensor}),
    }

    needs_demonstrations = True  # to whose contexts windows belong

    def __init__(
        self,
        *,
        rank: Width = 16,
        alpha: NonNegative = 32.0,
        experts: Width = 1,
        top_k: Natural = 3,
        adapted: Sequence[str] = ("*",),
        hidden: Width = 64,
        pool: Width = 4,
        recall_steps: Natural = 1000,
        recall_lr: Positive = 1e-3,
        replay_size: Count = 50,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            rank: Rank of an expert.
            alpha: Numerator of the experts' scale alpha / rank.
            experts: Number of experts added for each task.
            top_k: Number of experts that act; 0: all.
            adapted: Patterns of names of the weights whose layers get experts, e.g. `transformer.*`, `head.*`.
            hidden: Number of units of the router's hidden layers.
            pool: Side, in pixels, to which images are reduced for the router.
            recall_steps: Number of steps of the recall after each task.
            recall_lr: Learning rate of the recall.
            replay_size: Number of contexts stored of each task, at most as many as it has demonstrations; one with
                more windows in the task is chosen with higher probability.
            base_tasks: Number of tasks that train the whole policy, which is frozen afterwards; 0 for a pretrained
                policy.
        """
        if 0 < top_k < experts:
            raise ConfigError(
                f"algo.top_k={top_k} experts cannot act while the {experts} of a task (algo.experts) are learned "
                "together; use 0, all, or at least as many"
            )
        super().__init__(rank=rank, alpha=alpha, adapted=adapted, base_tasks=base_tasks)
        self.experts, self.top_k, self.hidden, self.pool = experts, top_k, hidden, pool
        self.recall_steps, self.recall_lr, self.replay_size = recall_steps, recall_lr, replay_size
        self.router: SigmoidRouter | None = None
        self.memory: dict[int, dict[str, Tensor]] = {}  # task -> queries (n, Q), coefficients (n, G, N then)
        self.episodes: dict[str, Tensor] = {}  # of the present task: queries (D, Q), of_window (W,)
        self._held: Tensor | None = None  # (B, G, N), coefficients of the present episodes

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Store the episodes' contexts; after the base, add experts and build a new router."""
        layers = adapted_layers(policy, self.adapted)
        queries, of_window = of_episodes(dataset, lambda batch: self.query(batch.observation))
        queries, of_window = (x.to(device_of(policy)) for x in (queries, of_window))
        self.episodes = {"queries": queries, "of_window": of_window}
        draws = self._begin(task_index, policy)
        if draws is None:
            return
        self.library.add(task_index, weights_of(layers), self.rank, draws, count=self.experts)
        count, groups = self.experts * len(self.library), len(_groups(layers))
        router = SigmoidRouter.new(queries.shape[1], self.hidden, groups, count, self.top_k, draws)
        self.router = router.to(queries.device)

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the router's and the task's experts' parameters; everything while the base is learned."""
        learned = super().trained(policy)
        return learned if self.router is None else [*self.router.parameters(), *learned]

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch with the query of its episode in each window."""
        if self.router is None:
            return batch
        queries, of_window = (self.episodes[k].to(batch.actions.device) for k in ("queries", "of_window"))
        queries = queries[of_window[batch.window_ids]]
        proprio = {**batch.observation.proprio, _QUERY: queries[:, None]}
        return replace(batch, observation=replace(batch.observation, proprio=proprio))

    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store some of the task's contexts with their coefficients, and let the router recall all stored ones."""
        queries, of_window = self.episodes["queries"], self.episodes["of_window"].sort().values
        count = min(self.replay_size, len(of_window.unique()))
        start = torch.randint(len(of_window), (1,), generator=generator)
        places = (torch.arange(count) * len(of_window) + start) // count  # windows at equal distances
        queries = queries[of_window[places.to(of_window.device)]]
        if self.router is None:
            groups = len(_groups(adapted_layers(policy, self.adapted)))
            coefficients = queries.new_zeros(len(queries), groups, 0)
        else:
            coefficients = self.router(queries, self.experts).detach()
        self.memory[task_index] = {"queries": queries, "coefficients": coefficients}
        self._recall()
        self.episodes = {}
        self._draw_seed(generator)

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with routed experts, the same for every task."""
        if self.router is None:
            yield policy
            return
        with self._using(None, policy, *self._hooks(policy)):
            yield _Routed(policy, self)

    def query(self, observation: Observation) -> Tensor:
        """Return the context in the first frame of windows, (B, Q): instruction, images, proprioception."""
        images = observation.images[:, 0].flatten(0, 1).movedim(-1, 1).float()  # (B V, C, H, W)
        pictures = functional.adaptive_avg_pool2d(images, self.pool) / 64 - 2  # of order one
        pictures = pictures.reshape(len(observation.images), -1)
        readings = [observation.proprio[name][:, 0] for name in sorted(observation.proprio) if name != _QUERY]
        return torch.cat([standardise(observation.language), pictures, *readings], dim=1)

    def coefficients(self, observation: Observation) -> Tensor:
        """Return the coefficient of each expert in each group of layers, (B, G, N)."""
        assert self.router is not None
        given = observation.proprio.get(_QUERY)
        learning = self.experts if self.episodes else 0
        return self.router(self.query(observation) if given is None else given[:, 0], learning)

    @contextmanager
    def holding(self, coefficients: Tensor) -> Iterator[None]:
        """Use the given coefficients within the context, whatever is observed."""
        self._held = coefficients
        try:
            yield
        finally:
            self._held = None

    def _recall(self) -> None:
        """Let the router give the stored coefficients again, and zeros for experts that came later."""
        if self.router is None:
            return
        queries = torch.cat([m["queries"] for m in self.memory.values()])
        count = self.router.bias.shape[1]
        stored = [m["coefficients"] for m in self.memory.values()]
        then = torch.cat([functional.pad(c, (0, count - c.shape[-1])) for c in stored])
        optimizer = torch.optim.AdamW(self.router.parameters(), lr=self.recall_lr)
        for _ in range(self.recall_steps):
            optimizer.zero_grad()
            (self.router.coefficients(queries) - then).square().mean().backward()
            optimizer.step()
        optimizer.zero_grad()

    def _hooks(self, policy: Policy) -> tuple[Any, Any, Any]:
        """Return the layers with experts, what is added to their outputs, and the routed `encode`."""
        layers = adapted_layers(policy, self.adapted)
        groups = {name: _groups(layers).index(name.partition(".")[0]) for name in layers}

        def add(name: str, layer: nn.Module, x: Tensor) -> Tensor | None:
            if self._now is None:
                return None
            counting, coefficients = self._now[1][groups[name]]
            if not counting:
                return None
            pairs = [of_task[name] for of_task in self.library.values()]
            rank = pairs[0]["a"].shape[0] // self.experts
            weights = self.scale * coefficients.repeat_interleave(rank, dim=1)
            return expert_output(layer, x, [pairs[i] for i in counting], weights)

        def encode(policy: Any, own: Any, observation: Observation) -> Tensor:
            now = self.coefficients(observation) if self._held is None else self._held
            if self._now is None or now is not self._now[0]:  # the same during an episode
                of_tasks = now.unflatten(2, (-1, self.experts))  # (B, G, tasks, experts)
                # of each group, the tasks (by place in the library) whose experts count, and their coefficients
                counting = [
                    _counting(of_tasks[:, group], counts)
                    for group, counts in enumerate(of_tasks.detach().any(3).any(0).tolist())
                ]
                self._now = now, counting
            return own(observation)

        return layers, add, encode

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: The shapes of the router, the experts or the stored contexts do not go together.
        """
        router = SigmoidRouter(state["router"], top_k=self.top_k) if state["router"] else None
        _check_shapes(state, router)
        self.router = None
        super().load_state_dict(state, datasets)
        self.router = router


def _check_shapes(state: Mapping[str, Any], router: SigmoidRouter | None) -> None:
    """Raise CheckpointError where parts of a state do not go together."""
    library, kept = list(state["library"].values()), state["memory"].values()
    fits = all(of_task.keys() == library[0].keys() for of_task in library)
    fits &= all(m["queries"].dim() == 2 and m["coefficients"].dim() == 3 for m in kept)
    fits = fits and all(len(m["queries"]) == len(m["coefficients"]) for m in kept)
    if router is not None:
        queries, (groups, count) = router.enter.shape[1], router.bias.shape
        fits = fits and all(m["queries"].shape[1] == queries for m in kept)
        fits = fits and all(m["coefficients"].shape[1] == groups for m in kept)
        fits = fits and all(m["coefficients"].shape[2] <= count for m in kept)
    if not fits or (library and router is None):
        raise CheckpointError("the router, the experts and the stored contexts do not go together")


class _Routed(Policy):
    """Policy whose experts are routed once, at the first step of each episode."""

    def __init__(self, inner: Policy, algorithm: DMPEL) -> None:
        super().__init__(inner.spec)
        self.inner, self._algorithm = inner, algorithm
        self._coefficients: Tensor | None = None
        self.training = inner.training
        self.chunk, self.execute, self.inpaints = inner.chunk, inner.execute, inner.inpaints

    def __deepcopy__(self, memo: dict[int, Any]) -> "_Routed":
        return _Routed(copy.deepcopy(self.inner, memo), self._algorithm)  # which the layers' hooks refer to

    def window_losses(self, batch: Batch) -> Tensor:
        """Call the inner policy; windows without a query are routed by their own first frame."""
        return self.inner.window_losses(batch)

    def predict(self, batch: Batch) -> Tensor:
        """Call the inner policy; windows without a query are routed by their own first frame."""
        return self.inner.predict(batch)

    def reset(self, num_envs: int) -> None:
        """Reset the inner policy; the next step is routed again."""
        self._coefficients = None
        self.inner.reset(num_envs)

    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        with self._routed(observation):
            return self.inner._act(observation, generators)

    def _plan(self, observation: Observation, *asked: Any) -> Tensor:
        with self._routed(observation):
            return self.inner._plan(observation, *asked)

    def _routed(self, observation: Observation) -> AbstractContextManager[None]:
        if self._coefficients is None:
            self._coefficients = self._algorithm.coefficients(observation)
        return self._algorithm.holding(self._coefficients)


def _counting(of_tasks: Tensor, counts: Sequence[bool]) -> tuple[list[int], Tensor]:
    """Return the tasks that count, and their experts' coefficients of (B, tasks, experts) side by side."""
    tasks = [task for task, some in enumerate(counts) if some]
    chosen = torch.cat([of_tasks[:, task] for task in tasks], 1) if tasks else of_tasks[:, 0]
    return tasks, chosen


def _groups(layers: Mapping[str, nn.Module]) -> list[str]:
    """Return the groups: layers below the same attribute of the policy (`encoders`, `transformer`, `head`)."""
    return sorted({name.partition(".")[0] for name in layers})
