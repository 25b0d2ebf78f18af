"""From latents to actions: the heads of `lifelong.nn.heads` as distributions of PyTorch.

Shape legend: E latent, K modes, A action.
"""

from typing import Any

from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from lifelong.errors import PolicyError
from lifelong.nn import heads

__all__ = ["DeterministicHead", "GMMHead"]


class GMMHead(nn.Module):
    """A mixture of K Gaussians over actions, means squashed by tanh.

    Args:
        input_size, output_size: E, A.
        hidden_size, num_layers: of the layers before.
        min_std: smallest standard deviation.
        num_modes: K.
        activation: of the deviations: `softplus`, the only one.
        low_eval_noise: in evaluation mode deviations are `min_std`.
        loss_coef: the loss is multiplied by it.

    Raises:
        PolicyError: another activation.
    """

    def __init__(
        self,
        input_size: int,
        output_size: int,
        hidden_size: int = 1024,
        num_layers: int = 2,
        min_std: float = 0.0001,
        num_modes: int = 5,
        activation: str = "softplus",
        low_eval_noise: bool = False,
        loss_coef: float = 1.0,
    ):
        super().__init__()
        check_activation(activation)
        self.head = heads.GMMHead(
            in_dim=input_size,
            action_dim=output_size,
            modes=num_modes,
            hidden=hidden_size,
            layers=num_layers,
            min_std=min_std,
            low_eval_noise=low_eval_noise,
        )
        self.loss_coef = loss_coef

    def forward(self, x: Tensor) -> MixtureSameFamily:
        """(..., E) -> a distribution over (..., A)."""
        params, stds = self.head(x), None
        if self.head.low_eval_noise and not self.head.training:
            stds = params["stds"].new_full(params["stds"].shape, self.head.min_std)
        parts = Independent(Normal(params["means"], params["stds"] if stds is None else stds), 1)
        return MixtureSameFamily(Categorical(logits=params["logits"]), parts)

    def loss_fn(self, gmm: MixtureSameFamily, target: Tensor, reduction: str = "mean") -> Tensor:
        """Negative log-likelihood of actions (..., A): mean, sum, or none (...)."""
        return _reduced(-gmm.log_prob(target.float()), reduction) * self.loss_coef


class DeterministicHead(nn.Module):
    """One action, trained by absolute error.

    Args:
        input_size, output_size: E, A.
        hidden_size, num_layers: of the layers before.
        action_squash: actions go through tanh.
        loss_coef: the loss is multiplied by it.
    """

    def __init__(
        self,
        input_size: int,
        output_size: int,
        hidden_size: int = 1024,
        num_layers: int = 2,
        action_squash: bool = True,
        loss_coef: float = 1.0,
    ):
        super().__init__()
        self.head = heads.DeterministicHead(
            in_dim=input_size, action_dim=output_size, hidden=hidden_size, layers=num_layers
        )
        self.action_squash, self.loss_coef = action_squash, loss_coef

    def forward(self, x: Tensor) -> Tensor:
        """(..., E) -> (..., A)."""
        if self.action_squash:
            return self.head(x)["means"]
        return self.head.means(self.head.trunk(x))

    def loss_fn(self, action: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
        """Absolute error of actions (..., A): mean, sum, or none (...)."""
        return _reduced((action - target.float()).abs().mean(-1), reduction) * self.loss_coef


HEADS = {kind.__name__: kind for kind in (DeterministicHead, GMMHead)}


def head_over(native: heads.ActionHead, loss_coef: float) -> GMMHead | DeterministicHead:
    """A native head under the original's methods; the weights are shared."""
    kind: Any = GMMHead if isinstance(native, heads.GMMHead) else DeterministicHead
    head = kind.__new__(kind)
    nn.Module.__init__(head)
    head.head, head.loss_coef, head.action_squash = native, loss_coef, True
    return head


def check_activation(activation: str) -> None:
    """Raises PolicyError where it is not the one there is."""
    if activation != "softplus":
        raise PolicyError(f"activation is {activation!r}; valid: softplus")


def _reduced(losses: Tensor, reduction: str) -> Tensor:
    if reduction not in ("mean", "sum", "none"):
        raise PolicyError(f"reduction is {reduction!r}; valid: mean, sum, none")
    return losses if reduction == "none" else getattr(losses, reduction)()
