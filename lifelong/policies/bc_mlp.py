"""ResNet-MLP: ResNet with FiLM per camera, an action head on the features of one frame.

Shape legend: B batch, T time, F features of a frame, L language embedding.
"""

import torch
from torch import Tensor, nn

from lifelong.nn.heads import DeterministicHead
from lifelong.nn.tokens import LanguageToken, ProprioScaling, standardise
from lifelong.nn.vision import ResNetFiLMEncoder
from lifelong.policies.history import Head, HistoryPolicy, ImageEncoder
from lifelong.types import Observation, PolicySpec, Share, Width


class BCMLP(HistoryPolicy):
    """Behaviour cloning from one frame: an action head on all of its features, side by side.

    The cameras' latents, the instruction's latent and the proprioceptive readings are joined to one vector, which the
    head reads. It has no memory: the frames of a window are learned one by one. A short training learns to look: with
    a transformer over the same features the arm's pose gives the action away first, and the hand goes where the object
    is on average (experiments/laptop).

    Args:
        spec: What the policy observes and does.
        image_embed: Size of a camera's latent.
        text_embed: Size of the instruction's latent.
        encoder: Image encoder, one for each camera, see `ResNetFiLMEncoder`; completed with `image_size`,
            `language_dim` and `latent_dim`.
        head: Action head: `GMMHead`, `DeterministicHead` or `FlowHead`; completed with `in_dim` and `action_dim`.
        stochastic: Whether to sample actions instead of taking the most likely ones; sampling needs generators.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring embeddings to mean 0 and variance 1.

    Raises:
        PolicyError: Components or sizes that do not work together.
    """

    def __init__(
        self,
        *,
        spec: PolicySpec,
        image_embed: Width = 64,
        text_embed: Width = 32,
        encoder: ImageEncoder = ResNetFiLMEncoder,
        head: Head = DeterministicHead,
        stochastic: bool = False,
        normalise_proprio: bool = True,
        proprio_dropout: Share = 0.0,
        standardise_language: bool = True,
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
        self.head = self.build_head(head, in_dim=sum(self._sizes.values()))

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

    def over_time(self, features: Tensor) -> Tensor:
        """Return the features (B, T, F) as they are: each frame is by itself."""
        return features
