"""Where a policy looks: `lifelong.evaluation.saliency` for policies that take dictionaries.

Shape legend: B batch, T time, C H W image, A action.
"""

from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from libero._adapters.lifelong.batches import map_tensors
from libero._adapters.lifelong.observations import image_tensor, uint8_image
from lifelong.evaluation.saliency import SaliencySettings, saliency
from lifelong.types import Batch, Observation


class PerturbationAttention:
    """How far a policy's action moves when a place of a picture is blurred; see `lifelong.evaluation.saliency`.

    Args:
        model: a policy: `forward(data)` gives a distribution of actions, or actions.
        image_size: H, W of pictures in which lengths are measured.
        patch_size: height and width of what is blurred at once, and the distance of such places.
        device: where the model is.
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
        """Saliency of each camera's pixels.

        Args:
            data: as `get_action` takes it, pictures (B, C, H, W), or a window with T steps, the last of which counts.

        Returns:
            View -> (B, H, W), at least 0, as the pictures lie (lowest row first).
        """
        data = map_tensors(dict(data), lambda x: x.to(self.device))
        obs = data["obs"]
        views = [name for name, value in obs.items() if value.dim() >= 4]
        if obs[views[0]].dim() == 4:
            obs = map_tensors(obs, lambda x: x.unsqueeze(1))
        rows = [self._maps({**data, "obs": obs}, views, b) for b in range(len(obs[views[0]]))]
        heat = torch.stack(rows).flip(-2).cpu().numpy()  # (B, V, H, W)
        return {view: heat[:, k] for k, view in enumerate(views)}

    def _maps(self, data: Mapping[str, Any], views: Sequence[str], row: int) -> Tensor:
        """(V, H, W) of one row, upright."""
        one = map_tensors(dict(data), lambda x: x[row : row + 1])
        images = torch.stack([uint8_image(one["obs"][view]).flip(-3) for view in views], dim=2)
        nothing = torch.zeros(1, 1, device=self.device)
        batch = Batch(Observation(images, {}, nothing), nothing, nothing[0].long(), nothing[0].long())
        return saliency(cast(Any, _Answering(self.model, one, views)), batch, self.settings)


class _Answering(nn.Module):
    """A policy's mean actions for other pictures, with all else as it was."""

    def __init__(self, model: nn.Module, data: Mapping[str, Any], views: Sequence[str]):
        super().__init__()
        self.model, self.data, self.views = model, data, views

    def predict(self, batch: Batch) -> Tensor:
        """(B, T, A)."""
        images = batch.observation.images.flip(-3)
        data = map_tensors(dict(self.data), lambda x: x.expand(len(images), *x.shape[1:]))
        seen = {view: image_tensor(images[:, :, k]) for k, view in enumerate(self.views)}
        answer = self.model({**data, "obs": {**data["obs"], **seen}})
        return (answer if isinstance(answer, Tensor) else answer.mean).float()
