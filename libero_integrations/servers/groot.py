"""GR00T's policy server as a client: ZeroMQ, one request at a time, each with the observations of many simulations.

Sources: Isaac-GR00T `gr00t/policy/server_client.py` (messages), `gr00t/policy/gr00t_policy.py` (the flat names of
`Gr00tSimPolicyWrapper`), `gr00t/eval/sim/LIBERO/libero_env.py` (LIBERO's keys).
"""

import io
import os
import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import Field, with_config
from typing_extensions import TypedDict

from libero_env.text import shorten, shown
from libero_env.validation import validate
from libero_eval.protocols.adapter import PolicyInput
from libero_eval.servers.codec import Codec, ending, refuse
from libero_eval.servers.transport import API_KEY, MAX_MESSAGE_BYTES, EpisodeStart, Limits, PolicyClient, need
from lifelong.errors import CodecError, ServerError

VIDEO = {"image": "agentview", "wrist_image": "robot0_eye_in_hand"}  # key -> camera
ACTION = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
# key -> part of the state; roll, pitch and yaw are a rotation vector, as in their environment
STATE = {key: slice(i, i + 1) for i, key in enumerate(ACTION)} | {"gripper": slice(6, 8)}
PROMPT = "annotation.human.action.task_description"
_KEYS = {"video": tuple(VIDEO), "state": tuple(STATE), "action": ACTION, "language": (PROMPT,)}


def _encode(value: np.ndarray | np.generic) -> Any:
    refuse(value.dtype, "VO")
    if isinstance(value, np.generic):
        return value.item()
    file = io.BytesIO()
    np.save(file, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _decode(values: Mapping) -> Any:
    if "__ndarray_class__" in values:
        return np.load(io.BytesIO(values["as_npy"]), allow_pickle=False)
    if "__ModalityConfig_class__" in values:
        return values["as_json"]
    return values


GROOT = Codec("GR00T", _encode, _decode)


@with_config(extra="allow")
class _Modality(TypedDict, total=False):
    """What a server says about a modality, as far as it matters here."""

    modality_keys: Annotated[list[str], Field(max_length=100)]
    delta_indices: Annotated[list[int], Field(max_length=1000)] | None


class GrootClient(PolicyClient):
    """A GR00T server; its modality configuration is what it announces.

    It must have been started with `--use-sim-policy-wrapper`, as GR00T's own evaluation on LIBERO does. One request
    has the observations of at most `limits.in_flight` simulations; the server computes them together. The environment
    variable `LIBERO_API_KEY` is sent as `api_token`.

    Args:
        address: URL of the server, `tcp://host:port`.
        limits: How long the server is waited for.

    Raises:
        ServerError: The server is not there, or serves a policy of another embodiment.
    """

    codec = GROOT

    def __init__(self, address: str, limits: Limits = Limits()):  # noqa: B008 - frozen
        self.address, self.limits = address, limits
        self._zmq, _ = need("zmq"), need("msgpack")  # before anything is connected
        self._context = self._zmq.Context()
        self._socket: Any = None
        try:
            self._wait()
            self.announced = self._modalities()
        except BaseException:
            self.close()
            raise

    @staticmethod
    def stated(announced: Mapping[str, Any]) -> dict[str, Any]:
        """Return the order of the state, by which its parts are sent, and the number of actions of a chunk."""
        steps = announced["action"].get("delta_indices")
        state = {
            "proprioception.source": "observation",
            "proprioception.order": ["ee_pos", "ee_rotation", "gripper_qpos"],
        }
        return state | ({"action.chunk": len(steps)} if steps else {})

    def open(self, episodes: Sequence[EpisodeStart]) -> None:
        """Reset the policy; see `PolicyClient`. The server knows no single episodes."""
        self._call("reset", {"options": None})

    def ask(self, inputs: Mapping[int, PolicyInput]) -> dict[int, Any]:
        """Return the predicted actions, unchecked; see `PolicyClient`."""
        actions: dict[int, Any] = {}
        order = sorted(inputs)
        size = self.limits.in_flight or len(order) or 1
        for start in range(0, len(order), size):
            rows = order[start : start + size]
            observation = self._observation([inputs[i] for i in rows])
            answer = self._call("get_action", {"observation": observation, "options": None})
            actions |= dict(zip(rows, self._actions(answer, len(rows)), strict=True))
        return actions

    def finish(self, simulation: int, success: bool) -> None:
        """Do nothing: the protocol has no message for it; see `PolicyClient`."""

    def close(self) -> None:
        """Close the socket."""
        self._drop()
        self._context.term()

    def _wait(self) -> None:
        """Wait until the server answers a ping."""
        started = time.monotonic()
        while True:
            left = started + self.limits.connect - time.monotonic()
            try:
                self._call("ping", seconds=max(0.1, min(left, 2.0)))
                return
            except ServerError as error:
                if left > 0 and isinstance(error.__cause__, self._zmq.Again):
                    continue
                if not isinstance(error.__cause__, self._zmq.Again):
                    raise
                raise ServerError(
                    f"no GR00T server at {self.address} within {self.limits.connect:g} s"
                ) from error

    def _modalities(self) -> dict[str, Any]:
        where = f"{self.address}'s modality configuration"
        modalities = validate(
            dict[str, _Modality], self._call("get_modality_config"), source=where, error=ServerError
        )
        for modality, valid in _KEYS.items():
            config = modalities.get(modality, {})
            keys, steps = config.get("modality_keys"), config.get("delta_indices")
            if not keys or not set(keys) <= set(valid):
                raise ServerError(
                    f"{self.address} has {modality} keys {shown(keys)}; LIBERO's are {', '.join(valid)}: "
                    "serve a policy of the embodiment libero_sim"
                )
            if modality in ("video", "state") and steps != [0]:
                raise ServerError(f"{self.address} wants {modality} of the steps {shown(steps)}; valid: [0]")
        return modalities

    def _observation(self, inputs: Sequence[PolicyInput]) -> dict[str, Any]:
        """Return GR00T's observation: images (B, 1, H, W, 3), parts of the state (B, 1, D), instructions."""
        keys = {modality: self.announced[modality]["modality_keys"] for modality in _KEYS}
        observation: dict[str, Any] = {
            f"video.{key}": np.stack([self.image(given, VIDEO[key]) for given in inputs])[:, None]
            for key in keys["video"]
        }
        states = np.stack([given.state for given in inputs]).astype(np.float32)[:, None]
        if states.shape[-1] != STATE["gripper"].stop:
            raise ServerError(
                f"{self.address} takes a rotation vector, and the state has {states.shape[-1]} numbers; "
                "proprioception.rotation: axis_angle in the protocol"
            )
        observation |= {f"state.{key}": states[..., STATE[key]] for key in keys["state"]}
        return observation | {key: [given.prompt for given in inputs] for key in keys["language"]}

    def _actions(self, answer: Any, count: int) -> np.ndarray:
        """Return the actions (B, H, 7) of an answer, which is a list of actions by key and of further data."""
        actions = answer[0] if isinstance(answer, list | tuple) and answer else None
        actions = actions if isinstance(actions, Mapping) else {}
        if lacking := [key for key in ACTION if f"action.{key}" not in actions]:
            came = shorten(str(sorted(map(str, actions)))) if actions else type(answer).__name__
            raise ServerError(
                f"{self.address} answered {came} without {', '.join(f'action.{k}' for k in lacking)}; start it with "
                "--use-sim-policy-wrapper"
            )
        try:
            parts = [np.asarray(actions[f"action.{key}"]) for key in ACTION]
        except ValueError as error:
            raise ServerError(f"{self.address} sent actions that are not arrays ({error})") from error
        shapes = sorted({part.shape for part in parts})
        if len(shapes) > 1 or len(shapes[0]) != 3 or (shapes[0][0], shapes[0][2]) != (count, 1):
            raise ServerError(
                f"{self.address} sent actions of shapes {shapes}; expected ({count}, H, 1) each"
            )
        return np.concatenate(parts, axis=-1)

    def _call(self, endpoint: str, data: Any = None, seconds: float | None = None) -> Any:
        """Return the answer of an endpoint.

        Raises:
            ServerError: It fails, is too late, or sends something else.
        """
        seconds = self.limits.answer if seconds is None else seconds
        request = {"endpoint": endpoint} | ({} if data is None else {"data": data})
        if key := os.environ.get(API_KEY):
            request["api_token"] = key
        socket = self._connected()
        for limit in (self._zmq.RCVTIMEO, self._zmq.SNDTIMEO):
            socket.setsockopt(limit, max(1, round(1000 * seconds)))
        try:
            socket.send(GROOT.pack(request))
            answer = GROOT.unpack(socket.recv())
        except self._zmq.Again as error:
            self._drop()  # a REQ socket sends nothing more before the answer
            raise ServerError(
                f"{self.address} sent nothing within {seconds:g} s ({endpoint}); --timeout sets the limit"
            ) from error
        except CodecError as error:
            raise ServerError(f"{self.address} sent {error} ({endpoint})") from error
        except BaseException:
            self._drop()
            raise
        if isinstance(answer, Mapping) and "error" in answer:
            said = ending(answer["error"])
            hint = "; start it with --use-sim-policy-wrapper" if "must contain a" in said else ""
            raise ServerError(f"{self.address} failed ({endpoint}): {said}{hint}")
        return answer

    def _connected(self) -> Any:
        if self._socket is None:
            self._socket = self._context.socket(self._zmq.REQ)
            self._socket.setsockopt(self._zmq.LINGER, 0)
            self._socket.setsockopt(self._zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
            self._socket.connect(self.address)
        return self._socket

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
