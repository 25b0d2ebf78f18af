"""A policy on a server, as `libero eval` evaluates it."""

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from libero_env.errors import UnknownNameError
from libero_env.tasks import Task, get_task
from lifelong.data.settings import CAMERAS
from lifelong.errors import ServerError
from lifelong.evaluation.actors import Actor
from lifelong.evaluation.adapter import CardAdapter
from lifelong.evaluation.candidates import ROLLOUT, PolicyUnderTest, make_env, run_protocol
from lifelong.evaluation.card import Card
from lifelong.evaluation.environments import VectorEnv
from lifelong.evaluation.protocols import SELECTION
from lifelong.evaluation.servers.actor import RemoteActor
from lifelong.evaluation.servers.announcements import groot_fields, openpi_fields, vla_eval_fields
from lifelong.evaluation.servers.connections import Limits
from lifelong.evaluation.servers.groot import GrootWire
from lifelong.evaluation.servers.native import ServedActor
from lifelong.evaluation.servers.sessions import FORMAT, PREFIX, SERVER
from lifelong.evaluation.servers.wires import (
    EpisodeStart,
    OpenpiDialect,
    VlaEvalDialect,
    WebSocketWire,
    Wire,
    plain,
)

# scheme of an address -> scheme of the transport, and what the server's announcement says about the protocol
SCHEMES = {
    "ws": ("ws", openpi_fields),
    "wss": ("wss", openpi_fields),
    "vla-eval": ("ws", vla_eval_fields),
    "gr00t": ("tcp", groot_fields),
}


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
        """Return the protocol, after what the server announces has been compared with it; see `PolicyUnderTest`.

        Of a served run it is the one that the run has in process.

        Raises:
            ProtocolMismatchError: The server's policy was made for another protocol.
        """
        if self.own:
            horizon, settle_steps = self.announced["horizon"], self.announced["settle_steps"]
            return run_protocol(base, self._image_size(), horizon, settle_steps)
        scheme = self.args.policy.partition("://")[0]
        base.check(SCHEMES[scheme][1](self.announced))
        return base

    def env(self, task: Task, count: int, protocol: Card) -> VectorEnv:
        """Build the environment of a task; see `PolicyUnderTest`."""
        cameras = tuple(CAMERAS[view] for view in self._views()) if self.own else None
        drawing = None if self.own else "protocol"
        threads, assets = self.args.threads, self.args.assets
        return make_env(
            task, count, protocol, cameras=cameras, threads=threads, assets=assets, drawing=drawing
        )

    @contextmanager
    def actor(self, task: Task, states: Sequence[int], protocol: Card) -> Iterator[Actor]:
        """Yield the actor of episodes, with connections of its own; see `PolicyUnderTest`."""
        episodes = [EpisodeStart(task, state) for state in states]
        if not self.own:
            views = tuple(f"{camera.removeprefix('robot0_')}_rgb" for camera in protocol.pixels.cameras)
            wire = self._wire()
            try:
                adapter = CardAdapter(protocol, task)
                yield RemoteActor(wire, adapter, episodes, views=views, replan=protocol.action.replan)
            finally:
                wire.close()
            return
        seeds = [(self.args.seed, ROLLOUT, task.index, state) for state in states]
        served = ServedActor(self.args.policy, self.announced, episodes, seeds, self.limits)
        try:
            yield served
        finally:
            served.close()

    def _wire(self) -> Wire:
        scheme, found, rest = self.args.policy.partition("://")
        if not found or scheme not in SCHEMES:
            raise UnknownNameError("kind of server", scheme, SCHEMES)
        address = f"{SCHEMES[scheme][0]}://{rest}"
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
