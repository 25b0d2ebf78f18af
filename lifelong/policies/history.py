"""Policies that look back: features of every frame, something over time, a head.

Shape legend: B batch, T time, E latent, A action.
"""

from abc import abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from lifelong.errors import PolicyError
from lifelong.nn.flow import FlowHead
from lifelong.nn.heads import ActionHead, DeterministicHead, GMMHead
from lifelong.policies.base import Policy
from lifelong.types import Batch, Observation, PolicySpec


class HistoryPolicy(Policy):
    """Features of single frames, mixed over time, become latents, and a head makes them actions.

    A subclass sets `head` and gives `encode` and `over_time`. When acting, features of the last `memory_steps`
    frames are kept and go through `over_time` anew at every step, so a step is computed as the last one of a window.

    Args:
        spec: what the policy sees and does; `spec.seq_len` is the longest window.
        stochastic: draw actions instead of taking the most likely ones; needs generators to act.
    """

    head: ActionHead

    def __init__(self, spec: PolicySpec, *, stochastic: bool) -> None:
        super().__init__(spec)
        self.stochastic = stochastic
        self._history: Tensor | None = None  # (B, <= memory_steps, ...)
        self._num_envs: int | None = None
        self._planned: list[Tensor] = []  # actions (B, A) still to be carried out

    @abstractmethod
    def encode(self, observation: Observation) -> Tensor:
        """Features of every frame by itself, (B, T, ...)."""

    @abstractmethod
    def over_time(self, features: Tensor) -> Tensor:
        """(B, T, ...) to latents (B, T, E), each from its own frame and earlier ones."""

    @property
    def memory_steps(self) -> int:
        """Frames looked at when acting: `seq_len`, less where a head needs what follows in the window to learn."""
        return self.spec.seq_len - self.head.chunk + 1

    def distribution(self, observation: Observation) -> dict[str, Tensor]:
        """Parameters of the action distribution at every step of a window; see the head."""
        return self.head(self.over_time(self.encode(observation)))

    def window_losses(self, batch: Batch) -> Tensor:
        """See `Policy`."""
        return self.head.losses(self.distribution(batch.observation), batch.actions).mean(-1)

    def predict(self, batch: Batch) -> Tensor:
        """See `Policy`."""
        return self.head.mean(self.distribution(batch.observation))

    def reset(self, num_envs: int) -> None:
        """See `Policy`."""
        self._history, self._num_envs, self._planned = None, num_envs, []

    def _act(self, observation: Observation, generators: Sequence[torch.Generator] | None) -> Tensor:
        params = self._step(observation)
        if not self.stochastic:
            generators = None
        elif generators is None or len(generators) != self._num_envs:
            raise PolicyError(
                "a stochastic policy needs one generator per environment: act(..., generators=[...])"
            )
        if not self._planned:
            self._planned = list(self.head.plan(params, generators).unbind(1))
        return self._planned.pop(0)

    def _step(self, observation: Observation) -> dict[str, Tensor]:
        """Takes a frame in; the parameters of the distribution of the next action."""
        if self._num_envs != len(observation.images):
            raise PolicyError(
                f"reset announced {self._num_envs} environments, the observation has {len(observation.images)}; "
                "call reset(num_envs) at the start of an episode"
            )
        return self.head(self._recall(self.encode(observation)))

    def _recall(self, features: Tensor) -> Tensor:
        """Appends a frame's features (B, 1, ...) to the history; its latent (B, E)."""
        if self._history is not None:
            features = torch.cat([self._history, features], dim=1)
        self._history = features[:, -self.memory_steps :]
        return self.over_time(self._history)[:, -1]


def make_head(
    kind: str,
    *,
    spec: PolicySpec,
    in_dim: int,
    hidden: int,
    layers: int,
    norm: bool,
    modes: int,
    min_std: float,
    low_eval_noise: bool,
    chunk: int,
    execute: int,
    flow_steps: int,
) -> ActionHead:
    """The head of a policy: `gmm`, `deterministic` or `flow`, each with the sizes that concern it.

    Raises:
        PolicyError: another kind, or a chunk longer than the window it must be learned from.
    """
    sizes = {"in_dim": in_dim, "action_dim": spec.action_dim, "hidden": hidden, "layers": layers}
    if kind == "gmm":
        return GMMHead(**sizes, norm=norm, modes=modes, min_std=min_std, low_eval_noise=low_eval_noise)
    if kind == "deterministic":
        return DeterministicHead(**sizes, norm=norm)
    if kind != "flow":
        raise PolicyError(f"unknown head {kind!r}. Valid: deterministic, flow, gmm")
    if chunk > spec.seq_len:
        raise PolicyError(
            f"a chunk of {chunk} actions cannot be learned from windows of {spec.seq_len}: "
            f"set data.seq_len to {chunk} or more, or policy.chunk to {spec.seq_len} or less"
        )
    return FlowHead(**sizes, chunk=chunk, execute=execute, steps=flow_steps)
