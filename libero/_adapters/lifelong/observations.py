"""Observations as the original's policies take them, and as those of `lifelong` do.

The original: a dictionary of tensors, pictures (B, T, C, H, W) in [0, 1] with the lowest row first as OpenGL draws.
`lifelong`: `Observation`, pictures (B, T, V, H, W, C) uint8 and upright.

Shape legend: B batch, T time, V views, C H W image, D one reading's dimension, L language embedding.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lifelong.errors import PolicyError
from lifelong.types import Observation, PolicySpec

READINGS = {"use_joint": ("joint_states", 7), "use_gripper": ("gripper_states", 2), "use_ee": ("ee_pos", 3)}


def spec_of(cfg: Any, shape_meta: Mapping[str, Any], history: int) -> PolicySpec:
    """What a policy is built for.

    Args:
        cfg: the configuration; `data.use_*` say what is seen.
        shape_meta: from `get_dataset`.
        history: frames that the policy looks back over when acting.

    Raises:
        PolicyError: depth among the pictures, or pictures of different sizes.
    """
    shapes = shape_meta["all_shapes"]
    views = [key for key in shapes if "rgb" in key and (cfg.data.use_eye_in_hand or "eye_in_hand" not in key)]
    sizes = {tuple(shapes[view])[1:] for view in views}
    if any("depth" in key for key in shapes):
        raise PolicyError("these policies see colour only: leave data.obs.modality.depth empty")
    if len(sizes) != 1:
        raise PolicyError(f"pictures must be there and of one size; {views or 'none'} have {sorted(sizes)}")
    return PolicySpec(
        views=tuple(views),
        image_size=sizes.pop(),
        proprio={name: size for key, (name, size) in READINGS.items() if cfg.data[key]},
        action_dim=shape_meta["ac_dim"],
        language_dim=cfg.policy.language_encoder.network_kwargs.input_size,
        seq_len=max(history, cfg.data.seq_len),
    )


def to_native(obs: Mapping[str, Tensor], task_emb: Tensor, spec: PolicySpec) -> Observation:
    """The original's dictionary as an `Observation`; pictures are rounded to 256 levels.

    Args:
        obs: view -> (B, T, C, H, W), reading -> (B, T, D).
        task_emb: (B, L).
        spec: which of them.
    """
    images = torch.stack([pixels(obs[view]).flip(-3) for view in spec.views], dim=2).contiguous()
    proprio = {name: reading(obs, name) for name in spec.proprio or ()}
    return Observation(images, proprio, task_emb.float())


def reading(obs: Mapping[str, Tensor], name: str) -> Tensor:
    """One reading; the hand's position is also the beginning of its pose."""
    if name == "ee_pos" and name not in obs and "ee_states" in obs:
        return obs["ee_states"][..., :3].float()
    if name not in obs:
        raise PolicyError(f"the observation lacks {name}; it has {', '.join(obs)}. See data.obs.modality")
    return obs[name].float()


def pixels(images: Tensor) -> Tensor:
    """(..., C, H, W) in [0, 1] -> (..., H, W, C) uint8."""
    if images.dtype != torch.uint8:
        images = (images * 255).round().clamp(0, 255).to(torch.uint8)
    return images.movedim(-3, -1).contiguous()


def picture(image: np.ndarray | Tensor) -> Tensor:
    """(..., H, W, C) uint8 -> (..., C, H, W) in [0, 1]."""
    return torch.as_tensor(np.ascontiguousarray(image)).movedim(-1, -3).contiguous().float() / 255
