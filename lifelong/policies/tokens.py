"""Frames as tokens: the instruction, the readings and what is seen, with a transformer over time.

Shape legend: B batch, T time, M tokens per step, E token, L language embedding.
"""

from collections.abc import Sequence

from torch import Tensor

from lifelong.nn.tokens import LanguageToken, ProprioTokens, standardise
from lifelong.policies.history import Head, HistoryPolicy, OverTime
from lifelong.types import Observation, PolicySpec


class TokenPolicy(HistoryPolicy):
    """Policy whose features of a frame are M tokens: the instruction, one per proprioceptive modality, what is seen.

    All tokens of a step attend to each other and to everything earlier; the action is read from the instruction's
    token. A subclass builds its image encoders, then calls `build_rest`.

    Args:
        spec: What the policy observes and does.
        stochastic: As for `HistoryPolicy`.
        standardise_language: Whether to bring embeddings to mean 0 and variance 1.
    """

    uses_history = True

    def __init__(self, spec: PolicySpec, *, stochastic: bool, standardise_language: bool) -> None:
        super().__init__(spec, stochastic=stochastic)
        self.standardise_language = standardise_language

    def build_rest(
        self,
        *,
        seen: Sequence[str],
        embed_dim: int,
        temporal: OverTime,
        head: Head,
        normalise_proprio: bool,
        proprio_dropout: float,
    ) -> None:
        """Build what follows the images: tokens of the instruction and of readings, the transformer, and the head.

        Args:
            seen: Names of the tokens of what is seen, the last ones of a step.
            embed_dim: E.
            temporal: Network over time; completed with `dim` and `max_length`.
            head: Action head; completed with `in_dim` and `action_dim`.
            normalise_proprio: Whether to bring readings to order one, see `ProprioScaling`.
            proprio_dropout: Chance that a modality is hidden in training, see `ProprioScaling`.
        """
        spec, self._seen = self.spec, tuple(seen)
        self.language = LanguageToken(language_dim=spec.language_dim, dim=embed_dim)
        self.proprio = ProprioTokens(
            proprio=spec.proprio, dim=embed_dim, normalise=normalise_proprio, dropout=proprio_dropout
        )
        self.transformer = temporal(dim=embed_dim, max_length=spec.seq_len)
        self.head = self.build_head(head, in_dim=embed_dim)

    def instruction(self, observation: Observation) -> Tensor:
        """Return the instruction's embedding (B, L), standardised if so chosen."""
        return standardise(observation.language) if self.standardise_language else observation.language

    def first_tokens(self, observation: Observation, language: Tensor) -> list[Tensor]:
        """Return the tokens of the instruction (B, L) and of the readings, each (B, T, ..., E)."""
        b, t = observation.images.shape[:2]
        tokens = [self.language(language)[:, None, None].expand(b, t, 1, -1)]
        return [*tokens, self.proprio(observation.proprio)] if self.spec.proprio else tokens

    def modalities(self, features: Tensor) -> dict[str, Tensor]:
        """Return the tokens (B, T, M, E) of the instruction, the readings and what is seen; see `HistoryPolicy`."""
        end = 1 + len(self.spec.proprio)
        proprio = {"proprio": features[:, :, 1:end]} if self.spec.proprio else {}
        seen = {name: features[:, :, at : at + 1] for at, name in enumerate(self._seen, end)}
        return {"language": features[:, :, :1]} | proprio | seen

    def over_time(self, features: Tensor) -> Tensor:
        """Map tokens (B, T, M, E) to the instruction's latent at every step, (B, T, E)."""
        return self.transformer(features)[:, :, 0]
