"""ResNet-MLP: ResNet with FiLM per camera, an action head on the features of one frame.

Shape legend: B batch, T time, F features of a frame.
"""

from torch import Tensor

from lifelong.nn.heads import DeterministicHead
from lifelong.nn.vision import ResNetFiLMEncoder
from lifelong.policies.history import Head, ImageEncoder, VectorPolicy
from lifelong.types import PolicySpec, Share, Width


class BCMLP(VectorPolicy):
    """Behaviour cloning from one frame: an action head on all of its features, side by side.

    The cameras' latents, the instruction's latent and the proprioceptive readings are joined to one vector, which the
    head reads. It has no memory: the frames of a window are learned one by one. In a short training it learns to find
    the object where a transformer over the same features does not (experiments/laptop).

    Args:
        spec: What the policy observes and does.
        image_embed: Size of a camera's latent.
        text_embed: Size of the instruction's latent.
        encoder: Image encoder, one for each camera, see `ResNetFiLMEncoder`; completed with `image_size`,
            `language_dim` and `latent_dim`.
        head: Action head: `GMMHead`, `DeterministicHead` or `FlowHead`; completed with `in_dim` and `action_dim`.
        stochastic: See `HistoryPolicy`.
        normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
        proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        standardise_language: Whether to bring the numbers of an embedding to mean 0 and deviation 1.

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
        super().__init__(spec, stochastic=stochastic, standardise_language=standardise_language)
        size = self.build_inputs(encoder, image_embed, text_embed, normalise_proprio, proprio_dropout)
        self.head = self.build_head(head, in_dim=size)

    def over_time(self, features: Tensor) -> Tensor:
        """Return the features (B, T, F) as they are: each frame is by itself."""
        return features
