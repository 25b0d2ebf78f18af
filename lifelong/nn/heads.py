"""Action heads: from latents to actions.

Shape legend: B batch, T time, E latent, K modes, A action.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from lifelong.types import Depth, NonNegative, Unfinished, Width, to_device


class ActionHead(nn.Module, ABC):
    """Distribution of actions in [-1, 1]^A, given latents (..., E).

    `forward` returns the parameters of the distribution, the other methods read them. Heads compute in float32 under
    autocast too: bfloat16 rounds an action by up to 0.004, and by 0.0018 RMS where a mixture's smallest deviation is
    1e-4.

    Attributes:
        chunk: Number of actions that a latent predicts: that of its own step and of the following ones.
        execute: Number of these that are executed before the next latent is needed.
        inpaints: Whether `plan` can continue unfinished chunks.
    """

    chunk: int = 1
    execute: int = 1
    inpaints: bool = False

    @abstractmethod
    def forward(self, latent: Tensor) -> dict[str, Tensor]:
        """Return the distribution's parameters, float32, for latents (..., E)."""

    @abstractmethod
    def losses(self, params: dict[str, Tensor], actions: Tensor) -> Tensor:
        """Return the loss of each action, (..., A) -> (...)."""

    def greedy(self, params: dict[str, Tensor]) -> Tensor:
        """Return the action of a policy that does not draw, (..., A); by default the mean."""
        return self.mean(params)

    @abstractmethod
    def mean(self, params: dict[str, Tensor]) -> Tensor:
        """Return the mean of the distribution, (..., A), with gradients."""

    @abstractmethod
    def sample(self, params: dict[str, Tensor], generator: torch.Generator | None) -> Tensor:
        """Draw an action, (..., A)."""

    def answers(self, params: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return what a student of this distribution needs of it, each (..., *); by default the mean."""
        return {"mean": self.mean(params)}

    def divergence(self, teacher: Mapping[str, Tensor], params: dict[str, Tensor]) -> Tensor:
        """Return how far a distribution is from a teacher's: zero, and least, where they are the same.

        By default the squared distance of the means.

        Args:
            teacher: From the teacher's `answers`, each (..., *).
            params: Parameters of the distribution that learns from it.

        Returns:
            The divergence of each action, (...), with gradients to `params`.
        """
        return (self.mean(params) - teacher["mean"]).square().sum(-1)

    def plan(
        self,
        params: dict[str, Tensor],
        generators: Sequence[torch.Generator] | None,
        before: Mapping[int, Unfinished] | None = None,
    ) -> Tensor:
        """Return the actions that a latent predicts.

        Args:
            params: Parameters for one latent per environment, (B, E).
            generators: One CPU generator per environment to draw with; None: nothing is drawn.
            before: What environments still execute of their last chunk, by row, for a head that inpaints.

        Returns:
            Actions (B, chunk, A).
        """
        if generators is None:
            return self.greedy(params)[:, None]
        device, on_host = next(iter(params.values())).device, {k: v.cpu() for k, v in params.items()}
        draws = [
            self.sample({k: v[i : i + 1] for k, v in on_host.items()}, generator)
            for i, generator in enumerate(generators)
        ]
        return to_device(torch.stack(draws), device)


def full_precision(x: Tensor) -> torch.autocast:
    """Return a context in which nothing on the device of `x` is cast to a lower precision."""
    return torch.autocast(x.device.type, enabled=False)


def _trunk(in_dim: int, hidden: int, layers: int, norm: bool) -> nn.Sequential:
    """Build hidden layers and a linear layer: with ReLU as in the original's heads, or with LayerNorm and GELU.

    With ReLU nearly all units of a small head are dead after a few tasks at a high rate; normalised, they stay alive
    (Lyle et al., "Understanding plasticity in neural networks", ICML 2023).
    """
    modules: list[nn.Module] = []
    for index in range(layers):
        modules.append(nn.Linear(in_dim if index == 0 else hidden, hidden))
        modules += [nn.LayerNorm(hidden), nn.GELU()] if norm else [nn.ReLU()]
    return nn.Sequential(*modules, nn.Linear(hidden if layers else in_dim, hidden))


class GMMHead(ActionHead):
    """Mixture of K diagonal Gaussians over actions, means squashed by tanh.

    Mandlekar et al., What matters in learning from offline human demonstrations (CoRL 2021); the sizes are
    LIBERO's.

    Args:
        in_dim: E.
        action_dim: A.
        modes: K, the number of Gaussians.
        hidden: Width of the shared trunk.
        layers: Number of hidden layers of the trunk.
        norm: Whether the hidden layers have LayerNorm and GELU instead of ReLU.
        min_std: Smallest standard deviation. The original's 1e-4 lets likelihoods of saturated dimensions
            grow without bound; 0.02 or so balances dimensions when data and time are short.
        low_eval_noise: Whether to sample with `min_std` instead of the learned deviation in eval mode.
        absolute: Weight of the absolute error of the mixture's mean beside the likelihood; the original has none.
        acts: What a policy that does not draw does: the mean of the `heaviest` component, or the `mean` of all. With
            the heaviest, a policy of one frame stands still for ever where that is what it does.
    """

    def __init__(
        self,
        *,
        in_dim: int,
        action_dim: int,
        modes: Width = 5,
        hidden: Width = 1024,
        layers: Depth = 2,
        norm: bool = False,
        min_std: NonNegative = 1e-4,
        low_eval_noise: bool = False,
        absolute: NonNegative = 0.0,
        acts: Literal["heaviest", "mean"] = "heaviest",
    ) -> None:
        super().__init__()
        self.absolute, self.acts = absolute, acts
        self.modes, self.action_dim = modes, action_dim
        self.min_std, self.low_eval_noise = min_std, low_eval_noise
        self.trunk = _trunk(in_dim, hidden, layers, norm)
        self.means = nn.Linear(hidden, modes * action_dim)
        self.stds = nn.Linear(hidden, modes * action_dim)
        self.logits = nn.Linear(hidden, modes)

    def forward(self, latent: Tensor) -> dict[str, Tensor]:
        """Return `means` (..., K, A) in (-1, 1), `stds` (..., K, A) and `logits` (..., K), float32."""
        shape = (*latent.shape[:-1], self.modes, self.action_dim)
        with full_precision(latent):
            h = self.trunk(latent.to(self.means.weight.dtype))
            return {
                "means": self.means(h).view(shape).tanh(),
                "stds": functional.softplus(self.stds(h).view(shape)) + self.min_std,
                "logits": self.logits(h),
            }

    def log_prob(self, params: dict[str, Tensor], actions: Tensor) -> Tensor:
        """Return log sum_k w_k prod_a N(action_a; mean_ka, std_ka) of actions, (..., A) -> (...)."""
        with full_precision(actions):
            z = (actions.float().unsqueeze(-2) - params["means"]) / params["stds"]
            per_mode = (-0.5 * z.square() - params["stds"].log()).sum(-1)  # (..., K)
            per_mode = per_mode - 0.5 * self.action_dim * math.log(2.0 * math.pi)
            return torch.logsumexp(params["logits"].log_softmax(-1) + per_mode, dim=-1)

    def losses(self, params: dict[str, Tensor], actions: Tensor) -> Tensor:
        """Return the negative log-likelihood of each action, (..., A) -> (...), and the absolute error where chosen."""
        losses = -self.log_prob(params, actions)
        if self.absolute:
            losses = losses + self.absolute * (actions.float() - self.mean(params)).abs().mean(-1)
        return losses

    def greedy(self, params: dict[str, Tensor]) -> Tensor:
        """Return the mixture's mean or that of its heaviest component, (..., A)."""
        if self.acts == "mean":
            return self.mean(params)
        return _take_mode(params["means"], params["logits"].argmax(-1))

    def mean(self, params: dict[str, Tensor]) -> Tensor:
        """Return sum_k w_k mean_k, (..., A); unlike the heaviest component's mean it is smooth in the parameters."""
        return (params["logits"].softmax(-1).unsqueeze(-1) * params["means"]).sum(-2)

    def answers(self, params: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return all parameters of the mixture."""
        return dict(params)

    def divergence(self, teacher: Mapping[str, Tensor], params: dict[str, Tensor]) -> Tensor:
        """Return an upper bound of the Kullback-Leibler divergence of a teacher's mixture from this one, (...).

        With weights w and components N_k it is `KL(w' | w) + sum_k w'_k KL(N'_k | N_k)`, the primed ones the teacher's:
        by the chain rule the divergence of component and action together, of which that of the action alone is a part
        (Do 2003, "Fast approximation of Kullback-Leibler distance for dependence trees and hidden Markov models"). It
        is closed, in nats like the loss, and zero only where weights and all components that have weight are equal.
        Components are compared by their numbers, which fits a student that began as the teacher.
        """
        with torch.autocast(params["means"].device.type, enabled=False):
            ratio = (teacher["stds"] / params["stds"]).square()
            distance = ((teacher["means"] - params["means"]) / params["stds"]).square()
            per_mode = 0.5 * (ratio - 1 - ratio.log() + distance).sum(-1)  # (..., K)
            before, now = teacher["logits"].log_softmax(-1), params["logits"].log_softmax(-1)
            return (before.exp() * (before - now + per_mode)).sum(-1)

    def sample(self, params: dict[str, Tensor], generator: torch.Generator | None) -> Tensor:
        """Draw an action from the mixture, (..., A)."""
        weights = params["logits"].softmax(-1)
        flat = weights.reshape(-1, self.modes)
        choice = torch.multinomial(flat, 1, generator=generator).view(weights.shape[:-1])
        mean, std = (_take_mode(params[name], choice) for name in ("means", "stds"))
        if self.low_eval_noise and not self.training:
            std = torch.full_like(std, self.min_std)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        return mean + std * noise


def _take_mode(values: Tensor, index: Tensor) -> Tensor:
    """Select the modes `index` (...) of `values` (..., K, A), -> (..., A)."""
    index = index[..., None, None].expand(*index.shape, 1, values.shape[-1])
    return values.gather(-2, index).squeeze(-2)


class DeterministicHead(ActionHead):
    """One action, squashed by tanh, trained by absolute error.

    Absolute rather than squared, because small errors near a grasp decide about success and large ones, where the
    phase changes, do not (Kim et al., "Fine-tuning vision-language-action models: optimizing speed and success",
    RSS 2025).

    Args:
        in_dim: E.
        action_dim: A.
        hidden: Width of the trunk.
        layers: Number of hidden layers of the trunk.
        norm: Whether the hidden layers have LayerNorm and GELU instead of ReLU.
    """

    def __init__(
        self, *, in_dim: int, action_dim: int, hidden: Width = 1024, layers: Depth = 2, norm: bool = False
    ) -> None:
        super().__init__()
        self.trunk = _trunk(in_dim, hidden, layers, norm)
        self.means = nn.Linear(hidden, action_dim)

    def forward(self, latent: Tensor) -> dict[str, Tensor]:
        """Return `means` (..., A), float32."""
        with full_precision(latent):
            return {"means": self.means(self.trunk(latent.to(self.means.weight.dtype))).tanh()}

    def losses(self, params: dict[str, Tensor], actions: Tensor) -> Tensor:
        """Return the absolute error, mean over the action's dimensions, (..., A) -> (...)."""
        return (actions.float() - params["means"]).abs().mean(-1)

    def mean(self, params: dict[str, Tensor]) -> Tensor:
        """Return the action, (..., A)."""
        return params["means"]

    def sample(self, params: dict[str, Tensor], generator: torch.Generator | None) -> Tensor:
        """Return the action, (..., A): this head is not random."""
        return params["means"]
