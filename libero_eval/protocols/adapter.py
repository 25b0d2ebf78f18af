"""What a policy is given under a protocol, and what its answers mean."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from libero_env.geometry import quat_multiply
from libero_env.images import flip_rows, rotate_180
from libero_env.sim.observations import image_name
from libero_env.tasks import Task
from libero_eval.protocols.preprocessing import preprocess
from libero_eval.protocols.protocol import EvalProtocol
from lifelong.evaluation.actors import Obs

ACTION_DIM = 7
_HAND_TO_GRIP = np.array([[np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)]])  # wxyz


@dataclass(frozen=True)
class PolicyInput:
    """Observation of one simulation, as a protocol defines it.

    Attributes:
        images: Image of each camera by the original's name, `agentview` or `robot0_eye_in_hand`: (H, W, 3) uint8, after
            the protocol's turning, resizing and cropping.
        state: Proprioception in the protocol's order, rotation convention and dtype, (8,) in most protocols.
        prompt: Instruction, after the protocol's template.
        extra: Further vectors by name: `controller_states`, as vla-eval reads them from the controller, the state with
            the rotation of the grip site, which is turned by -90 degrees about the hand's z axis, (8,) float32.
    """

    images: Mapping[str, np.ndarray]
    state: np.ndarray
    prompt: str
    extra: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class ProtocolAdapter:
    """Converts observations of simulations to a protocol's inputs, and predicted actions to the simulations' own.

    It keeps no state, so that episodes do not depend on each other.

    Attributes:
        protocol: The protocol.
        task: Task whose instruction is given.
    """

    protocol: EvalProtocol
    task: Task

    def inputs(self, obs: Obs, rows: Sequence[int] | None = None) -> list[PolicyInput]:
        """Return the inputs of some simulations.

        Args:
            obs: (B, ...) arrays by name, with images of the protocol's cameras, `ee_pos`, `ee_quat` and
                `gripper_states`.
            rows: Indices of the simulations; by default all.
        """
        rows = range(len(next(iter(obs.values())))) if rows is None else rows
        prompt = self.protocol.prompt(self.task)
        return [
            PolicyInput(self._images(obs, i), self._state(obs, i), prompt, self._extra(obs, i)) for i in rows
        ]

    def actions(self, predicted: np.ndarray) -> np.ndarray:
        """Return the simulations' actions, (..., 7) float64; the gripper opens at -1 and closes at +1.

        Args:
            predicted: (..., 7) finite actions of a policy in the protocol's convention.
        """
        actions = np.array(predicted, np.float64)
        gripper = self.protocol.action.gripper or "as_predicted"
        actions[..., -1] = GRIPPERS[gripper](np.asarray(predicted)[..., -1])
        return actions

    def _images(self, obs: Obs, i: int) -> dict[str, np.ndarray]:
        pixels, images = self.protocol.pixels, dict[str, np.ndarray]()
        for camera in pixels.cameras:
            image = np.asarray(obs[view_of(camera)][i])
            if pixels.orientation == "bottom_up":
                image = flip_rows(image)
            elif pixels.orientation == "rotated":
                image = rotate_180(flip_rows(image))
            crop = 1.0 if pixels.crop is None else pixels.crop
            images[camera] = preprocess(image, pixels.resize or "none", pixels.resize_size, crop)
        return images

    def _state(self, obs: Obs, i: int) -> np.ndarray:
        rules = self.protocol.proprioception
        if rules.source != "observation":
            return np.zeros(0)
        quat = np.roll(np.asarray(obs["ee_quat"][i], np.float64), -1)  # wxyz -> xyzw
        parts = {
            "ee_pos": np.asarray(obs["ee_pos"][i], np.float64),
            "ee_rotation": ROTATIONS[rules.rotation or "quat_xyzw"](quat),
            "gripper_qpos": np.asarray(obs["gripper_states"][i], np.float64),
        }
        return np.concatenate([parts[name] for name in rules.order or ()]).astype(rules.dtype or "float64")

    def _extra(self, obs: Obs, i: int) -> dict[str, np.ndarray]:
        if self.protocol.proprioception.source != "observation":
            return {}
        hand = np.asarray(obs["ee_quat"][i], np.float64)
        rotation = axis_angle_positive(np.roll(quat_multiply(hand[None], _HAND_TO_GRIP)[0], -1))
        parts = (obs["ee_pos"][i], rotation, obs["gripper_states"][i])
        return {"controller_states": np.concatenate(parts).astype(np.float32)}


def view_of(camera: str) -> str:
    """Return the name of the observed image of a camera."""
    return image_name(camera, "rgb")


def axis_angle(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return axis times angle, (3,) rad, as robosuite's `quat2axisangle`: a quaternion and its negative differ.

    Args:
        quat_xyzw: Unit quaternion, (4,).
    """
    w = min(max(quat_xyzw[3], -1.0), 1.0)
    length = np.sqrt(1.0 - w * w)
    if math.isclose(length, 0.0):
        return np.zeros(3)
    return (quat_xyzw[:3] * 2.0 * math.acos(w)) / length


def axis_angle_float32(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return `axis_angle` computed in single precision, as LeRobot's `LiberoProcessorStep`, (3,) float32."""
    quat = quat_xyzw.astype(np.float32)
    w = np.clip(quat[3], np.float32(-1), np.float32(1))
    length = np.sqrt(np.clip(np.float32(1) - w * w, np.float32(0), None))
    if length <= 1e-10:
        return np.zeros(3, np.float32)
    return (quat[:3] / length) * (np.float32(2) * np.arccos(w))


def axis_angle_positive(quat_xyzw: np.ndarray) -> np.ndarray:
    """Return axis times angle of the quaternion with w >= 0, (3,) float32, as vla-eval's `quat_to_axisangle`."""
    quat = -quat_xyzw if quat_xyzw[3] < 0 else quat_xyzw
    w = float(np.clip(quat[3], -1.0, 1.0))
    length = np.sqrt(1.0 - w * w)
    if length < 1e-8:
        return np.zeros(3, np.float32)
    return (quat[:3] / length * (2.0 * np.arccos(w))).astype(np.float32)


ROTATIONS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "axis_angle": axis_angle,
    "axis_angle_float32": axis_angle_float32,
    "axis_angle_positive": axis_angle_positive,
    "quat_xyzw": lambda quat: quat,
}
# Predicted gripper -> -1 opens, +1 closes
GRIPPERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as_predicted": lambda x: x,
    "sign": lambda x: np.where(x < 0, -1.0, 1.0),  # vla-eval
    "open_sign": lambda x: -np.sign(2 * x - 1),  # OpenVLA: 1 is open
    "open_cut": lambda x: 1.0 - 2.0 * (x > 0.5),  # starVLA: 1 is open
}
