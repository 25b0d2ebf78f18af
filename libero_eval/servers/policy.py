"""A policy on a server, as `libero eval` evaluates it."""

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import urlsplit

from libero_env.errors import UnknownNameError
from libero_env.tasks import Task, get_task
from libero_eval.candidates import PolicyUnderTest
from libero_eval.protocols.adapter import CardAdapter
from libero_eval.protocols.environment import make_env, run_protocol
from libero_eval.protocols.packaged import SELECTION
from libero_eval.protocols.protocol import Card
from libero_eval.servers.actor import RemoteActor
from libero_eval.servers.announcements import groot_fields, openpi_fields, vla_eval_fields
from libero_eval.servers.connections import Limits
from libero_eval.servers.groot import GrootWire
from libero_eval.servers.native import ServedActor
from libero_eval.servers.sessions import FORMAT, PREFIX, SERVER
from libero_eval.servers.wires import (
    EpisodeStart,
    OpenpiDialect,
    VlaEvalDialect,
    WebSocketWire,
    Wire,
    plain,
    same,
    summary,
)
from lifelong.data.settings import CAMERAS
from lifelong.errors import ProtocolError, ServerError
from lifelong.evaluation.actors import Actor
from lifelong.evaluation.environments import VectorEnv
from lifelong.seeding import EVALUATION

# scheme of an address -> scheme of the transport, and what the server's announcement says about the protocol
SCHEMES = {
    "ws": ("ws", openpi_fields),
    "wss": ("wss", openpi_fields),
    "vla-eval": ("ws", vla_eval_fields),
    "gr00t": ("tcp", groot_fields),
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
        raise ServerError(f"{given} is no address; write {scheme}://host:port, the port from 1 to 65535")
    return url


class ServerPolicy(PolicyUnderTest):
    """A policy on a server: openpi's (`ws://`), vla-eval's (`vla-eval://`), GR00T's (`gr00t://`), or `libero serve`'s.

    What the server announces is part of the policy's identity, and is compared with the protocol before anything runs.

    Args:
        args: Arguments of `libero eval`; `policy` is the address.

    Raises:
        ServerError: The server is not there, or is of another kind.
    """

    def __init__(self, args: argparse.Namespace):
        self.args = args
        self.limits = Limits(answer=args.timeout, in_flight=args.in_flight)
        wire = self._wire()
        self.announced = wire.announced
        wire.close()
        self.own = self.announced.get("server") == SERVER  # a policy of this package
        if self.own and self.announced.get("format") != FORMAT:
            raise ServerError(
                f"{args.policy} is of format {self.announced.get('format')!r}; this version knows {FORMAT}: "
                "serve the run with the version that evaluates it"
            )
        self.identity = {"server": args.policy, "announced": plain(self.announced)}
        self.out = Path("eval") / re.sub(r"\W+", "_", args.policy).strip("_")
        self.selection = tuple(self.announced["selection"]) if self.own else SELECTION
        self.tasks = tuple(self._tasks())

    def protocol(self, base: Card) -> Card:
        """Return the protocol; see `PolicyUnderTest`. Of a served run it is the one that the run has in process.

        Raises:
            ProtocolMismatchError: The server announces something else; the message names both values.
            ProtocolError: The protocol does not state how many actions are executed, and the server needs it.
        """
        if self.own:
            about = self.announced
            own = (about["horizon"], about["settle_steps"], about["robot"])
            drawing, assets = about.get("drawing"), self.args.assets
            return run_protocol(base, self._image_size(), *own, drawing=drawing, assets=assets)
        base.check(SCHEMES[self._scheme][1](self.announced))
        if base.action.replan is None and self._scheme != "vla-eval":
            raise ProtocolError(
                f"protocol {base.name} does not state action.replan, the number of actions that are executed of each "
                f"answer: write a card with `extends: {base.name}` that does, and give its path to --protocol"
            )
        return base

    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:
        """Build the environment of a task; see `PolicyUnderTest`."""
        if self.own:
            cameras = tuple(CAMERAS[view] for view in self._views())
            return make_env(task, count, protocol, cameras=cameras, **self.simulated)
        adapter = CardAdapter(protocol, task)
        return make_env(
            task,
            count,
            protocol,
            cameras=adapter.cameras,
            observations=adapter.observations,
            **self.simulated,
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> Iterator[Actor]:
        """Yield the actor of episodes, with connections of its own; see `PolicyUnderTest`.

        Raises:
            ServerError: The server is not there any more, or announces something else than at first.
        """
        episodes = [EpisodeStart(task, state) for state in states]
        if self.own:
            seeds = [(self.args.seed, EVALUATION, task.index, state) for state in states]
            served = ServedActor(self.args.policy, self.announced, episodes, seeds, self.limits)
            try:
                yield served
            finally:
                served.close()
            return
        wire = self._wire()
        try:
            if not same(wire.announced, self.announced):
                raise ServerError(
                    f"{self.args.policy} announces {summary(wire.announced)}, but at first "
                    f"{summary(self.announced)}: another policy is served there now; evaluate it by itself"
                )
            adapter = CardAdapter(protocol, task)
            views = tuple(f"{camera.removeprefix('robot0_')}_rgb" for camera in adapter.cameras)
            yield RemoteActor(wire, adapter, episodes, views=views, replan=protocol.action.replan)
        finally:
            wire.close()

    @property
    def _scheme(self) -> str:
        return self.args.policy.partition("://")[0]

    def _wire(self) -> Wire:
        scheme, found, rest = self.args.policy.partition("://")
        if not found or scheme not in SCHEMES:
            raise UnknownNameError("kind of server", scheme, SCHEMES)
        address = checked_address(f"{SCHEMES[scheme][0]}://{rest}", self.args.policy)
        if scheme == "gr00t":
            return GrootWire(address, self.limits)
        dialect = VlaEvalDialect() if scheme == "vla-eval" else OpenpiDialect()
        return WebSocketWire(address, dialect, self.limits)

    def _views(self) -> list[str]:
        names = [key.removeprefix(PREFIX) for key in self.announced["observation"]]
        return [name for name in names if name in CAMERAS]

    def _image_size(self) -> tuple[int, int]:
        height, width, _ = self.announced["observation"][PREFIX + self._views()[0]]["shape"]
        return height, width

    def _tasks(self) -> Iterator[Task]:
        """Yield the tasks of a served run that are tasks of the benchmark."""
        for name in self.announced["tasks"] if self.own else ():
            if not name.startswith("file/"):
                yield get_task(name)
