"""Features of a frame side by side: the cameras' latents, the instruction's latent and the readings.

Shape legend: B batch, T time, F features of a frame.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.tokens import LanguageToken, ProprioScaling, standardise
from lifelong.policies.history import HistoryPolicy, ImageEncoder
from lifelong.types import Observation, PolicySpec


class JoinedFeaturesPolicy(HistoryPolicy):
    """Policy whose features of a frame are one vector; a subclass implements `over_time` and sets `head`.

    Args:
        spec: What the policy observes and does.
        image_embed: Size of a camera's latent.
        text_embed: Size of the instruction's latent.
        encoder: Image encoder, one for each camera; completed with `image_size`, `language_dim` and `latent_dim`.
        stochastic: As for `HistoryPolicy`.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring embeddings to mean 0 and variance 1.

    Attributes:
        features: F.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        image_embed: int,
        text_embed: int,
        encoder: ImageEncoder,
        stochastic: bool,
        normalise_proprio: bool,
        proprio_dropout: float,
        standardise_language: bool,
    ) -> None:
        super().__init__(spec, stochastic=stochastic)
        self.standardise_language = standardise_language
        sizes = {"image_size": spec.image_size, "language_dim": spec.language_dim, "latent_dim": image_embed}
        self.encoders = nn.ModuleDict({view: encoder(**sizes) for view in spec.views})
        self.language = LanguageToken(language_dim=spec.language_dim, dim=text_embed)
        self.proprio = ProprioScaling(
            proprio=spec.proprio, normalise=normalise_proprio, dropout=proprio_dropout
        )
        readings = sum(spec.proprio.values())
        self._sizes = dict.fromkeys(spec.views, image_embed) | {"language": text_embed, "proprio": readings}
        self.features = sum(self._sizes.values())

    def encode(self, observation: Observation) -> Tensor:
        """Return one vector per frame, (B, T, F)."""
        images, language = observation.images, observation.language
        b, t = images.shape[:2]
        if self.standardise_language:
            language = standardise(language)
        parts = [
            encoder(images[:, :, view].flatten(0, 1), language).view(b, t, -1)
            for view, encoder in enumerate(self.encoders.values())
        ]
        parts.append(self.language(language)[:, None].expand(b, t, -1))
        parts += self.proprio(observation.proprio).values()
        return torch.cat(parts, dim=-1)

    def modalities(self, features: Tensor) -> dict[str, Tensor]:
        """Return the parts (B, T, ...) of each camera, the instruction and the readings; see `HistoryPolicy`."""
        parts = dict(zip(self._sizes, features.split(list(self._sizes.values()), dim=-1), strict=True))
        return {name: part for name, part in parts.items() if part.shape[-1]}
