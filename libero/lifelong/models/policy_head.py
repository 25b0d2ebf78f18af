"""Action heads: those of `lifelong.nn.heads`, which return distributions of PyTorch here.

Shape legend: E latent, K modes, A action.
"""

from typing import Any

from torch import Tensor, nn
from torch.distributions import Categorical, Independent, MixtureSameFamily, Normal

from lifelong.errors import PolicyError
from lifelong.nn import heads


class _Head(nn.Module):
    """Native head and the factor of its loss."""

    action_squash = True

    def __init__(self, head: Any, loss_coef: float):
        super().__init__()
        self.head, self.loss_coef = head, loss_coef

    def _reduce(self, losses: Tensor, reduction: str) -> Tensor:
        if reduction not in ("mean", "sum", "none"):
            raise PolicyError(f"reduction is {reduction!r}; valid: mean, sum, none")
        return (losses if reduction == "none" else getattr(losses, reduction)()) * self.loss_coef


class GMMHead(_Head):
    """Mixture of K Gaussians over actions, with means squashed by tanh; see `lifelong.nn.heads.GMMHead`.

    `input_size` is E, `output_size` A, `num_modes` K. Standard deviations are at least `min_std`, and equal to it in
    evaluation mode with `low_eval_noise`; their activation must be `softplus`. `loss_coef` is a factor of the loss.
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
        check_activation(activation)
        sizes: dict[str, Any] = {"modes": num_modes, "min_std": min_std, "low_eval_noise": low_eval_noise}
        sizes |= {"hidden": hidden_size, "layers": num_layers}
        super().__init__(heads.GMMHead(in_dim=input_size, action_dim=output_size, **sizes), loss_coef)

    def forward_fn(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return means and standard deviations (..., K, A), and logits (..., K), given latents (..., E)."""
        params = self.head(x)
        stds = params["stds"]
        if self.head.low_eval_noise and not self.head.training:
            stds = stds.new_full(stds.shape, self.head.min_std)
        return params["means"], stds, params["logits"]

    def forward(self, x: Tensor) -> MixtureSameFamily:
        """Return the distribution over actions (..., A) given latents (..., E)."""
        means, stds, logits = self.forward_fn(x)
        return MixtureSameFamily(Categorical(logits=logits), Independent(Normal(means, stds), 1))

    def loss_fn(self, gmm: MixtureSameFamily, target: Tensor, reduction: str = "mean") -> Tensor:
        """Return the negative log-likelihood of actions (..., A); the reduction is `mean`, `sum` or `none`."""
        return self._reduce(-gmm.log_prob(target.float()), reduction)


class DeterministicHead(_Head):
    """One action, trained by absolute error; see `lifelong.nn.heads.DeterministicHead`.

    `action_squash` says whether actions go through tanh; for the other arguments see `GMMHead`.
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
        head = heads.DeterministicHead(
            in_dim=input_size, action_dim=output_size, hidden=hidden_size, layers=num_layers
        )
        super().__init__(head, loss_coef)
        self.action_squash = action_squash

    def forward(self, x: Tensor) -> Tensor:
        """Return actions (..., A) for latents (..., E)."""
        return self.head(x)["means"] if self.action_squash else self.head.means(self.head.trunk(x))

    def loss_fn(self, action: Tensor, target: Tensor, reduction: str = "mean") -> Tensor:
        """Return the absolute error of actions (..., A); the reduction is `mean`, `sum` or `none`."""
        return self._reduce((action - target.float()).abs().mean(-1), reduction)


HEADS = {kind.__name__: kind for kind in (DeterministicHead, GMMHead)}


def wrap_head(native: heads.ActionHead, loss_coef: float) -> GMMHead | DeterministicHead:
    """Return a native head with the original's methods; the weights are shared."""
    kind: Any = GMMHead if isinstance(native, heads.GMMHead) else DeterministicHead
    head = kind.__new__(kind)
    _Head.__init__(head, native, loss_coef)
    return head


def check_activation(activation: str) -> None:
    """Raise a PolicyError if the activation is not the only one there is."""
    if activation != "softplus":
        raise PolicyError(f"activation is {activation!r}; valid: softplus")
