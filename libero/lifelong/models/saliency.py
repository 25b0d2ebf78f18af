"""Where a policy looks.

Shape legend: B batch, T time, C H W image, P patches.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from libero.lifelong.batches import map_tensors


class PerturbationAttention:
    """How far the policy's action moves when a patch of a picture is blanked.

    The saliency of a patch is half the squared distance between the mean actions with and without it (Greydanus et
    al. 2018, "Visualizing and understanding Atari agents", eq. 3, with the picture's mean colour for the blur).

    Args:
        model: a policy: `forward(data)` gives a distribution of actions, or actions.
        image_size: H, W of the pictures.
        patch_size: height and width of a patch.
        device: where the model is.
    """

    def __init__(
        self,
        model: nn.Module,
        image_size: Sequence[int] = (128, 128),
        patch_size: Sequence[int] = (16, 16),
        device: torch.device | str = "cpu",
    ):
        self.model, self.image_size, self.patch_size = model, tuple(image_size), tuple(patch_size)
        self.device = torch.device(device)

    @torch.no_grad()
    def __call__(self, data: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Saliency of each camera's patches.

        Args:
            data: as `get_action` takes it, pictures (B, C, H, W), or a window with T steps, the last of which counts.

        Returns:
            View -> (B, rows, columns), not negative, as the pictures lie (lowest row first).
        """
        data = map_tensors(dict(data), lambda x: x.to(self.device))
        views = [key for key, value in data["obs"].items() if value.dim() >= 4]
        if data["obs"][views[0]].dim() == 4:
            steps = map_tensors(data["obs"], lambda x: x.unsqueeze(1))
            data = {**data, "obs": steps}
        was_training = self.model.training
        self.model.eval()
        seen = self._action(data)
        found = {view: self._saliency(data, view, seen) for view in views}
        self.model.train(was_training)
        return found

    def _saliency(self, data: Mapping[str, Any], view: str, seen: Tensor) -> np.ndarray:
        image = data["obs"][view]
        height, width = self.patch_size
        rows, columns = (n // p for n, p in zip(image.shape[-2:], self.patch_size, strict=True))
        mean = image.mean(dim=(-2, -1), keepdim=True)
        scores = torch.zeros(len(image), rows, columns)
        for row in range(rows):
            for column in range(columns):
                blank = image.clone()
                blank[..., row * height : (row + 1) * height, column * width : (column + 1) * width] = mean
                action = self._action({**data, "obs": {**data["obs"], view: blank}})
                scores[:, row, column] = 0.5 * (action - seen).square().sum(-1).cpu()
        return scores.numpy()

    def _action(self, data: Mapping[str, Any]) -> Tensor:
        """The mean action of the last step, (B, A)."""
        dist = self.model(data)
        return (dist if isinstance(dist, Tensor) else dist.mean)[:, -1].float()
