"""Readings of the robot as part of what a policy knows.

Shape legend: B batch, T time, M readings, D all their numbers, E token.
"""

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from libero._adapters.lifelong.observations import PROPRIO, proprio_input
from libero.lifelong.models.modules.language_modules import mlp
from lifelong.errors import PolicyError

__all__ = ["ExtraModalities", "ExtraModalityTokens"]


class _Readings(nn.Module):
    def __init__(self, use_joint: bool, use_gripper: bool, use_ee: bool):
        super().__init__()
        used = {"use_joint": use_joint, "use_gripper": use_gripper, "use_ee": use_ee}
        self.sizes = dict(PROPRIO[key] for key, wanted in used.items() if wanted)
        if not self.sizes:
            raise PolicyError("no reading is used: set use_joint, use_gripper or use_ee")

    def _read(self, obs_dict: Mapping[str, Tensor]) -> list[Tensor]:
        return [proprio_input(obs_dict, name) for name in self.sizes]


class ExtraModalities(_Readings):
    """Joints (7), gripper (2) and hand (3) as one vector, through an MLP of `extra_num_layers` hidden layers if any."""

    def __init__(
        self,
        use_joint: bool = False,
        use_gripper: bool = False,
        use_ee: bool = False,
        extra_num_layers: int = 0,
        extra_hidden_size: int = 64,
        extra_embedding_size: int = 32,
    ):
        super().__init__(use_joint, use_gripper, use_ee)
        self.extra_low_level_feature_dim = sum(self.sizes.values())
        self.output_size, self.extra_encoder = self.extra_low_level_feature_dim, nn.Identity()
        if extra_num_layers:
            self.output_size = extra_embedding_size
            self.extra_encoder = mlp(  # type: ignore[assignment]
                self.extra_low_level_feature_dim,
                extra_hidden_size,
                extra_num_layers + 1,
                extra_embedding_size,
            )

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Readings (B, T, ...) -> (B, T, D), or (B, T, E) behind an MLP."""
        return self.extra_encoder(torch.cat(self._read(obs_dict), dim=-1))

    def output_shape(self, input_shape: object = None, shape_meta: object = None) -> tuple[int, ...]:
        """Of one time step."""
        return (self.output_size,)


class ExtraModalityTokens(_Readings):
    """A token for each of joints (7), gripper (2) and hand (3)."""

    def __init__(
        self,
        use_joint: bool = False,
        use_gripper: bool = False,
        use_ee: bool = False,
        extra_num_layers: int = 0,
        extra_hidden_size: int = 64,
        extra_embedding_size: int = 32,
    ):
        super().__init__(use_joint, use_gripper, use_ee)
        self.num_extra, self.extra_embedding_size = len(self.sizes), extra_embedding_size
        self.encoders = nn.ModuleDict(
            {
                name: mlp(size, extra_hidden_size, extra_num_layers + 1, extra_embedding_size)
                for name, size in self.sizes.items()
            }
        )

    def forward(self, obs_dict: Mapping[str, Tensor]) -> Tensor:
        """Readings (B, T, ...) -> (B, T, M, E)."""
        values = zip(self.encoders.values(), self._read(obs_dict), strict=True)
        return torch.stack([encoder(value) for encoder, value in values], dim=-2)
