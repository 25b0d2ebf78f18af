"""An actor for a policy that `libero serve` serves: it sends what the policy would see in process, to the bit."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from libero_env.tasks import get_task
from libero_eval.servers.codecs import OPENPI
from libero_eval.servers.connections import Connection, Limits, LoopThread, connect
from libero_eval.servers.sessions import PREFIX
from libero_eval.servers.wires import EpisodeStart, OpenpiDialect
from lifelong.errors import ServerError
from lifelong.evaluation.actors import Obs


class ServedActor:
    """Actions of a served run; all simulations of a task are one request, so that they are computed as in process.

    Args:
        address: URL of the server.
        announced: Its metadata.
        episodes: Episode of each simulation; all of one task.
        seeds: Words from which the generator of each episode is made, for stochastic policies.
        limits: How long the server is waited for.
    """

    def __init__(
        self,
        address: str,
        announced: Mapping[str, Any],
        episodes: Sequence[EpisodeStart],
        seeds: Sequence[Sequence[int]],
        limits: Limits,
    ):
        self._address, self._limits = address, limits
        self._names = [key.removeprefix(PREFIX) for key in announced["observation"]]
        self.views = tuple(name for name in self._names if name.endswith("_rgb"))
        self.action_dim = int(announced["actions"]["shape"][-1])
        self._first = {
            "prompt": episodes[0].task.language,
            "task": episodes[0].task.id,
            "reset": True,
            "seed": [list(words) for words in seeds],
        }
        task = episodes[0].task
        if task.suite == "file":  # the server does not have it
            del self._first["task"]
        elif task.language != get_task(task.id).language:
            self._first["instruction"] = self._first.pop("prompt")
        self._begun = False
        self._loop = LoopThread()
        self._connection: Connection | None = None

    def reset(self, num_envs: int) -> None:
        """Let the next request begin the episodes; see `lifelong.evaluation.actors.Actor`."""
        self._begun = False
        if self._connection is None:
            self._connection = self._loop.run(self._connect())

    def act(self, obs: Obs) -> np.ndarray:
        """Return (B, 7) float64 actions.

        Raises:
            ServerError: The server fails, is too late, or its actions are not valid.
            ConnectionLost: The connection breaks.
        """
        request: dict[str, Any] = {PREFIX + name: np.asarray(obs[name]) for name in self._names}
        if not self._begun:
            request |= self._first
        answer = self._loop.run(self._ask(request))
        self._begun = True
        count = len(next(iter(obs.values())))
        actions = answer.get("actions")
        expected = (count, 1, self.action_dim)
        if not isinstance(actions, np.ndarray) or actions.dtype.kind != "f" or actions.shape != expected:
            came = f"{actions.dtype} {actions.shape}" if isinstance(actions, np.ndarray) else repr(actions)
            raise ServerError(f"{self._address} sent as actions {came}; expected floats of shape {expected}")
        if not np.isfinite(actions).all():
            raise ServerError(f"{self._address} sent actions that are not finite")
        return actions[:, 0].astype(np.float64)

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._loop.run(self._connection.close())
            self._connection = None
        self._loop.close()

    async def _connect(self) -> Connection:
        connection = await connect(self._address, OPENPI, self._limits)
        await OpenpiDialect().greet(connection)
        return connection

    async def _ask(self, request: dict[str, Any]) -> Mapping[str, Any]:
        assert self._connection is not None, "reset was called"
        await self._connection.send(request)
        return await OpenpiDialect().receive(self._connection)
