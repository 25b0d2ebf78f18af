"""Low-rank experts on the layers of a network: their parameters, their output, and how a policy gets them.

Shape legend: B batch, r rank.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from types import MethodType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.hooks import RemovableHandle

from lifelong.errors import CheckpointError, ConfigError, PolicyError

Pair = Mapping[str, Tensor]  # a (r, inputs), b (out, r)
Add = Callable[[str, nn.Module, Tensor], Tensor | None]  # name of a layer, layer, its input -> what is added
Encode = Callable[[nn.Module, Callable[..., Tensor], Any], Tensor]  # policy, its own encode, observation

_WITH_STATISTICS = (nn.modules.batchnorm._BatchNorm, nn.modules.instancenorm._InstanceNorm)
_MARK = "_has_experts"  # attribute of a policy with experts; copies of it have them too


class ExpertLibrary(dict[int, dict[str, dict[str, nn.Parameter]]]):
    """Task -> name of the layer or weight -> a low-rank pair `a` (r, inputs) and `b` (out, r), both trainable.

    Attributes:
        form: Form of the state, see `lifelong.checkpoints.check`.
    """

    form: ClassVar[Any] = {int: {str: {"a": Tensor, "b": Tensor}}}

    def add(
        self,
        task: int,
        weights: Mapping[str, Tensor],
        rank: int,
        draws: torch.Generator,
        *,
        count: int = 1,
        start: int | None = None,
    ) -> None:
        """Add a pair for each weight, whose product is zero at first.

        Args:
            task: Task that learns them.
            weights: Name -> weight (out, ...), flattened to a matrix.
            rank: Largest rank; a weight's smaller side where that is less.
            draws: CPU generator.
            count: Number of experts in a pair, one below the other.
            start: Task whose pairs are copied instead; None, or a task without any: none.
        """
        if start in self:
            copied = self[start].items()  # type: ignore[index]
            self[task] = {
                n: {k: nn.Parameter(p.detach().clone()) for k, p in pair.items()} for n, pair in copied
            }
            return
        self[task] = {}
        for name, weight in weights.items():
            out, inputs = weight.flatten(1).shape
            ranks = count * min(rank, out, inputs)
            a = (
                torch.rand(ranks, inputs, generator=draws) * 2 - 1
            ) / inputs**0.5  # as a linear layer of PyTorch
            b = torch.zeros(out, ranks)  # so that B A is zero at first (Hu et al. 2022, section 4.1)
            self[task][name] = {k: nn.Parameter(t.to(weight.device)) for k, t in (("a", a), ("b", b))}

    def parameters(self, task: int) -> list[nn.Parameter]:
        """Return a task's A and B."""
        return [p for pair in self[task].values() for p in pair.values()]

    def state_dict(self) -> dict[int, dict[str, dict[str, Tensor]]]:
        """Return all pairs as tensors."""
        return {
            task: {name: {k: p.detach() for k, p in pair.items()} for name, pair in of_task.items()}
            for task, of_task in self.items()
        }

    def load_state_dict(self, state: Mapping[int, Mapping[str, Pair]], datasets: object = None) -> None:
        """Restore what `state_dict` returned; no windows are needed.

        Raises:
            CheckpointError: A and B of a pair have no common rank.
        """
        for name, pair in ((n, pair) for of_task in state.values() for n, pair in of_task.items()):
            if not (pair["a"].dim() == pair["b"].dim() == 2 and len(pair["a"]) == pair["b"].shape[1]):
                raise CheckpointError(f"A and B of the experts of {name} do not go together")
        self.clear()
        for task, of_task in state.items():
            self[task] = {n: {k: nn.Parameter(t) for k, t in pair.items()} for n, pair in of_task.items()}


class Attachment:
    """Forward hooks on a policy's layers, and another `encode`, as long as they are attached.

    A copy of the policy made meanwhile has them too: they refer to the policy they are called on.
    """

    def __init__(self) -> None:
        self._handles: list[RemovableHandle] = []

    def attach(
        self, policy: nn.Module, layers: Mapping[str, nn.Module], add: Add, encode: Encode | None = None
    ) -> None:
        """Add something to the output of layers; do nothing where that is done already.

        Args:
            add: Function that returns what is added, given name, layer and input; None for nothing.
            encode: Function called in place of `policy.encode`.

        Raises:
            ConfigError: The policy has no `encode`.
        """
        if is_attached(policy):
            return
        if encode is not None:
            own = getattr(type(policy), "encode", None)
            if own is None:
                raise ConfigError(
                    f"{type(policy).__name__} has no encode(observation), by which experts are chosen; use algo=lora"
                )
            policy.__dict__["encode"] = MethodType(
                lambda self_, seen: encode(self_, MethodType(own, self_), seen), policy
            )
        policy.__dict__[_MARK] = True
        self._handles = [layer.register_forward_hook(_hook(name, add)) for name, layer in layers.items()]

    def detach(self, policy: nn.Module) -> None:
        """Remove what was attached."""
        for handle in self._handles:
            handle.remove()
        self._handles = []
        policy.__dict__.pop("encode", None)
        policy.__dict__.pop(_MARK, None)

    @contextmanager
    def within(
        self, policy: nn.Module, layers: Mapping[str, nn.Module], add: Add, encode: Encode | None = None
    ) -> Iterator[None]:
        """Attach within the context; what was attached before it stays."""
        before = is_attached(policy)
        self.attach(policy, layers, add, encode)
        try:
            yield
        finally:
            if not before:
                self.detach(policy)


def is_attached(policy: nn.Module) -> bool:
    """Return whether a policy's layers have experts at present."""
    return _MARK in policy.__dict__


def _hook(name: str, add: Add) -> Callable[[nn.Module, Any, Tensor], Tensor]:
    def hook(layer: nn.Module, args: Any, output: Tensor) -> Tensor:
        added = add(name, layer, args[0])
        return output if added is None else output + added

    return hook


def adapted_layers(policy: nn.Module, patterns: Sequence[str]) -> dict[str, nn.Module]:
    """Return the linear layers and convolutions whose weight's name matches one of the patterns, by name.

    Raises:
        ConfigError: There is none.
    """
    layers = {
        name: module
        for name, module in policy.named_modules()
        if isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and module.groups == 1)
    }
    weights = matching([f"{name}.weight" for name in layers], patterns, "linear layer or convolution")
    return {name: layer for name, layer in layers.items() if f"{name}.weight" in weights}


def adaptable_modules(policy: nn.Module, patterns: Sequence[str]) -> dict[str, nn.Module]:
    """Return the modules whose name matches one of the patterns: feed-forward networks, and layers outside of them.

    A feed-forward network is a sequence of modules with linear layers and no convolution.

    Raises:
        ConfigError: There is none.
    """
    modules: dict[str, nn.Module] = {}
    for name, module in policy.named_modules():
        inside = any(name.startswith(f"{other}.") for other in modules)
        conv = isinstance(module, nn.Conv2d) and module.groups == 1
        if not inside and (isinstance(module, nn.Linear) or conv or _is_feed_forward(module)):
            modules[name] = module
    kinds = "feed-forward network, linear layer or convolution"
    return {name: modules[name] for name in matching(list(modules), patterns, kinds)}


def _is_feed_forward(module: nn.Module) -> bool:
    kinds = [type(part) for part in module] if isinstance(module, nn.Sequential) else []
    return nn.Linear in kinds and nn.Conv2d not in kinds


def matrix_of(module: nn.Module) -> Tensor:
    """Return a layer's weight; of a feed-forward network an empty tensor (out, inputs) in its place."""
    if not isinstance(module, nn.Sequential):
        return module.weight  # type: ignore[return-value]
    linear = [part for part in module if isinstance(part, nn.Linear)]
    weight = linear[0].weight
    return weight.new_zeros(()).expand(linear[-1].out_features, linear[0].in_features)


def weights_of(layers: Mapping[str, nn.Module]) -> dict[str, Tensor]:
    """Return the weight of each layer."""
    return {name: layer.weight for name, layer in layers.items()}  # type: ignore[misc]


def expert_output(
    layer: nn.Module, x: Tensor, pairs: Iterable[Pair], weights: Tensor | None = None, *, relu: bool = False
) -> Tensor:
    """Return what experts add to a layer's output, `sum_i c_i B_i A_i x`, another mixture for each row.

    Args:
        layer: Linear layer, convolution, or feed-forward network.
        x: Input of the layer; the first axis has B rows, or a multiple with the rows of one sample adjacent.
        pairs: Pairs of experts, of r ranks together.
        weights: Coefficients c, each repeated by its expert's rank, (B, r); None: all 1.
        relu: Whether a ReLU lies between A and B.

    Raises:
        PolicyError: The first axis is no multiple of B.
    """
    a, b = (
        torch.cat(parts, dim=dim)
        for dim, parts in enumerate(zip(*((p["a"], p["b"]) for p in pairs), strict=True))
    )
    if isinstance(layer, nn.Conv2d):
        kernel = a.view(len(a), *layer.weight.shape[1:])
        h = functional.conv2d(x, kernel, None, layer.stride, layer.padding, layer.dilation)
    else:
        h = functional.linear(x, a)
    if relu:
        h = functional.relu(h)
    if weights is not None:
        rows = weights.repeat_interleave(rows_per_sample(x, len(weights)), dim=0)
        axis = 1 if isinstance(layer, nn.Conv2d) else h.dim() - 1
        shape = [len(rows) if i == 0 else len(a) if i == axis else 1 for i in range(h.dim())]
        h = h * rows.view(shape).to(h.dtype)
    return (
        functional.conv2d(h, b[:, :, None, None]) if isinstance(layer, nn.Conv2d) else functional.linear(h, b)
    )


def rows_per_sample(x: Tensor, samples: int) -> int:
    """Return how many rows of a layer's input belong to each of B samples.

    Raises:
        PolicyError: The first axis is no multiple of B.
    """
    if len(x) % samples:
        raise PolicyError(
            f"a layer has {len(x)} rows for {samples} samples: rows cannot be assigned to samples"
        )
    return len(x) // samples


def matches(name: str, patterns: Sequence[str]) -> bool:
    """Return whether one of the patterns (`*`, `?`, `[...]`) matches the whole name."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def matching(
    names: Sequence[str], patterns: Sequence[str], kind: str, key: str = "algo.adapted"
) -> list[str]:
    """Return the names that match one of the patterns, which are those of a key.

    Raises:
        ConfigError: One of the patterns matches none; the message lists some of the names that exist.
    """
    idle = [p for p in patterns if not any(fnmatchcase(name, p) for name in names)]
    if idle or not patterns:
        some = ", ".join(list(names)[:5])
        raise ConfigError(f"{key}={idle} matches no {kind} of the policy, which has {some}, ...")
    return [name for name in names if matches(name, patterns)]


def freeze_statistics(policy: nn.Module) -> None:
    """Put layers with running statistics in evaluation mode, so that training does not change these."""
    for module in policy.modules():
        if isinstance(module, _WITH_STATISTICS):
            module.eval()
