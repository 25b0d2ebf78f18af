"""Kinds that change what is observed (noise, blur, late and lost pictures, a biased sensor), and what is executed."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageFilter

from libero_env.geometry import quat_from_axis_angle, quat_multiply, quat_to_axis_angle
from libero_env.perturbations.kinds import ActionFilter, Episode, ObservationFilter, direction, sign

_BLUR_HEIGHT = 128  # [pixels] height of the image in which blur is measured
_FINGERS = 0.1  # bias of the fingers over that of positions


@dataclass(frozen=True)
class PixelNoise(ObservationFilter):
    """Independent normal noise of each pixel and colour, new in each picture.

    Attributes:
        deviation: Standard deviation, [grey levels of 255].
    """

    only_rgb = True
    deviation: float

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the picture with noise."""
        rng = episode.key.generator(name, episode.step)
        noise = self.deviation * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Blur(ObservationFilter):
    """Gaussian blur of each picture.

    Attributes:
        deviation: Standard deviation in an image of 128 pixels height, [pixels]; in others in proportion.
    """

    only_rgb = True
    deviation: float

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the blurred picture."""
        radius = self.deviation * image.shape[0] / _BLUR_HEIGHT
        return np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(radius)))


@dataclass(frozen=True)
class Occlusion(ObservationFilter):
    """A grey rectangle before each camera, which stays for the episode.

    Attributes:
        share: Share of the picture that it hides.
    """

    only_rgb = True
    share: float

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the picture behind the rectangle."""
        rng, (height, width) = episode.key.generator(name), image.shape[:2]
        ratio, place, grey = 2.0 ** rng.uniform(-0.5, 0.5), rng.uniform(size=2), rng.integers(30, 226)
        tall = np.clip(np.sqrt(self.share * ratio), self.share, 1.0)
        rows, columns = round(height * tall), round(width * self.share / tall)
        top, left = np.rint(place * (height - rows, width - columns)).astype(int)
        hidden = image.copy()
        hidden[top : top + rows, left : left + columns] = grey
        return hidden


@dataclass(frozen=True)
class Latency(ObservationFilter):
    """Pictures arrive later; until the first arrives, it is the one at the start.

    Attributes:
        steps: Number of control steps.
    """

    has_memory = True
    steps: int

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return an earlier picture."""
        taken: deque[tuple[int, np.ndarray]] = episode.memory.setdefault(name, deque())
        if taken and taken[-1][0] == episode.step:
            taken.pop()
        taken.append((episode.step, image.copy()))
        while len(taken) > 1 and taken[1][0] <= episode.step - self.steps:
            taken.popleft()
        return taken[0][1]


@dataclass(frozen=True)
class DroppedFrames(ObservationFilter):
    """Pictures are lost, of all cameras at once; the last one that arrived stays.

    Attributes:
        share: Probability that the pictures of a step are lost; those at the start arrive.
    """

    has_memory = True
    share: float

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the last picture that arrived."""
        arrived = episode.memory
        if name not in arrived or episode.key.generator(episode.step).random() >= self.share:
            arrived[name] = image.copy()
        return arrived[name]


@dataclass(frozen=True)
class StateBias(ObservationFilter):
    """The robot's sensors are off by a constant: joints and orientation by an angle, the hand by a distance.

    Attributes:
        amount: Distance in joint space and angle of the hand, [rad]; distance of the hand, [m]. Fingers: a tenth.
        entries: Entries of observations that it changes.
    """

    entries = ("joint_states", "gripper_states", "ee_pos", "ee_ori", "ee_quat")
    amount: float

    def state(self, entries: Mapping[str, np.ndarray], episode: Episode) -> Mapping[str, np.ndarray]:
        """Return what the sensors say."""
        turn = quat_from_axis_angle(direction(episode.key.generator("turn"), 3), self.amount)[None]
        biased = dict(entries)
        for name, factor in (("joint_states", 1.0), ("ee_pos", 1.0), ("gripper_states", _FINGERS)):
            if name in entries:
                way = direction(episode.key.generator(name), len(entries[name]))
                biased[name] = entries[name] + factor * self.amount * way
        if "ee_quat" in entries:
            biased["ee_quat"] = quat_multiply(turn, entries["ee_quat"][None])[0]
        if "ee_ori" in entries:
            axis = entries["ee_ori"]
            angle = float(np.linalg.norm(axis))
            quat = quat_from_axis_angle(axis / angle if angle else np.eye(3)[0], angle)
            biased["ee_ori"] = quat_to_axis_angle(quat_multiply(turn, quat[None]))[0]
        return biased


@dataclass(frozen=True)
class ActionDelay(ActionFilter):
    """Actions are executed later; until the first arrives, the robot holds its pose.

    Attributes:
        steps: Number of control steps.
    """

    steps: int

    def act(self, action: np.ndarray, episode: Episode) -> np.ndarray:
        """Return an earlier action."""
        waiting: deque[np.ndarray] = episode.memory.setdefault("waiting", deque())
        waiting.append(action.copy())
        return np.zeros_like(action) if len(waiting) <= self.steps else waiting.popleft()


@dataclass(frozen=True)
class ActionGain(ActionFilter):
    """The movement of the arm is scaled; the gripper is not."""

    factor: float

    def act(self, action: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the scaled action."""
        scaled = action.copy()
        scaled[:-1] *= self.factor
        return scaled


@dataclass(frozen=True)
class ActionNoise(ActionFilter):
    """Independent normal noise on the movement of the arm, new in each step; the gripper has none.

    Attributes:
        deviation: Standard deviation, where actions are in [-1, 1].
    """

    deviation: float

    def act(self, action: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the noisy action."""
        noisy = action.copy()
        rng = episode.key.generator(episode.step)
        noisy[:-1] += self.deviation * rng.standard_normal(len(action) - 1)
        return noisy


SAMPLERS: dict[str, Callable[[float, np.random.Generator], ObservationFilter | ActionFilter]] = {
    "noise": lambda levels, rng: PixelNoise(levels),
    "blur": lambda pixels, rng: Blur(pixels),
    "occlusion": lambda share, rng: Occlusion(share),
    "latency": lambda steps, rng: Latency(int(steps)),
    "dropped_frames": lambda share, rng: DroppedFrames(share),
    "proprio_bias": lambda amount, rng: StateBias(amount),
    "delay": lambda steps, rng: ActionDelay(int(steps)),
    "gain": lambda ratio, rng: ActionGain(ratio ** sign(rng)),
    "action_noise": lambda deviation, rng: ActionNoise(deviation),
}
