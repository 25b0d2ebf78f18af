"""Policies with a history: features of every frame, a network over time, an action head.

Shape legend: B batch, T time, E latent, A action.
"""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import torch
from torch import Tensor, nn

from lifelong.errors import PolicyError
from lifelong.nn.heads import ActionHead
from lifelong.nn.tokens import LanguageToken, ProprioScaling, ProprioTokens, named_parts, standardise
from lifelong.nn.vision import encode_views
from lifelong.policies.base import Policy
from lifelong.types import Batch, CompletedWith, Observation, PolicySpec, Unfinished

# A class of `lifelong.nn`, or a `functools.partial` of one; the policy calls it with the sizes that only it knows.
Component = Callable[..., Any]
Head = Annotated[Component, CompletedWith(("in_dim", "action_dim"))]
ImageEncoder = Annotated[Component, CompletedWith(("image_size", "language_dim", "latent_dim"))]
OverTime = Annotated[Component, CompletedWith(("dim", "max_length"))]
Readout = Literal["instruction", "all"]


class HistoryPolicy(Policy):
    """Policy that acts on the last frames: encode each frame, mix the features over time, apply the head.

    A subclass builds its parts, the last of them `head` by `build_head`, and implements `encode`, `modalities` and
    `over_time`. When acting, the features of the last `memory_steps` frames are stored and go through `over_time` again
    at every step, so that a step is computed as the last one of a window.

    Args:
        spec: What the policy observes and does; `spec.seq_len` is the longest window.
        stochastic: Whether to sample actions instead of taking the most likely ones; sampling needs generators.
        standardise_language: Whether to bring embeddings of instructions to mean 0 and variance 1, so that unit vectors
            of sentence encoders weigh as much as BERT's outputs.
    """

    head: ActionHead

    def __init__(self, spec: PolicySpec, *, stochastic: bool, standardise_language: bool) -> None:
        super().__init__(spec)
        self.stochastic, self.standardise_language = stochastic, standardise_language
        self._history: Tensor | None = None  # (B, <= memory_steps, ...)
        self._num_envs: int | None = None
        self._planned: list[Tensor] = []  # actions (B, A) still to be executed

    @abstractmethod
    def encode(self, observation: Observation) -> Tensor:
        """Return the features of every frame by itself, (B, T, ...)."""

    def modalities(self, features: Tensor) -> dict[str, Tensor]:
        """Return the parts of `encode`'s features by modality, each (B, T, ...); together they are all.

        They are called `language`, `proprio` (where there is any), and after the views, or `images` where those are
        mixed; the view that is named first comes first.

        Args:
            features: Features (B, T, ...).

        Raises:
            PolicyError: The policy does not implement it.
        """
        raise PolicyError(
            f"{type(self).__name__} has no modalities(features), which algorithms that distil features need: "
            "implement it, or choose another algorithm"
        )

    @abstractmethod
    def over_time(self, features: Tensor) -> Tensor:
        """Map features (B, T, ...) to latents (B, T, E), each computed from its own frame and earlier ones."""

    def instruction(self, observation: Observation) -> Tensor:
        """Return the instruction's embedding (B, L), standardised if so chosen."""
        return standardise(observation.language) if self.standardise_language else observation.language

    def build_head(self, head: Component, in_dim: int) -> ActionHead:
        """Build the head for latents of `in_dim` numbers.

        Raises:
            PolicyError: `head` is not a component, or its chunks are longer than the windows it learns from.
        """
        if not callable(head):
            raise PolicyError(f"policy.head is {head!r}, not a component: choose one with policy/head={head}")
        built: ActionHead = head(in_dim=in_dim, action_dim=self.spec.action_dim)
        if built.chunk > self.spec.seq_len:
            raise PolicyError(
                f"a chunk of {built.chunk} actions cannot be learned from windows of {self.spec.seq_len}: "
                f"set data.seq_len to {built.chunk} or more, or policy.head.chunk to {self.spec.seq_len} or less"
            )
        return built

    @property
    def chunk(self) -> int:  # type: ignore[override]  # of the head
        """Number of actions that it predicts at once."""
        return self.head.chunk

    @property
    def execute(self) -> int:  # type: ignore[override]
        """Number of these that are executed before it predicts again."""
        return self.head.execute

    @property
    def inpaints(self) -> bool:  # type: ignore[override]
        """Whether a chunk can continue what is being executed."""
        return self.head.inpaints

    @property
    def memory_steps(self) -> int:
        """Number of frames used to act: `seq_len`, less where a head learns from the steps that follow."""
        return self.spec.seq_len - self.head.chunk + 1

    def normalise(self, moments: Tensor, *, once: bool) -> None:
        """Normalise readings by statistics; see `Policy`. Actions are in [-1, 1], and stay as they are."""
        mean, deviation, *_ = moments[:, : sum(self.spec.proprio.values())]
        for module in self.modules():
            if isinstance(module, ProprioScaling):
                module.take(mean, deviation, once=once)

    def distribution(self, observation: Observation) -> dict[str, Tensor]:
        """Return the parameters of the action distribution at every step of a window; see the head."""
        return self.head(self.over_time(self.encode(observation)))

    def window_losses(self, batch: Batch) -> Tensor:
        """Return the loss of each window; see `Policy`."""
        return self.head.losses(self.distribution(batch.observation), batch.actions).mean(-1)

    def predict(self, batch: Batch) -> Tensor:
        """Return the mean action at every step; see `Policy`."""
        return self.head.mean(self.distribution(batch.observation))

    def answers(self, batch: Batch) -> dict[str, Tensor]:
        """Return what the head's students learn from; see `Policy`."""
        return self.head.answers(self.distribution(batch.observation))

    def divergence(self, batch: Batch, teacher: Mapping[str, Tensor]) -> Tensor:
        """Return the head's divergence from a teacher; see `Policy`."""
        return self.head.divergence(teacher, self.distribution(batch.observation))

    def reset(self, num_envs: int) -> None:
        """Forget the history and the planned actions; see `Policy`."""
        self._history, self._num_envs, self._planned = None, num_envs, []

    def step(self, observation: Observation) -> dict[str, Tensor]:
        """Add a frame to the history; return the parameters of the distribution of the next action.

        Raises:
            PolicyError: `reset` was called for another number of environments.
        """
        if self._num_envs != len(observation.images):
            raise PolicyError(
                f"reset was called for {self._num_envs} environments, the observation has "
                f"{len(observation.images)}; call reset(num_envs) at the start of an episode"
            )
        return self.head(self._latest_latent(self.encode(observation)))

    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        params, draws = self.step(observation), self._draws(generators)
        if not self._planned:
            self._planned = list(self.head.plan(params, draws)[:, : self.head.execute].unbind(1))
        return self._planned.pop(0)

    def _plan(
        self,
        observation: Observation,
        rows: Sequence[int],
        generators: Sequence[torch.Generator] | None,
        before: Mapping[int, Unfinished] | None,
    ) -> Tensor:
        params, draws = self.step(observation), self._draws(generators)
        if not rows:
            return observation.language.new_empty(0, self.head.chunk, self.spec.action_dim)
        if draws is not None:  # all rows are planned, so that no bit of one depends on which others ask
            draws = [draw if i in rows else draw.clone_state() for i, draw in enumerate(draws)]
        return self.head.plan(params, draws, before)[list(rows)]

    def _draws(self, generators: Sequence[torch.Generator] | None) -> Sequence[torch.Generator] | None:
        """Return the generators to draw with; None for a policy that takes the most likely actions."""
        if self.stochastic and (generators is None or len(generators) != self._num_envs):
            raise PolicyError(
                "a stochastic policy needs one generator per environment: act(..., generators=[...])"
            )
        return generators if self.stochastic else None

    def _latest_latent(self, features: Tensor) -> Tensor:
        """Append the features (B, 1, ...) of a frame to the history; return the frame's latent (B, E)."""
        if self._history is not None:
            features = torch.cat([self._history, features], dim=1)
        self._history = features[:, -self.memory_steps :]
        return self.over_time(self._history)[:, -1]


class VectorPolicy(HistoryPolicy):
    """Policy whose features are one vector per frame: the cameras' latents, the instruction's, and the readings."""

    def build_inputs(
        self, encoder: Component, image_embed: int, text_embed: int, normalise: bool, dropout: float
    ) -> int:
        """Build what reads the observation; return the size of a frame's vector, F."""
        spec = self.spec
        sizes = {"image_size": spec.image_size, "language_dim": spec.language_dim, "latent_dim": image_embed}
        self.encoders = nn.ModuleDict({view: encoder(**sizes) for view in spec.views})
        self.language = LanguageToken(language_dim=spec.language_dim, dim=text_embed)
        self.proprio = ProprioScaling(
            proprio=spec.proprio, normalise=normalise, dropout=dropout, measured=spec.measured
        )
        parts = {"language": text_embed, "proprio": sum(spec.proprio.values())}
        self._sizes = dict.fromkeys(spec.views, image_embed) | parts
        return sum(self._sizes.values())

    def encode(self, observation: Observation) -> Tensor:
        """Return one vector per frame, (B, T, F): the cameras' latents, the instruction's, and the readings."""
        images, language = observation.images, self.instruction(observation)
        seen = encode_views(self.encoders, images, language)
        text = self.language(language)[:, None].expand(*images.shape[:2], -1)
        return torch.cat([*seen, text, *self.proprio(observation.proprio).values()], dim=-1)

    def modalities(self, features: Tensor) -> dict[str, Tensor]:
        """Return the parts (B, T, n) of each camera, the instruction and the readings."""
        return named_parts(features, self._sizes, dim=-1)


class TokenPolicy(HistoryPolicy):
    """Policy whose features are tokens of each frame: the instruction, one per reading, and what the cameras see.

    A transformer over time mixes them. The head reads the instruction's token after it, as the original's does, and
    with `readout="all"` the frame's own tokens beside it.
    """

    def build_rest(
        self,
        cameras: Sequence[str],
        dim: int,
        temporal: Component,
        head: Component,
        readout: Readout,
        normalise: bool,
        dropout: float,
    ) -> None:
        """Build all but what reads the images, whose tokens of `dim` numbers have the names `cameras`."""
        spec, self.readout = self.spec, readout
        self.uses_history = readout == "instruction"  # all tokens of a frame are enough to act on
        self.language = LanguageToken(language_dim=spec.language_dim, dim=dim)
        self.proprio = ProprioTokens(
            proprio=spec.proprio, dim=dim, normalise=normalise, dropout=dropout, measured=spec.measured
        )
        self.transformer = temporal(dim=dim, max_length=spec.seq_len)
        if readout == "instruction" and len(getattr(self.transformer, "layers", (None,))) == 0:
            raise PolicyError(
                "policy.temporal.layers=0 with policy.readout=instruction: actions would follow the instruction alone; "
                "give at least one layer, or policy.readout=all"
            )
        self._sizes = {"language": 1, "proprio": len(spec.proprio)} | dict.fromkeys(cameras, 1)
        tokens = 1 + (sum(self._sizes.values()) if readout == "all" else 0)
        self.head = self.build_head(head, in_dim=dim * tokens)

    def tokens_beside(self, observation: Observation, language: Tensor) -> list[Tensor]:
        """Return the tokens of the instruction (B, L) and of each reading, each (B, T, E)."""
        first = self.language(language)[:, None].expand(*observation.images.shape[:2], -1)
        return [first, *self.proprio(observation.proprio)]

    def modalities(self, features: Tensor) -> dict[str, Tensor]:
        """Return the tokens of the instruction, the readings and what the cameras see, each (B, T, n, E)."""
        return named_parts(features, self._sizes, dim=2)

    def over_time(self, features: Tensor) -> Tensor:
        """Map tokens (B, T, M, E) to what the head reads, (B, T, E), or (B, T, E + M E) where it reads all."""
        answer = self.transformer(features)[:, :, 0]
        return answer if self.readout == "instruction" else torch.cat([answer, features.flatten(2)], dim=-1)


def with_features(policy: Policy) -> HistoryPolicy:
    """Return a policy that has features of frames, for an algorithm that needs them.

    Raises:
        PolicyError: It has none.
    """
    if not isinstance(policy, HistoryPolicy):
        raise PolicyError(
            f"{type(policy).__name__} has no encode, over_time and head, which this algorithm needs: derive it from "
            "HistoryPolicy, or choose another algorithm"
        )
    return policy
