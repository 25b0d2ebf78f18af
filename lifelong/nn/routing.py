"""Which experts act on an input: a router, prototypes, autoencoders.

Shape legend: B batch, G groups of layers, N experts, Q query.
"""

import math
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.errors import CheckpointError
from lifelong.types import to_device

_SAMPLES = 64  # of a step of an autoencoder


class SigmoidRouter(nn.Module):
    """Network from a query to a coefficient of each expert in each group of layers, `2 sigmoid(logit)`.

    Experts do not compete: the coefficient of one does not depend on that of another. All start near
    1 / min(`top_k`, experts). Queries are brought to length one. An optimiser that follows the gradient's signs would
    otherwise move a hidden unit by the rate times the sum of a query's hundreds of entries at every step, and all
    coefficients with it.

    Args:
        weights: `enter` (hidden, Q), `middle` (hidden, hidden), `leave` (G N, hidden), `bias` (G, N).
        top_k: Number of experts whose coefficients count, the others' are zero; 0: all.

    Raises:
        CheckpointError: The shapes of the weights do not go together.
    """

    def __init__(self, weights: Mapping[str, Tensor], *, top_k: int) -> None:
        super().__init__()
        self.top_k = top_k
        hidden, outputs = len(weights["enter"]), weights["bias"].numel()
        shapes = {"middle": (hidden, hidden), "leave": (outputs, hidden)}
        fits = weights["enter"].dim() == weights["bias"].dim() == 2
        if not fits or any(weights[name].shape != shape for name, shape in shapes.items()):
            raise CheckpointError("the weights of the router do not go together")
        for name, weight in weights.items():
            self.register_parameter(name, nn.Parameter(weight))

    @classmethod
    def new(
        cls, queries: int, hidden: int, groups: int, experts: int, top_k: int, draws: torch.Generator
    ) -> "SigmoidRouter":
        """Build a router for queries of the given size; `draws` is a CPU generator."""
        uniform = lambda *shape: (torch.rand(*shape, generator=draws) * 2 - 1) / shape[-1] ** 0.5  # noqa: E731
        share = 0.5 / min(top_k or experts, experts)
        bias = torch.full((groups, experts), math.log(share / (1 - share)))
        weights = {
            "enter": uniform(hidden, queries) * queries**0.5,
            "middle": uniform(hidden, hidden),
            "leave": uniform(groups * experts, hidden),
            "bias": bias,
        }
        return cls(weights, top_k=top_k)

    def coefficients(self, query: Tensor) -> Tensor:
        """Map queries (B, Q) to the coefficients of all experts (B, G, N), float32 in (0, 2)."""
        with torch.autocast(query.device.type, enabled=False):
            h = functional.gelu(functional.normalize(query.float(), dim=-1) @ self.enter.T)
            h = functional.gelu(h @ self.middle.T)
            return 2 * torch.sigmoid((h @ self.leave.T).view(len(query), *self.bias.shape) + self.bias)

    def forward(self, query: Tensor, newest: int = 0) -> Tensor:
        """Map queries (B, Q) to coefficients (B, G, N), zero beyond the `top_k` largest of each group.

        Args:
            query: Queries (B, Q).
            newest: Number of experts, from the last, that count in any case and are among the `top_k`.
        """
        c = self.coefficients(query)
        if 0 < self.top_k < c.shape[-1]:
            rank = c.detach().clone()
            rank[..., c.shape[-1] - newest :] = torch.inf
            c = c * (rank >= rank.topk(max(self.top_k, newest), dim=-1).values[..., -1:])
        return c


def cluster_centres(x: Tensor, count: int, draws: torch.Generator, iterations: int = 20) -> Tensor:
    """Return the centres of k-means clusters, (count or fewer, F) (Lloyd 1982; Arthur and Vassilvitskii 2007).

    Args:
        x: Points (n, F).
        count: Number of clusters; fewer where there are fewer points.
        draws: CPU generator, which draws the first centres, each by its squared distance from those before it.
    """
    points = x.double()
    centres = points[torch.randint(len(points), (1,), generator=draws).to(x.device)]
    for _ in range(min(count, len(points)) - 1):
        nearest = torch.cdist(points, centres).amin(1).square()
        drawn = torch.multinomial((nearest + 1e-12).cpu(), 1, generator=draws)
        centres = torch.cat([centres, points[drawn.to(x.device)]])
    for _ in range(iterations):
        own = functional.one_hot(torch.cdist(points, centres).argmin(1), len(centres)).to(points)
        sizes = own.sum(0)[:, None]
        centres = torch.where(sizes > 0, own.T @ points / sizes.clamp(min=1), centres)
    return centres.to(x.dtype)


def nearest_key(x: Tensor, prototypes: Mapping[int, Tensor]) -> Tensor:
    """Return for each point (B, F) the key whose centres (K, F) have the most similar one by cosine.

    Keys are (B,) int64 on the CPU, where the rows of each are told apart.
    """
    x = functional.normalize(x.float(), dim=-1)
    similar = [(x @ functional.normalize(c.float(), dim=-1).T).amax(1) for c in prototypes.values()]
    return torch.tensor(list(prototypes))[torch.stack(similar).argmax(0).cpu()]


def groups_of_rows(keys: Tensor) -> list[tuple[int, Tensor | None]]:
    """Return the keys that occur among (B,) int64 on the CPU, each with its rows (n,) int64; None for all rows."""
    distinct = keys.unique().tolist()
    return [(key, None if len(distinct) == 1 else (keys == key).nonzero()[:, 0]) for key in distinct]


class Discriminator:
    """Autoencoder that knows the inputs of a layer on one task by how well it reconstructs them.

    `leave relu(enter x)` with biases, trained by squared error; then the mean and the standard deviation of its error
    on the task's samples. A sample's error is the mean over its tokens and their features.

    Args:
        weights: `enter` (hidden, D), `enter_bias` (hidden), `leave` (D, hidden), `leave_bias` (D), `mean` and `std`
            of the error, scalars.
    """

    form = dict.fromkeys(("enter", "enter_bias", "leave", "leave_bias", "mean", "std"), Tensor)

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        self.weights = dict(weights)

    @classmethod
    def fit(
        cls, samples: Tensor, hidden: int, steps: int, lr: float, draws: torch.Generator
    ) -> "Discriminator":
        """Train an autoencoder by AdamW.

        Args:
            samples: Inputs of the layer (n, tokens, D).
            steps: Number of steps, of up to `_SAMPLES` samples each.
            lr: Learning rate.
            draws: CPU generator.
        """
        features = samples.shape[-1]
        bound = {"enter": features**-0.5, "leave": hidden**-0.5}
        shapes = {"enter": (hidden, features), "leave": (features, hidden)}
        drawn = {n: (torch.rand(*s, generator=draws) * 2 - 1) * bound[n] for n, s in shapes.items()}
        zeros = {"enter_bias": torch.zeros(hidden), "leave_bias": samples.float().mean((0, 1)).cpu()}
        weights = {n: nn.Parameter(w.to(samples.device)) for n, w in (drawn | zeros).items()}
        with torch.enable_grad():
            optimizer = torch.optim.AdamW(weights.values(), lr=lr)
            for _ in range(steps):
                rows = to_device(torch.randint(len(samples), (_SAMPLES,), generator=draws), samples.device)
                optimizer.zero_grad()
                _errors(samples[rows], weights).mean().backward()
                optimizer.step()
        discriminator = cls({n: w.detach() for n, w in weights.items()})
        errors = discriminator.errors(samples)
        discriminator.weights |= {"mean": errors.mean(), "std": errors.std(correction=0)}
        return discriminator

    def errors(self, samples: Tensor) -> Tensor:
        """Return the error of each sample (n, tokens, D), (n,) float32."""
        return _errors(samples, self.weights)

    def z_scores(self, samples: Tensor) -> Tensor:
        """Return how many standard deviations the errors of samples lie from the task's mean, (n,)."""
        return (self.errors(samples) - self.weights["mean"]).abs() / self.weights["std"].clamp(min=1e-8)


def _errors(samples: Tensor, weights: Mapping[str, Tensor]) -> Tensor:
    with torch.autocast(samples.device.type, enabled=False):
        x = samples.float()
        h = functional.relu(functional.linear(x, weights["enter"], weights["enter_bias"]))
        return (functional.linear(h, weights["leave"], weights["leave_bias"]) - x).square().mean((1, 2))
