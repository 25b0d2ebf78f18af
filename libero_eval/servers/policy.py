"""A policy on a server, as `libero eval` evaluates it."""

import re
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from libero_env.errors import UnknownNameError
from libero_env.tasks import Task, get_task
from libero_env.text import plain
from libero_eval.policies import PolicyUnderTest
from libero_eval.protocols.adapter import ProtocolAdapter, view_of
from libero_eval.protocols.environment import run_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import Request
from libero_eval.servers.actors import RemoteActor, ServedActor
from libero_eval.servers.groot import GrootClient
from libero_eval.servers.openpi import OpenpiClient
from libero_eval.servers.serving import FORMAT, PREFIX, SERVER
from libero_eval.servers.transport import EpisodeStart, Limits, PolicyClient
from libero_eval.servers.vla_eval import VlaEvalClient
from lifelong.data.settings import CAMERAS
from lifelong.errors import ProtocolError, ServerError
from lifelong.evaluation.actors import Actor

# scheme of an address -> kind of server, scheme of its transport
CLIENTS: dict[str, tuple[Any, str]] = {
    "ws": (OpenpiClient, "ws"),
    "wss": (OpenpiClient, "wss"),
    "vla-eval": (VlaEvalClient, "ws"),
    "gr00t": (GrootClient, "tcp"),
}


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
        valid = valid and (parts.scheme != "tcp" or parts.port is not None)
    except ValueError:  # a port out of range, half of an IPv6 address
        valid = False
    if not valid:
        scheme = given.partition("://")[0]
        raise ServerError(f"{given} is not an address; write {scheme}://host:port, the port from 1 to 65535")
    return url


class ServerPolicy(PolicyUnderTest):
    """A policy on a server: openpi's (`ws://`), vla-eval's (`vla-eval://`), GR00T's (`gr00t://`), or `libero serve`'s.

    What the server announces is part of the policy's identity, and is compared with the protocol before anything runs.

    Raises:
        UnknownNameError: The address is of no kind of server.
        ServerError: The server is not there, or is of another kind.
    """

    def __init__(self, request: Request):
        super().__init__(request)
        self.given = given = request.policy_name
        with self._client() as client:
            self.announced, self._kind = client.announced, type(client)
        about = self.announced
        self.is_run = about.get("server") == SERVER  # a policy of this package
        if self.is_run and about.get("format") != FORMAT:
            raise ServerError(
                f"{given} is of format {about.get('format')!r}; this version reads {FORMAT}: "
                "serve the run with the version that evaluates it"
            )
        self.identity = {"server": given, "announced": plain(about)}
        self.out = Path("eval") / re.sub(r"\W+", "_", given).strip("_")
        if self.is_run:
            self.selection = tuple(about["selection"])
            self.tasks = tuple(get_task(name) for name in about["tasks"] if not name.startswith("file/"))
            names = [key.removeprefix(PREFIX) for key in about["observation"]]
            self._views = [name for name in names if name in CAMERAS]
            self.cameras = tuple(CAMERAS[view] for view in self._views)

    def protocol(self, base: EvalProtocol) -> EvalProtocol:
        """Return the protocol; see `PolicyUnderTest`. Of a served run it is the one that the run has in process.

        Raises:
            ProtocolMismatchError: The server announces something else; the message names both values.
            ProtocolError: The protocol does not state how many actions are executed, and the server needs it.
        """
        about = self.announced
        if self.is_run:
            return run_protocol(
                base,
                tuple(about["observation"][PREFIX + self._views[0]]["shape"][:2]),
                about["horizon"],
                about["settle_steps"],
                about["robot"],
                drawing=about.get("drawing"),
                assets=self.request.assets,
            )
        base.check(self._kind.stated(about))
        if base.action.replan is None and self._kind is not VlaEvalClient:
            raise ProtocolError(
                f"protocol {base.name} does not state action.replan, the number of actions that are executed of each "
                f"answer: write a file with `extends: {base.name}` that does, and give its path to --protocol"
            )
        return base

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: EvalProtocol) -> Iterator[Actor]:
        """Yield the actor of episodes, with connections of its own; see `PolicyUnderTest`.

        Raises:
            ServerError: The server is not there any more, or announces something else than at first.
        """
        episodes = [EpisodeStart(task, state) for state in states]
        with self._client() as client:
            client.check_same(client.announced, self.announced)
            if self.is_run:
                assert isinstance(client, OpenpiClient)
                yield ServedActor(client, self.announced, episodes, self.seeds(task, states))
            else:
                views = tuple(map(view_of, protocol.pixels.cameras))
                adapter, replan = ProtocolAdapter(protocol, task), protocol.action.replan
                yield RemoteActor(client, adapter, episodes, views=views, replan=replan)

    @contextmanager
    def _client(self) -> Iterator[PolicyClient]:
        scheme, separator, rest = self.given.partition("://")
        if not separator or scheme not in CLIENTS:
            raise UnknownNameError("kind of server", scheme, CLIENTS)
        kind, transport = CLIENTS[scheme]
        limits = Limits(answer=self.request.timeout, in_flight=self.request.in_flight)
        with closing(kind(checked_address(f"{transport}://{rest}", self.given), limits)) as client:
            yield client
