"""Low-rank experts on the layers of a network, mixed differently for every row of a batch.

Shape legend: B batch, G groups of layers, N choices (the base and every expert), Q query, r rank.
"""

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import PolicyError
from lifelong.nn.adapters import check_matches, matches

_GAP = 7.0  # [nat] below the best logit: e^-7 is less than a thousandth of its weight
_RIDGE = 1e-4  # regularisation of the least squares


class Router(nn.Module):
    """Network from a query to the coefficients of the experts in every group of layers.

    A hidden layer, a key for each choice and group, and a softmax over the `top_k` best choices. Choice 0 is the
    base alone; experts are appended with `grow`.

    Args:
        enter: Weight of the hidden layer (hidden, Q).
        keys: Keys of the choices (N, G, hidden).
        bias: Biases of the choices (N, G).
        top_k: Number of choices that share the weight; 0: all.
    """

    def __init__(self, *, enter: Tensor, keys: Tensor, bias: Tensor, top_k: int) -> None:
        super().__init__()
        self.enter, self.top_k = nn.Parameter(enter), top_k
        self.keys, self.bias = nn.Parameter(keys), nn.Parameter(bias)

    def hidden(self, query: Tensor) -> Tensor:
        """Map queries (B, Q) to the hidden layer's output (B, hidden), float32."""
        with torch.autocast(query.device.type, enabled=False):
            return functional.gelu(query.float() @ self.enter.T)

    def logits(self, query: Tensor) -> Tensor:
        """Map queries (B, Q) to logits (B, G, N), float32."""
        with torch.autocast(query.device.type, enabled=False):
            return torch.einsum("bh,ngh->bgn", self.hidden(query), self.keys) + self.bias.T

    def forward(self, query: Tensor) -> Tensor:
        """Map queries (B, Q) to coefficients (B, G, N), which sum to one over N and are zero beyond the best."""
        logits = self.logits(query)
        if 0 < self.top_k < logits.shape[-1]:
            least = logits.topk(self.top_k, dim=-1).values[..., -1:]
            logits = logits.masked_fill(logits < least, -math.inf)
        return logits.softmax(-1)

    @torch.no_grad()
    def grow(self, count: int, queries: Tensor, earlier: Tensor) -> None:
        """Append choices whose keys fit two targets by weighted least squares.

        On the new task's queries their logit starts equal to that of the best choice, on earlier queries `_GAP`
        below it. Keys of zero would disturb earlier tasks, and replay would then suppress the new choices on all
        queries before the router learned to tell these apart.

        Args:
            count: Number of choices to append.
            queries: Queries of the new task (B, Q).
            earlier: Queries of earlier tasks (M, Q).
        """
        both = torch.cat([queries, earlier])
        target = self.logits(both).amax(-1)  # (B + M, G)
        target[len(queries) :] -= _GAP
        hidden = functional.pad(self.hidden(both), (0, 1), value=1.0).double()
        weight = torch.cat([q.new_full((len(q), 1), 1 / max(1, len(q))) for q in (queries, earlier)]).double()
        gram = hidden.T @ (weight * hidden) + _RIDGE * torch.eye(hidden.shape[1]).to(hidden)
        solved = torch.linalg.solve(gram, hidden.T @ (weight * target.double())).to(
            self.keys
        )  # (hidden + 1, G)
        keys, bias = solved[:-1].T.expand(count, -1, -1), solved[-1].expand(count, -1)
        self.keys = nn.Parameter(torch.cat([self.keys, keys]))
        self.bias = nn.Parameter(torch.cat([self.bias, bias]))


def routed_layers(policy: nn.Module, patterns: Sequence[str]) -> dict[str, nn.Module]:
    """Return the linear layers and convolutions whose weight's name matches one of the patterns, by name.

    Raises:
        ConfigError: There is none.
    """
    layers = {
        name: module
        for name, module in policy.named_modules()
        if isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and module.groups == 1)
    }
    found = [name for name in layers if matches(f"{name}.weight", patterns)]
    check_matches(found, patterns, [f"{name}.weight" for name in layers], "linear layer or convolution")
    return {name: layers[name] for name in found}


def expert_shape(layer: nn.Module) -> tuple[int, int]:
    """Return rows and columns of a layer's weight as a matrix."""
    out, inputs = layer.weight.flatten(1).shape  # type: ignore[operator, union-attr]
    return out, inputs


def expert_output(
    layer: nn.Module, x: Tensor, pairs: Sequence[Mapping[str, Tensor]], weights: Tensor
) -> Tensor:
    """Return what the experts add to a layer's output: `sum_i c_i B_i A_i x`, another mixture for each row.

    Args:
        layer: Linear layer or convolution.
        x: Input of the layer; the first axis has B rows, or a multiple with the rows of one sample adjacent.
        pairs: For the experts of each task, `a` (experts r, inputs) and `b` (out, experts r).
        weights: Coefficients c, each repeated r times, (B, sum of experts r).

    Raises:
        PolicyError: The first axis is no multiple of B.
    """
    rows, samples = len(x), len(weights)
    if rows % samples:
        raise PolicyError(
            f"a layer has {rows} rows for {samples} samples: rows cannot be assigned to samples"
        )
    a, b = torch.cat([p["a"] for p in pairs]), torch.cat([p["b"] for p in pairs], dim=1)
    weights = weights.repeat_interleave(rows // samples, dim=0)
    if isinstance(layer, nn.Conv2d):
        kernel = a.view(len(a), *layer.weight.shape[1:])
        h = functional.conv2d(x, kernel, None, layer.stride, layer.padding, layer.dilation)
        return functional.conv2d(h * weights[:, :, None, None].to(h.dtype), b[:, :, None, None])
    h = functional.linear(x, a)
    shape = (rows, *[1] * (h.dim() - 2), h.shape[-1])
    return functional.linear(h * weights.view(shape).to(h.dtype), b)
