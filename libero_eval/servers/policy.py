"""A policy on a server, as `libero eval` evaluates it."""

import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from importlib import import_module
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from libero_env.errors import require_known
from libero_env.tasks import Task, get_task
from libero_eval.policies import PROBE_TOLERANCE, PolicyUnderTest
from libero_eval.protocols.adapter import ProtocolAdapter, view_of
from libero_eval.protocols.clock import Planner
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import Request
from libero_eval.servers.actors import RemoteActor, checked_actions
from libero_eval.servers.transport import EpisodeStart, Limits, PolicyClient
from lifelong.errors import ConfigError, ProtocolError, ServerError

# scheme of an address -> module and class of its client, scheme of its transport
CLIENTS = {
    "ws": ("libero_eval.servers.openpi", "OpenpiClient", "ws"),
    "wss": ("libero_eval.servers.openpi", "OpenpiClient", "wss"),
    "vla-eval": ("libero_integrations.servers.vla_eval", "VlaEvalClient", "ws"),
    "gr00t": ("libero_integrations.servers.groot", "GrootClient", "tcp"),
}
SERVER = "libero-lifelong"  # what `libero serve` announces
PROBED = {"ee_pos": 3, "gripper_states": 2}  # of the fixed observation: name -> size


def checked_address(url: str, given: str) -> str:
    """Return the URL of a server, if it is one.

    Args:
        url: URL with the scheme of the transport.
        given: The address as the user has written it.

    Raises:
        ServerError: It has no host, or a port that cannot be.
    """
    try:
        parts = urlsplit(url)
        valid = bool(parts.hostname) and parts.port != 0 and not re.search(r"[\s\x00-\x1f]", url)
        bare = parts.port is not None and not (parts.path or parts.query or parts.username)
        valid = valid and (parts.scheme != "tcp" or bare)
    except ValueError:  # a port out of range, half of an IPv6 address
        valid = False
    if not valid:
        scheme = given.partition("://")[0]
        raise ServerError(f"{given} is not an address; write {scheme}://host:port, the port from 1 to 65535")
    return url


class ServerPolicy(PolicyUnderTest):
    """A policy on a server: openpi's (`ws://`), vla-eval's (`vla-eval://`) or GR00T's (`gr00t://`).

    What the server announces is part of the policy's identity, and is compared with the protocol before anything runs.
    A server that announces neither `weights` nor `checkpoint` does not say which policy it serves: that must be named.

    Raises:
        UnknownNameError: The address is of no kind of server.
        ServerError: The server is not there, or is of another kind.
        ConfigError: Nothing says which policy it serves, or it is a run of this package.
    """

    def __init__(self, request: Request):
        super().__init__(request)
        self.given = given = request.policy_name
        with self._client() as client:
            self.announced, self._kind = client.announced, type(client)
        about = self.announced
        self.identity = {"server": given, "announced": about}
        self.place = Path(re.sub(r"\W+", "_", given).strip("_"))
        self._answer: np.ndarray | None = None
        if about.get("server") == SERVER:
            raise ConfigError(f"{given} serves a run of this package: libero eval RUN evaluates it as it is")
        if not (request.name or about.get("weights") or about.get("checkpoint")):
            raise ConfigError(
                f"{given} does not say which policy it serves, so another one there would go unnoticed: "
                "name it, such as --name pi0_step30000 (or let it announce `checkpoint`)"
            )

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol; see `PolicyUnderTest`.

        Raises:
            ProtocolMismatchError: The server announces something else; the message names both values.
            ProtocolError: The protocol does not state how many actions are executed, and the server needs it.
        """
        clock = base.action.clock if self.request.clock is None else self.request.clock
        if self.request.seed and not clock:  # whose latencies it draws
            raise ConfigError(
                f"--seed {self.request.seed}: {self.given} draws by itself, and is sent no seed; leave it out, and "
                "evaluate again with another --out"
            )
        base.check(self._kind.stated(self.announced))
        if base.action.replan is None and self._kind.needs_replan:
            raise ProtocolError(
                f"protocol {base.name} does not state action.replan, the number of actions that are executed of each "
                f"answer: write a file with `extends: {base.name}` that does, and give its path to --protocol"
            )
        return base

    def probe(self, protocol: EvalProtocol) -> tuple[float, ...] | None:
        """Return what the server answers to a fixed observation, if it answers so twice; see `PolicyUnderTest`."""
        if self._answer is None:
            with self._client() as client:
                first, second = self._ask(client, protocol), self._ask(client, protocol)
            self._answer = first if np.array_equal(first, second) else np.zeros(0)
        return tuple(self._answer.tolist()) or None

    def _ask(self, client: PolicyClient, protocol: EvalProtocol) -> np.ndarray:
        """Return the actions that a server answers to a fixed observation in a new episode, rounded."""
        task, draws = get_task("libero_goal/0"), np.random.default_rng(0)
        obs = {name: draws.uniform(-0.5, 0.5, (1, size)) for name, size in PROBED.items()}
        obs["ee_quat"] = np.array([[0.0, 1.0, 0.0, 0.0]])
        for camera in protocol.pixels.cameras:
            size = protocol.pixels.render_size or (128, 128)
            obs[view_of(camera)] = draws.integers(0, 256, (1, *size, 3), np.uint8)
        adapter, replan = ProtocolAdapter(protocol, task), protocol.action.replan
        client.open([EpisodeStart(task, 0)])
        answer = client.ask(dict(enumerate(adapter.inputs(obs))))[0]
        client.finish(0, success=False)
        return checked_actions(answer, replan, self.given)[: replan or 1].ravel().round(6)

    @contextmanager
    def planner(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Planner]:
        """Yield the planner of episodes, with connections of its own; see `PolicyUnderTest`.

        Raises:
            ServerError: The server is not there any more, or announces or answers something else than at first.
        """
        episodes = [EpisodeStart(task, state) for state in states]
        with self._client() as client:
            client.check_same(client.announced, self.announced)
            if self._answer is not None and self._answer.size:
                off = np.abs(self._ask(client, protocol) - self._answer).max()
                if off > PROBE_TOLERANCE:
                    raise ServerError(
                        f"{self.given} answers a fixed observation otherwise than at first, by up to {off:.3g}: "
                        "another policy is served there now; evaluate it by itself"
                    )
            views = tuple(map(view_of, protocol.pixels.cameras))
            adapter, replan = ProtocolAdapter(protocol, task), protocol.action.replan
            yield RemoteActor(client, adapter, episodes, views=views, replan=replan)

    @contextmanager
    def _client(self) -> Iterator[PolicyClient]:
        scheme, _, rest = self.given.partition("://")
        if scheme in ("http", "https"):
            raise ServerError(
                f"{self.given}: no kind of server has http; write {scheme.replace('http', 'ws')}://{rest}"
            )
        require_known("kind of server", scheme, CLIENTS)
        module, name, transport = CLIENTS[scheme]
        url = checked_address(f"{transport}://{rest}", self.given)
        limits = Limits(answer=self.request.timeout, in_flight=self.request.in_flight)
        with closing(getattr(import_module(module), name)(url, limits)) as client:
            yield client
