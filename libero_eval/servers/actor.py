"""An actor whose actions come from a policy server: chunks of actions, asked for when a simulation needs one."""

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from libero_eval.servers.wires import EpisodeStart, Wire
from lifelong.errors import ServerError
from lifelong.evaluation.actors import ACTION_DIM
from lifelong.evaluation.inputs import Adapter, Obs


class RemoteActor:
    """Actions from a policy server, a chunk of which each simulation executes before it asks for the next.

    Only simulations whose chunk is used up and whose episode is not over are asked for. A simulation's actions depend
    on its own answers, not on the order in which answers come.

    Args:
        wire: The server.
        adapter: Conversion of observations and actions under a protocol.
        episodes: Episode of each simulation.
        views: Names of the observed images that recorded rollouts show.
        replan: Number of actions of a chunk that are executed; None for a server that answers single actions.
    """

    action_dim = ACTION_DIM

    def __init__(
        self,
        wire: Wire,
        adapter: Adapter,
        episodes: Sequence[EpisodeStart],
        *,
        views: tuple[str, ...] = (),
        replan: int | None = None,
    ):
        self.views = views
        self._wire, self._adapter, self._episodes, self._replan = wire, adapter, tuple(episodes), replan
        self._chunks: list[deque[np.ndarray]] = []
        self._over = np.zeros(len(episodes), bool)

    @property
    def sees_next(self) -> bool:
        """Whether the next observation is sent to the server; the others need no images."""
        return any(not chunk for chunk, over in zip(self._chunks, self._over, strict=True) if not over)

    def reset(self, num_envs: int) -> None:
        """Begin the episodes on the server; see `lifelong.evaluation.actors.Actor`."""
        assert num_envs == len(self._episodes), "one simulation for each episode"
        self._chunks = [deque() for _ in self._episodes]
        self._over = np.zeros(num_envs, bool)
        self._wire.open(self._episodes)

    def note(self, over: np.ndarray, success: np.ndarray) -> None:
        """Take note of which episodes are over, (B,) bool, and which of them succeeded, (B,) bool."""
        for i in np.flatnonzero(over & ~self._over):
            self._wire.finish(int(i), bool(success[i]))
        self._over = over.copy()

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, 7) float64 actions; those of finished episodes are zero.

        Raises:
            ServerError: The server fails, is too late, or its actions are not valid.
            ConnectionLost: A connection breaks.
        """
        running = np.flatnonzero(~self._over).tolist()
        if rows := [i for i in running if not self._chunks[i]]:
            inputs = dict(zip(rows, self._adapter.inputs(obs, rows), strict=True))
            answers = self._wire.ask(inputs)
            for i in rows:
                predicted = checked_actions(answers[i], self._replan, self._describe(i))
                self._chunks[i].extend(self._adapter.actions(predicted))
        actions = np.zeros((len(self._chunks), self.action_dim))
        for i in running:
            actions[i] = self._chunks[i].popleft()
        return actions

    def _describe(self, i: int) -> str:
        episode = self._episodes[i]
        return f"{self._wire.address} ({episode.task.id}, initial state {episode.init_state})"


def checked_actions(answer: Any, replan: int | None, where: str) -> np.ndarray:
    """Return the actions to be executed from a server's answer, (replan, 7) float64.

    Args:
        answer: What the server sent as actions: (H, 7) numbers with H at least `replan`, or (7,) where one is executed.
        replan: Number of actions to be executed; None for a server that answers single actions.
        where: The server and the episode, for error messages.

    Raises:
        ServerError: The answer has another type, dtype or shape, too few actions, or values that are not finite.
    """
    wanted = f"({'H' if replan else 1}, {ACTION_DIM}) numbers" + (f" with H >= {replan}" if replan else "")
    try:
        found = np.asarray(answer)
    except ValueError as error:
        raise ServerError(f"{where} sent actions that are no array ({error}); expected {wanted}") from error
    if found.dtype.kind not in "fiu":
        raise ServerError(f"{where} sent actions of dtype {found.dtype}; expected {wanted}")
    chunk = found[None] if found.ndim == 1 else found
    if chunk.ndim != 2 or chunk.shape[1] != ACTION_DIM:
        raise ServerError(f"{where} sent actions of shape {found.shape}; expected {wanted}")
    if replan is None and len(chunk) != 1:
        raise ServerError(
            f"{where} sent actions of shape {found.shape}; expected {wanted}: the protocol asks for each action "
            "by itself, so let the server hand out its chunks one by one (vla-eval: chunk_size)"
        )
    if len(chunk) < (replan or 1):
        raise ServerError(f"{where} sent {len(chunk)} actions; the protocol executes {replan} of each answer")
    used = chunk[: replan or 1].astype(np.float64)
    if not np.isfinite(used).all():
        bad = used[~np.isfinite(used)][0]
        raise ServerError(f"{where} sent actions that are not finite ({bad}); expected {wanted}")
    return used
