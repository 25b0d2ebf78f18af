"""Planners whose actions come from a policy server, in chunks under a protocol."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_env.envs.checks import checked_numbers
from libero_eval.protocols.adapter import ACTION_DIM, ProtocolAdapter
from libero_eval.servers.transport import EpisodeStart, PolicyClient
from lifelong.errors import ServerError
from lifelong.evaluation.actors import Obs


class RemoteActor:
    """Chunks of actions from a policy server, which is asked for some simulations; their order does not matter.

    Args:
        client: The server.
        adapter: Conversion of observations and actions under a protocol.
        episodes: Episode of each simulation.
        views: Names of the observed images that recorded rollouts show.
        replan: Number of actions of a chunk that are executed; None for a server that answers single actions.
    """

    action_dim, observes = ACTION_DIM, "asked"

    def __init__(
        self,
        client: PolicyClient,
        adapter: ProtocolAdapter,
        episodes: Sequence[EpisodeStart],
        *,
        views: tuple[str, ...] = (),
        replan: int | None = None,
    ):
        self.views, self.replan = views, replan
        self._client, self._adapter, self._episodes = client, adapter, tuple(episodes)
        self._over = np.zeros(len(episodes), bool)

    def reset(self, num_envs: int) -> None:
        """Begin the episodes on the server; see `lifelong.evaluation.actors.Actor`."""
        assert num_envs == len(self._episodes), "one simulation for each episode"
        self._over = np.zeros(num_envs, bool)
        self._client.open(self._episodes)

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of which episodes are over, (B,) bool, and which of them succeeded, (B,) bool."""
        for i in np.flatnonzero(over & ~self._over):
            self._client.finish(int(i), bool(success[i]))
        self._over = over.copy()

    def plan(self, obs: Obs, rows: Sequence[int]) -> list[np.ndarray]:
        """Return the chunks (H, 7) float64 of some simulations.

        Raises:
            ServerError: The server fails, is too late, or its actions are not valid.
            ConnectionLost: A connection breaks.
        """
        answers = self._client.ask(dict(zip(rows, self._adapter.inputs(obs, rows), strict=True)))
        chunks = []
        for i in rows:
            episode = self._episodes[i]
            where = f"{self._client.address} ({episode.task.id}, initial state {episode.init_state})"
            chunks.append(self._adapter.actions(checked_actions(answers[i], self.replan, where)))
        return chunks


def checked_actions(answer: Any, replan: int | None, where: str) -> np.ndarray:
    """Return the actions of a server's answer, (H, 7) float64.

    Args:
        answer: What the server sent as actions: (H, 7) numbers with H at least `replan`, or (7,) where one is executed.
        replan: Number of actions to be executed; None for a server that answers single actions.
        where: The server and the episode, for error messages.

    Raises:
        ServerError: The answer has another type, dtype or shape, too few actions, or values that are not finite.
    """
    wanted = f"(H, {ACTION_DIM}) with H >= {replan}" if replan else f"(1, {ACTION_DIM})"
    actions = checked_numbers(answer, f"the actions of {where}", (wanted,), ServerError)
    chunk = actions[None] if actions.ndim == 1 else actions
    if chunk.ndim != 2 or chunk.shape[1] != ACTION_DIM:
        raise ServerError(f"{where} sent actions of shape {actions.shape}; expected {wanted}")
    if replan is None and len(chunk) != 1:
        raise ServerError(
            f"{where} sent actions of shape {actions.shape}; expected {wanted}: the protocol asks for each action "
            "by itself, so let the server hand out its chunks one by one (vla-eval: chunk_size)"
        )
    if len(chunk) < (replan or 1):
        raise ServerError(f"{where} sent {len(chunk)} actions; the protocol executes {replan} of each answer")
    return chunk
