"""Proprioceptive inputs of a policy.

Shape legend: B batch, T time, M inputs, D sum of their dimensions, E token.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from libero._adapters.batches import PROPRIO, proprio_input
from libero.lifelong.models.modules.language_modules import mlp
from lifelong.errors import PolicyError


class _ProprioEncoder(nn.Module):
    """Base of encoders of joints (7), gripper (2) and hand (3), through MLPs of `extra_num_layers` hidden layers."""

    def __init__(
        self,
        use_joint: bool = False,
        use_gripper: bool = False,
        use_ee: bool = False,
        extra_num_layers: int = 0,
        extra_hidden_size: int = 64,
        extra_embedding_size: int = 32,
    ):
        super().__init__()
        used = {"use_joint": use_joint, "use_gripper": use_gripper, "use_ee": use_ee}
        self.sizes = dict(PROPRIO[key] for key, is_used in used.items() if is_used)
        if not self.sizes:
            raise PolicyError("no proprioceptive input is used: set use_joint, use_gripper or use_ee")
        self.extra_embedding_size = extra_embedding_size
        self._build(extra_num_layers, extra_hidden_size, extra_embedding_size)

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        raise NotImplementedError

    def _inputs(self, obs_dict: Mapping[str, Tensor]) -> list[Tensor]:
        return [proprio_input(obs_dict, name) for name in self.sizes]


class ExtraModalities(_ProprioEncoder):
    """All inputs as one vector; without hidden layers they are not encoded."""

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        self.extra_low_level_feature_dim = self.output_size = sum(self.sizes.values())
        self.extra_encoder: nn.Module = nn.Identity()
        if num_layers:
            self.extra_encoder = mlp(self.output_size, hidden, num_layers + 1, embedding)
            self.output_size = embedding

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Encode inputs (B, T, ...) as (B, T, D), or as (B, T, E) with hidden layers."""
        return self.extra_encoder(torch.cat(self._inputs(obs_dict), dim=-1))

    def output_shape(self, input_shape: object = None, shape_meta: object = None) -> tuple[int, ...]:
        """Return the shape of one time step."""
        return (self.output_size,)


class ExtraModalityTokens(_ProprioEncoder):
    """One token for each input."""

    def _build(self, num_layers: int, hidden: int, embedding: int) -> None:
        encoders = {name: mlp(size, hidden, num_layers + 1, embedding) for name, size in self.sizes.items()}
        self.num_extra, self.encoders = len(encoders), nn.ModuleDict(encoders)

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Encode inputs (B, T, ...) as (B, T, M, E)."""
        inputs = zip(self.encoders.values(), self._inputs(obs_dict), strict=True)
        return torch.stack([encoder(x) for encoder, x in inputs], dim=-2)
