"""Planners whose actions come from a policy server: in chunks under a protocol, or as of a run in process."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from libero_env.envs.checks import checked_numbers
from libero_env.tasks import get_task
from libero_eval.protocols.adapter import ACTION_DIM, ProtocolAdapter
from libero_eval.servers.openpi import OpenpiClient
from libero_eval.servers.serving import PREFIX
from libero_eval.servers.transport import EpisodeStart, PolicyClient
from lifelong.errors import ServerError
from lifelong.evaluation.environments import Obs


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


class ServedActor:
    """Actions of a run that `libero serve` serves: it is sent what the policy would see in process, to the bit.

    All simulations of a task are one request, so that they are computed as in process. The server has the history, so
    it is sent every observation, and in `plan` which simulations ask.

    Args:
        client: The server.
        announced: Its metadata.
        episodes: Episode of each simulation; all of one task.
        seeds: Words from which the generator of each episode is made, for stochastic policies.
    """

    observes = "always"

    def __init__(
        self,
        client: OpenpiClient,
        announced: Mapping[str, Any],
        episodes: Sequence[EpisodeStart],
        seeds: Sequence[Sequence[int]],
    ):
        self._client, self._episodes = client, episodes
        self._names = [key.removeprefix(PREFIX) for key in announced["observation"]]
        self.views = tuple(name for name in self._names if name.endswith("_rgb"))
        self.action_dim = int(announced["actions"]["shape"][-1])
        self.replan = int(announced["replan"])
        task = episodes[0].task
        self._first = {"reset": True, "seed": [list(words) for words in seeds]}
        if task.suite != "file":  # the server does not have those
            self._first["task"] = task.id
        reworded = task.suite != "file" and task.language != get_task(task.id).language
        self._first["instruction" if reworded else "prompt"] = task.language
        self._begun = self._connected = False

    def reset(self, num_envs: int) -> None:
        """Let the next request begin the episodes; see `lifelong.evaluation.actors.Actor`."""
        if not self._connected:
            self._client.open(self._episodes[:1])
        self._connected, self._begun = True, False

    def plan(self, obs: Obs, rows: Sequence[int]) -> np.ndarray:
        """Return the chunks of some simulations, (len(rows), H, 7) float64.

        Raises:
            ServerError: The server fails, is too late, or its actions are not valid.
            ConnectionLost: The connection breaks.
        """
        request: dict[str, Any] = {PREFIX + name: np.asarray(obs[name]) for name in self._names}
        request["plan"] = list(rows)
        actions = self._client.request(request if self._begun else request | self._first).get("actions")
        self._begun = True
        name, wanted = f"the actions of {self._client.address}", f"({len(rows)}, H, {self.action_dim})"
        chunks = checked_numbers(actions, name, (wanted,), ServerError)
        if chunks.ndim != 3 or chunks.shape[::2] != (len(rows), self.action_dim):
            raise ServerError(f"{name}: expected shape {wanted}, got {chunks.shape}")
        return chunks
