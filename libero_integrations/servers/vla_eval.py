"""vla-eval's model server as a client: hello both ways, episodes with start and end, numbered messages.

Source: vla-eval 0.8.0, `vla_eval/protocol`, `vla_eval/connection.py` and `vla_eval/benchmarks/libero/benchmark.py`.
"""

import io
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image
from pydantic import with_config
from typing_extensions import TypedDict

from libero_env.text import plain, shown
from libero_env.validation import validate
from libero_eval.protocols.adapter import PolicyInput
from libero_eval.servers.codec import Codec, array_of, ending, refuse
from libero_eval.servers.transport import Connection, EpisodeStart, WebSocketClient
from lifelong.errors import ProtocolMismatchError, ServerError

VERSION = "0.8.0"  # of the harness whose messages these are
# Formats that vla-eval's own LIBERO benchmark takes, get_action_spec; `raw` stands for no convention
_ACTIONS = {
    "position": ("delta_xyz", "raw"),
    "rotation": ("axis_angle", "raw"),
    "gripper": ("binary_close_positive", "raw"),
}
# `observation_params` are arguments of that benchmark
_FIELDS = {
    "seed": "world.env_seed",
    "env_seed": "world.env_seed",  # goes before `seed`
    "num_steps_wait": "episode.settle_steps",
    "max_steps": "episode.horizon",
}
MAX_PIXELS = 1 << 22


@with_config(extra="allow")
class _Params(TypedDict, total=False):
    seed: int | None
    env_seed: int | None
    num_steps_wait: int | None
    max_steps: int | None
    absolute_action: bool | None
    quat_no_antipodal: bool | None
    send_state: bool | None
    send_wrist_image: bool | None


@with_config(extra="allow")
class _Spec(TypedDict, total=False):
    format: str | None


@with_config(extra="allow")
class _Hello(TypedDict, total=False):
    """What a server says about itself, as far as it matters here."""

    action_spec: dict[str, _Spec] | None
    observation_params: _Params | None


def _encode(value: np.ndarray | np.generic) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if value.dtype.kind not in "biuf":
        raise ValueError(f"dtype {value.dtype} is refused; valid: bool, integers, floats")
    # vla-eval sends images of one channel as PNG too, which Pillow does not take
    if value.dtype == np.uint8 and value.ndim == 3 and value.shape[2] in (3, 4):
        file = io.BytesIO()
        Image.fromarray(value).save(file, format="PNG")
        return {"__image__": True, "format": "png", "data": file.getvalue(), "shape": list(value.shape)}
    data = {"data": value.tobytes(), "dtype": value.dtype.str, "shape": list(value.shape)}
    return {"__ndarray__": True, **data}


def _decode(values: Mapping) -> Any:
    if "__image__" in values and values["format"] != "raw":
        image = Image.open(io.BytesIO(values["data"]), formats=["PNG"])  # other formats start other programs
        if [image.height, image.width] != values["shape"][:2] or image.width * image.height > MAX_PIXELS:
            raise ValueError(f"an image of {image.height} x {image.width} for shape {values['shape']}")
        return np.array(image)
    if "__image__" in values or "__ndarray__" in values:
        refuse(np.dtype(values["dtype"]), "SUMm")
        return array_of(values["data"], values["dtype"], values["shape"])
    return values


VLA_EVAL = Codec("vla-eval", _encode, _decode)


class VlaEvalClient(WebSocketClient):
    """vla-eval's model server, version 1 of its messages."""

    codec, needs_replan = VLA_EVAL, False

    @staticmethod
    def stated(announced: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a hello says: formats of actions, and parameters of the observations.

        Raises:
            ProtocolMismatchError: The server's actions have another format than those of vla-eval's LIBERO benchmark.
        """
        wrong = [
            f"action_spec {name}: LIBERO takes {_ACTIONS[name][0]}, the server sends {spec.get('format')}"
            for name, spec in (announced.get("action_spec") or {}).items()
            if name in _ACTIONS and spec.get("format") not in _ACTIONS[name]
        ]
        if wrong:
            raise ProtocolMismatchError(
                "the policy was made for another convention; nothing was run. " + "; ".join(wrong)
            )
        params = announced.get("observation_params") or {}
        values = {field: params[name] for name, field in _FIELDS.items() if params.get(name) is not None}
        if params.get("absolute_action") is not None:
            values["world.delta"] = not params["absolute_action"]
        if params.get("send_state") and "quat_no_antipodal" in params:
            rotation = "axis_angle" if params["quat_no_antipodal"] else "axis_angle_positive"
            values["proprioception.rotation"] = rotation
        return values

    def greet(self, connection: Connection) -> Mapping[str, Any]:
        """Exchange hellos and return the server's."""
        hello = {"harness_version": VERSION, "protocol_version": 1, "benchmark": "libero"}
        self._send(connection, "hello", hello)
        said = plain(self._receive(connection, "hello"))
        return validate(_Hello, said, source=f"{connection.address}'s hello", error=ServerError)

    def begin(self, connection: Connection, episode: EpisodeStart) -> None:
        """Send the start of an episode with the task, as the harness does; the server does not answer."""
        task = episode.task
        about = {
            "name": task.language,
            "suite": task.suite,
            "task_id": task.index,
            "episode_idx": episode.init_state,
        }
        self._send(connection, "episode_start", {"task": about})

    def send(self, connection: Connection, given: PolicyInput) -> None:
        """Send an observation with what the server's hello asks for."""
        wanted = self.announced.get("observation_params") or {}
        images = {"agentview": self.image(given, "agentview")}
        if wanted.get("send_wrist_image"):
            images["wrist"] = self.image(given, "robot0_eye_in_hand")
        observation: dict[str, Any] = {"images": images, "task_description": given.prompt}
        if wanted.get("send_state"):
            if not given.state.size:
                raise ServerError(
                    f"{self.address} needs the state; the protocol has none (proprioception.source)"
                )
            observation |= {"states": given.state, **given.extra}
        self._send(connection, "observation", observation)

    def receive(self, connection: Connection) -> Mapping[str, Any]:
        """Return the server's answer to an observation."""
        answer = self._receive(connection, "action")
        return {"actions": answer["action"]} if "action" in answer and "actions" not in answer else answer

    def end(self, connection: Connection, outcome: Mapping[str, Any]) -> None:
        """Send the outcome of the episode."""
        self._send(connection, "episode_end", dict(outcome))

    def _send(self, connection: Connection, kind: str, payload: dict[str, Any]) -> None:
        message = {"type": kind, "payload": payload, "seq": connection.sent + 1, "timestamp": time.time()}
        connection.send(message)

    def _receive(self, connection: Connection, kind: str) -> Mapping[str, Any]:
        """Return the payload of the answer to the last message.

        Raises:
            ServerError: The server failed, or sent something else.
        """
        message = connection.receive_map(kind)
        lacking = [key for key in ("type", "payload", "seq") if key not in message]
        if lacking:
            raise ServerError(f"{connection.address} sent a message without {', '.join(lacking)}")
        if message["type"] == "error":
            payload = message["payload"]
            text = payload.get("error", payload) if isinstance(payload, Mapping) else payload
            raise ServerError(f"{connection.address} failed: {ending(text)}")
        if message["type"] != kind or message["seq"] != connection.sent:
            raise ServerError(
                f"{connection.address} sent {shown(message['type'])} with seq {shown(message['seq'])}; expected "
                f"{kind} with {connection.sent}"
            )
        return connection.as_map(message["payload"], f"payload of {kind}")
