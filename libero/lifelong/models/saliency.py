"""Saliency of `libero_eval.saliency` for policies whose batches are dictionaries.

Shape legend: B batch, T time, C H W image, A action.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from libero._adapters.batches import image_tensor, map_tensors, uint8_image
from libero_eval.saliency import SaliencySettings, saliency
from lifelong.types import Batch, Observation


class PerturbationAttention:
    """Change of a policy's action when a place of an image is blurred; see `libero_eval.saliency`.

    Args:
        model: Policy; `forward(data)` returns a distribution of actions, or actions.
        image_size: H, W of the images that `patch_size` refers to.
        patch_size: Height and width of a blurred place, and the distance between places, in pixels.
    """

    def __init__(
        self,
        model: nn.Module,
        image_size: Sequence[int] = (128, 128),
        patch_size: Sequence[int] = (16, 16),
        device: torch.device | str = "cpu",
    ):
        stride = 128 * patch_size[0] / image_size[0]
        self.settings = SaliencySettings(stride=stride, sigma=0.75 * stride, blur=0.625 * stride)
        self.model, self.device = model, torch.device(device)

    def __call__(self, data: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Return the saliency of each camera's pixels: view -> (B, H, W), at least 0, bottom row first.

        Args:
            data: Input of `get_action` with images (B, C, H, W), or windows, whose last step counts.
        """
        data = map_tensors(dict(data), lambda x: x.to(self.device))
        obs = data["obs"]
        views = [name for name, value in obs.items() if value.dim() >= 4]
        if obs[views[0]].dim() == 4:
            obs = map_tensors(obs, lambda x: x.unsqueeze(1))
        maps = [self._map({**data, "obs": obs}, views, b) for b in range(len(obs[views[0]]))]
        heat = torch.stack(maps).flip(-2).cpu().numpy()  # (B, V, H, W)
        return {view: heat[:, k] for k, view in enumerate(views)}

    def _map(self, data: Mapping[str, Any], views: Sequence[str], row: int) -> Tensor:
        """Return the saliency (V, H, W) of one row of the batch, top row first."""
        one = map_tensors(dict(data), lambda x: x[row : row + 1])
        images = torch.stack([uint8_image(one["obs"][view]).flip(-3) for view in views], dim=2)
        empty = torch.zeros(1, 1, device=self.device)
        batch = Batch(Observation(images, {}, empty), empty, empty[0].long(), empty[0].long())
        return saliency(cast(Any, _MeanAction(self.model, one, views)), batch, self.settings)


class _MeanAction(nn.Module):
    """Predicts a policy's mean actions for other images, with all other inputs unchanged."""

    def __init__(self, model: nn.Module, data: Mapping[str, Any], views: Sequence[str]):
        super().__init__()
        self.model, self.data, self.views = model, data, views

    def predict(self, batch: Batch) -> Tensor:
        """Return the mean actions, (B, T, A)."""
        images = batch.observation.images.flip(-3)
        data = map_tensors(dict(self.data), lambda x: x.expand(len(images), *x.shape[1:]))
        changed = {view: image_tensor(images[:, :, k]) for k, view in enumerate(self.views)}
        output = self.model({**data, "obs": {**data["obs"], **changed}})
        return (output if isinstance(output, Tensor) else output.mean).float()
