"""openpi's policy server as a client: metadata first, then an answer to each observation; text is a traceback.

Sources: openpi `src/openpi/serving/websocket_policy_server.py`, `examples/libero/main.py` and
`packages/openpi-client/src/openpi_client/msgpack_numpy.py`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from libero_eval.protocols.adapter import PolicyInput
from libero_eval.servers.codec import Codec, array_of, refuse
from libero_eval.servers.transport import Connection, WebSocketClient


def _encode(value: np.ndarray | np.generic) -> dict:
    refuse(value.dtype, "VOc")
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    data = {b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    return {b"__ndarray__": True, **data}


def _decode(values: Mapping) -> Any:
    if b"__ndarray__" in values:
        return array_of(values[b"data"], values[b"dtype"], values[b"shape"])
    if b"__npgeneric__" in values:
        kind = np.dtype(values[b"dtype"])
        refuse(kind, "VOc")
        return kind.type(values[b"data"])
    return values


OPENPI = Codec("openpi", _encode, _decode)


class OpenpiClient(WebSocketClient):
    """openpi's server. Nothing says that an episode begins; the connection is new."""

    codec = OPENPI

    @staticmethod
    def stated(announced: Mapping[str, Any]) -> dict[str, Any]:
        """Return the metadata; names of protocols, such as `action.replan`, are taken as they are."""
        return dict(announced)

    def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Return the metadata that the server sends first."""
        return connection.receive_map("metadata")

    def send(self, connection: Connection, given: PolicyInput) -> None:
        """Send an observation under openpi's names for LIBERO."""
        observation: dict[str, Any] = {
            "observation/image": self.image(given, "agentview"),
            "prompt": given.prompt,
        }
        if given.state.size:  # some protocols have none
            observation["observation/state"] = given.state
        if "robot0_eye_in_hand" in given.images:
            observation["observation/wrist_image"] = given.images["robot0_eye_in_hand"]
        connection.send(observation)

    def receive(self, connection: Connection) -> Mapping[str, Any]:
        """Return the server's answer to an observation."""
        return connection.receive_map("actions")
