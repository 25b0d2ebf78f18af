"""A growing library of low-rank experts and a router that mixes them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from types import MethodType
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.hooks import RemovableHandle

from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import JoinedWindows, TaskWindows, WindowDataset, WindowSubset
from lifelong.errors import CheckpointError, ConfigError
from lifelong.nn.adapters import freeze_statistics, initial_pair
from lifelong.nn.experts import Router, expert_output, expert_shape, routed_layers
from lifelong.nn.tokens import standardise
from lifelong.policies.base import Policy
from lifelong.types import Batch, Count, Natural, NonNegative, Observation, Width

_QUERY = "routing_query"  # key among the readings of a batch; policies read only those of their spec
_FREE = 0.002  # [nat] divergence that replay tolerates: coefficients that are off by 0.03
_CHUNK = 8  # windows per computation of queries


class DMPEL(Algorithm):
    """Add a few low-rank experts with each task, and let a router mix all experts (Lei et al. 2025).

    "Dynamic mixture of progressive parameter-efficient expert library for lifelong robot learning",
    arXiv:2506.05985: layers compute `W x + (alpha / rank) sum_i c_i B_i A_i x` with W frozen; the coefficients c come
    from a router that takes the context (instruction, images, proprioception), not the task's number, and are a
    softmax over the best `top_k`; layers form groups with coefficients of their own. Only the newest experts and
    the router learn. The router is kept from forgetting by replay: of its inputs on earlier tasks and the coefficients
    that it returned then, which are far smaller than demonstrations.

    Departures:

    * c is fixed for an episode and computed from its first frame. A policy keeps features of earlier frames while it
      acts, which other coefficients would contradict; so windows in training and single steps compute the same. A
      window belongs to the first frame of its demonstration.
    * The paper's router takes features of a frozen CLIP; this one the image in `pool` by `pool` pixels.
    * Choice 0 is the base alone, without an expert: the task that the base was learned with needs none.
    * Replay is a penalty while a task is learned, not a stage after it: the divergence of the coefficients, over all
      choices, from the stored ones, above a small tolerance. Squared errors would not move a router with saturated
      outputs; and without the tolerance the optimiser, which follows gradients' signs rather than sizes, would push
      new choices away from old contexts, and with these from all, before they have learned anything.
    * Linear layers and convolutions have experts. An LSTM stays as in the base; its inputs and outputs pass through
      layers with experts.
    """

    state_form = {
        **dict.fromkeys(("task_index", "base_left", "seed"), int),
        "library": {int: {str: {"a": Tensor, "b": Tensor}}},
        "router": ({}, {"enter": Tensor, "keys": Tensor, "bias": Tensor}),
        "memory": {int: {"queries": Tensor, "coefficients": Tensor}},
        "episodes": ({}, {"queries": Tensor, "of_window": Tensor}),
    }

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
        replay: NonNegative = 10.0,
        replay_size: Count = 50,
        base_tasks: Natural = 1,
    ):
        """Create the algorithm.

        Args:
            rank: Rank of an expert.
            alpha: Numerator of the experts' scale alpha / rank.
            experts: Number of experts added for each task.
            top_k: Number of choices that share the weight; 0: all.
            adapted: Patterns of names of the weights whose layers get experts, e.g. `transformer.*`, `head.*`.
            hidden: Number of hidden units of the router.
            pool: Side, in pixels, to which images are reduced for the router.
            replay: Weight of the divergence from stored coefficients.
            replay_size: Number of contexts stored of each task.
            base_tasks: Number of tasks that train the whole policy, which is frozen afterwards; 0 for a pretrained
                policy.

        Raises:
            ConfigError: A number below its smallest valid value.
        """
        positive = {"rank": rank, "experts": experts, "pool": pool, "replay_size": replay_size}
        for name, value in positive.items():
            if value < 1:
                raise ConfigError(f"algo.{name} is {value}; it must be at least 1")
        self.rank, self.scale, self.experts, self.top_k = rank, alpha / rank, experts, top_k
        self.adapted, self.hidden, self.pool = tuple(adapted), hidden, pool
        self.replay, self.replay_size = replay, replay_size
        self.task_index, self._base_left, self._seed = -1, base_tasks, 0
        # task -> layer -> a (e r, in), b (out, e r)
        self._library: dict[int, dict[str, dict[str, Tensor]]] = {}
        self._router: Router | None = None
        self._memory: dict[int, dict[str, Tensor]] = {}  # task -> queries (n, Q), coefficients (n, G, N then)
        self._episodes: dict[str, Tensor] = {}  # of the present task: queries (D, Q), of_window (W,)
        self._now: Tensor | None = None  # (B, G, N), coefficients of the present forward pass
        self._held: Tensor | None = None  # (B, G, N), coefficients of the present episodes
        self._handles: list[RemovableHandle] = []

    # --- hooks

    def begin_task(self, task_index: int, dataset: TaskWindows, policy: Policy) -> None:
        """Store the episodes' contexts; after the base, add experts and choices of the router."""
        self.task_index, layers = task_index, routed_layers(policy, self.adapted)
        queries, of_window = self._contexts(dataset)
        self._episodes = {"queries": queries.to(next(policy.parameters()).device), "of_window": of_window}
        if self._base_left:
            self._base_left -= 1
            return
        policy.zero_grad()
        draws = torch.Generator().manual_seed(self._seed)
        queries = self._episodes["queries"]
        if self._router is None:
            self._router = self._build_router(len(_groups(layers)), queries, draws)
        earlier = [m["queries"] for m in self._memory.values()]
        self._router.grow(self.experts, queries, torch.cat([queries[:0], *earlier]))
        self._library[task_index] = {n: self._build_experts(layer, draws) for n, layer in layers.items()}

    def trained(self, policy: Policy) -> list[nn.Parameter]:
        """Return the router's and the task's experts' parameters; everything while the base is learned."""
        if self._router is None or self.task_index not in self._library:
            return super().trained(policy)
        policy.requires_grad_(False)
        self._attach(policy)
        pairs: Any = self._library[self.task_index].values()
        return [*self._router.parameters(), *(p for pair in pairs for p in pair.values())]

    def mode_train(self, policy: Policy) -> None:
        """Set training mode, with running statistics frozen with the base."""
        policy.train()
        if self._library:
            freeze_statistics(policy)

    def mix(self, batch: Batch, generator: torch.Generator) -> Batch:
        """Return the batch with the query of its episode in each window."""
        if self._router is None:
            return batch
        known, device = batch.task_ids == self.task_index, batch.actions.device
        queries = batch.actions.new_empty(len(batch), self._router.enter.shape[1])
        of_window, contexts = self._episodes["of_window"], self._episodes["queries"].to(device)
        queries[known] = contexts[of_window.to(device)[batch.window_ids[known]]]
        if not known.all():
            queries[~known] = self.query(batch.observation)[~known]
        proprio = {**batch.observation.proprio, _QUERY: queries[:, None]}
        return replace(batch, observation=replace(batch.observation, proprio=proprio))

    def penalty(self, policy: Policy) -> Tensor | None:
        """Return `replay * max(0, KL(c_then | c) - _FREE)`, mean over earlier tasks' contexts; None without any."""
        if self._router is None or not self._memory:
            return None
        logits = self._router.logits(torch.cat([m["queries"] for m in self._memory.values()]))
        then = torch.cat([_padded(m["coefficients"], logits) for m in self._memory.values()])
        divergence = functional.kl_div(logits.log_softmax(-1), then, reduction="none").sum(-1)
        return self.replay * functional.relu(divergence - _FREE).mean()

    def end_phase(self, phase: Any, policy: Policy) -> None:
        """Remove the experts from the policy's layers."""
        self._detach(policy)

    @torch.no_grad()
    def end_task(
        self, task_index: int, dataset: TaskWindows, policy: Policy, generator: torch.Generator
    ) -> None:
        """Store some of the task's contexts, with the router's coefficients for them."""
        queries = self._episodes["queries"]
        chosen = torch.randperm(len(queries), generator=generator)[: self.replay_size]
        queries = queries[chosen.to(queries.device)]
        if self._router is None:
            groups = len(_groups(routed_layers(policy, self.adapted)))
            coefficients = queries.new_ones(len(queries), groups, 1)
        else:
            coefficients = self._router(queries)
        self._memory[task_index] = {"queries": queries, "coefficients": coefficients}
        self._episodes = {}
        self._seed = int(torch.randint(2**62, (), generator=generator))

    @contextmanager
    def policy_for(self, task_index: int, policy: Policy) -> Iterator[Policy]:
        """Yield the policy with routed experts, the same for every task."""
        if self._router is None:
            yield policy
            return
        attached = "encode" in policy.__dict__
        self._attach(policy)
        try:
            yield _Routed(policy, self)
        finally:
            self._now = None
            if not attached:
                self._detach(policy)

    # --- routing

    def query(self, observation: Observation) -> Tensor:
        """Return the context in the first frame of windows, (B, Q): instruction, images, proprioception."""
        images = observation.images[:, 0].flatten(0, 1).movedim(-1, 1).float()  # (B V, C, H, W)
        pictures = functional.adaptive_avg_pool2d(images, self.pool) / 64 - 2  # of order one
        pictures = pictures.reshape(len(observation.images), -1)
        readings = [observation.proprio[name][:, 0] for name in sorted(observation.proprio) if name != _QUERY]
        return torch.cat([standardise(observation.language), pictures, *readings], dim=1)

    def coefficients(self, observation: Observation) -> Tensor:
        """Return the coefficient of each choice in each group of layers, (B, G, N)."""
        assert self._router is not None
        given = observation.proprio.get(_QUERY)
        return self._router(self.query(observation) if given is None else given[:, 0])

    @contextmanager
    def holding(self, coefficients: Tensor) -> Iterator[None]:
        """Use the given coefficients within the context, whatever is observed."""
        self._held = coefficients
        try:
            yield
        finally:
            self._held = None

    def _attach(self, policy: Policy) -> None:
        """Let the policy's layers mix experts, with coefficients computed when it encodes an observation.

        A copy of the policy mixes them as well: functions and methods refer to the policy they are called on.
        """
        if "encode" in policy.__dict__:
            return
        encode = getattr(type(policy), "encode", None)
        if encode is None:
            raise ConfigError(
                f"{type(policy).__name__} has no encode(observation), which the router needs; use algo=lora"
            )

        def routed(self_: Policy, observation: Observation) -> Tensor:
            self._now = self.coefficients(observation) if self._held is None else self._held
            return encode(self_, observation)

        policy.__dict__["encode"] = MethodType(routed, policy)
        layers = routed_layers(policy, self.adapted)
        groups = _groups(layers)
        self._handles = [
            layer.register_forward_hook(self._hook(name, groups.index(name.partition(".")[0])))
            for name, layer in layers.items()
        ]

    def _detach(self, policy: Policy) -> None:
        for handle in self._handles:
            handle.remove()
        policy.__dict__.pop("encode", None)
        self._handles, self._now = [], None

    def _hook(self, name: str, group: int) -> Callable[[nn.Module, Any, Tensor], Tensor]:
        """Return a hook that adds the experts' output to a layer's output."""

        def add(layer: nn.Module, args: Any, output: Tensor) -> Tensor:
            if self._now is None:
                return output
            pairs = [of_task[name] for of_task in self._library.values()]
            rank = pairs[0]["a"].shape[0] // self.experts
            weights = self.scale * self._now[:, group, 1:].repeat_interleave(rank, dim=1)
            return output + expert_output(layer, args[0], pairs, weights)

        return add

    # --- experts and state

    @torch.no_grad()
    def _contexts(self, dataset: WindowDataset) -> tuple[Tensor, Tensor]:
        """Return the query of every demonstration, (D, Q), and to which of them each window belongs, (W,).

        A dataset that reads a file knows the last frame of each window's demonstration (`last`). Without it every
        window counts as a demonstration.
        """
        if isinstance(dataset, JoinedWindows):
            parts = [self._contexts(part) for part in dataset.datasets]
            offsets = torch.tensor([0] + [len(queries) for queries, _ in parts]).cumsum(0).tolist()
            moved = [of_window + offset for (_, of_window), offset in zip(parts, offsets, strict=False)]
            return torch.cat([queries for queries, _ in parts]), torch.cat(moved)
        if isinstance(dataset, WindowSubset):
            queries, of_window = self._contexts(dataset.dataset)
            return queries, of_window[dataset.chosen.to(of_window.device)]
        ends, of_window = getattr(dataset, "last", torch.arange(len(dataset))).unique(return_inverse=True)
        starts = torch.cat([ends.new_zeros(1), ends[:-1] + 1])
        found = [self.query(dataset.batch(indices).observation) for indices in starts.split(_CHUNK)]
        return torch.cat(found), of_window

    def _build_router(self, groups: int, queries: Tensor, draws: torch.Generator) -> Router:
        enter, _ = initial_pair(1, queries.shape[1], self.hidden, draws)
        keys, bias = torch.zeros(1, groups, self.hidden), torch.zeros(1, groups)
        return Router(enter=enter, keys=keys, bias=bias, top_k=self.top_k).to(queries.device)

    def _build_experts(self, layer: nn.Module, draws: torch.Generator) -> dict[str, Tensor]:
        out, inputs = expert_shape(layer)
        rank = min(self.rank, out, inputs)
        a, b = initial_pair(out, inputs, self.experts * rank, draws)
        device = next(layer.parameters()).device
        return {"a": nn.Parameter(a.to(device)), "b": nn.Parameter(b.to(device))}

    def sizes(self) -> dict[int, int]:
        """Return the number of parameters of each task's experts, without the router's."""
        tensors = {task: [t for p in of.values() for t in p.values()] for task, of in self._library.items()}
        return {task: sum(t.numel() for t in of_task) for task, of_task in tensors.items()}

    def state_dict(self) -> dict[str, Any]:
        """Return experts, router, stored contexts, and those of the present task's windows."""
        library = {
            task: {name: {k: t.detach() for k, t in pair.items()} for name, pair in of_task.items()}
            for task, of_task in self._library.items()
        }
        router = {} if self._router is None else {n: p.detach() for n, p in self._router.named_parameters()}
        place = {"task_index": self.task_index, "base_left": self._base_left, "seed": self._seed}
        kept = {"memory": _copied(self._memory), "episodes": dict(self._episodes)}
        return {**place, "library": library, "router": router, **kept}

    def load_state_dict(self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows]) -> None:
        """Restore what `state_dict` returned.

        Raises:
            CheckpointError: The shapes of the router, the experts or the stored contexts do not go together.
        """
        _check_shapes(state)
        self.task_index, self._base_left = int(state["task_index"]), int(state["base_left"])
        self._seed = int(state["seed"])
        self._memory, self._episodes = _copied(state["memory"]), dict(state["episodes"])
        self._router = Router(**state["router"], top_k=self.top_k) if state["router"] else None
        self._library = {
            task: {name: {k: nn.Parameter(t) for k, t in pair.items()} for name, pair in of_task.items()}
            for task, of_task in state["library"].items()
        }


def _check_shapes(state: Mapping[str, Any]) -> None:
    """Raise CheckpointError where parts of a state do not go together."""
    library, router = list(state["library"].values()), state["router"]
    pairs = [pair for of_task in library for pair in of_task.values()]
    fits = all(p["a"].dim() == p["b"].dim() == 2 and len(p["a"]) == p["b"].shape[1] for p in pairs)
    fits &= all(of_task.keys() == library[0].keys() for of_task in library)
    kept = state["memory"].values()
    fits &= all(m["queries"].dim() == 2 and m["coefficients"].dim() == 3 for m in kept)
    fits &= all(len(m["queries"]) == len(m["coefficients"]) for m in kept)
    if router:
        enter, keys, bias = router["enter"], router["keys"], router["bias"]
        fits &= enter.dim() == 2 and keys.dim() == 3 and keys.shape[:2] == bias.shape
        fits = fits and keys.shape[2] == len(enter)
        fits = fits and all(m["queries"].shape[1] == enter.shape[1] for m in kept)
    if not fits or (library and not router):
        raise CheckpointError("the router, the experts and the stored contexts do not go together")


class _Routed(Policy):
    """Policy whose experts are routed once, at the first step of each episode."""

    def __init__(self, inner: Policy, algorithm: DMPEL) -> None:
        super().__init__(inner.spec)
        self.inner, self._algorithm = inner, algorithm
        self._coefficients: Tensor | None = None
        self.training = inner.training

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
        if self._coefficients is None:
            self._coefficients = self._algorithm.coefficients(observation)
        with self._algorithm.holding(self._coefficients):
            return self.inner._act(observation, generators)


def _groups(layers: Mapping[str, nn.Module]) -> list[str]:
    """Return the groups: layers below the same attribute of the policy (`encoders`, `transformer`, `head`)."""
    return sorted({name.partition(".")[0] for name in layers})


def _padded(coefficients: Tensor, like: Tensor) -> Tensor:
    """Pad coefficients (n, G, N then) with zeros for the choices that came later."""
    return functional.pad(coefficients, (0, like.shape[-1] - coefficients.shape[-1]))


def _copied(tables: Mapping[int, Mapping[str, Tensor]]) -> dict[int, dict[str, Tensor]]:
    return {task: dict(table) for task, table in tables.items()}
