"""Kinds that change what is observed: noise, blur, what hides the picture, late and lost pictures, a biased sensor."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageFilter

from libero_env.geometry import quat_from_axis_angle, quat_multiply, quat_to_axis_angle
from libero_env.perturbations.channels import ObservationChannel, ObservationFilter
from libero_env.perturbations.drawing import DrawKey, direction
from libero_env.perturbations.kind import Kind

RGB = "_rgb"
_BLUR_HEIGHT = 128  # [pixels] height of the image in which blur is measured
_FINGERS = 0.1  # bias of the fingers over that of positions


@dataclass(frozen=True)
class PixelNoise(ObservationFilter):
    """Independent normal noise of each pixel and colour, new in each picture.

    Attributes:
        deviation: Standard deviation, [grey levels of 255].
    """

    deviation: float

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _NoiseChannel(self, key)


class _NoiseChannel(ObservationChannel):
    def __init__(self, noise: PixelNoise, key: DrawKey):
        self._noise, self._key = noise, key

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        if not name.endswith(RGB):
            return image
        rng = self._key.generator(name, step)
        noise = self._noise.deviation * rng.standard_normal(image.shape, np.float32)
        return np.clip(np.rint(image + noise), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class Blur(ObservationFilter):
    """Gaussian blur of each picture.

    Attributes:
        deviation: Standard deviation in an image of 128 pixels height, [pixels]; in others in proportion.
    """

    deviation: float

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _BlurChannel(self.deviation)


class _BlurChannel(ObservationChannel):
    def __init__(self, deviation: float):
        self._deviation = deviation

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        if not name.endswith(RGB):
            return image
        radius = self._deviation * image.shape[0] / _BLUR_HEIGHT
        return np.asarray(Image.fromarray(image).filter(ImageFilter.GaussianBlur(radius)))


@dataclass(frozen=True)
class Occlusion(ObservationFilter):
    """A grey rectangle before each camera, which stays for the episode.

    Attributes:
        share: Share of the picture that it hides.
    """

    share: float

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _OcclusionChannel(self.share, key)


class _OcclusionChannel(ObservationChannel):
    def __init__(self, share: float, key: DrawKey):
        self._share, self._key = share, key

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        if not name.endswith(RGB):
            return image
        rng, (height, width) = self._key.generator(name), image.shape[:2]
        ratio, place, grey = 2.0 ** rng.uniform(-0.5, 0.5), rng.uniform(size=2), rng.integers(30, 226)
        tall = np.clip(np.sqrt(self._share * ratio), self._share, 1.0)
        rows, columns = round(height * tall), round(width * self._share / tall)
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

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _LatencyChannel(self.steps)


class _LatencyChannel(ObservationChannel):
    def __init__(self, steps: int):
        self._steps, self._taken = steps, dict[str, deque[tuple[int, np.ndarray]]]()

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        taken = self._taken.setdefault(name, deque())
        if taken and taken[-1][0] == step:
            taken.pop()
        taken.append((step, image.copy()))
        while len(taken) > 1 and taken[1][0] <= step - self._steps:
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

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _DroppedChannel(self.share, key)


class _DroppedChannel(ObservationChannel):
    def __init__(self, share: float, key: DrawKey):
        self._share, self._key, self._shown = share, key, dict[str, np.ndarray]()

    def image(self, name: str, image: np.ndarray, step: int) -> np.ndarray:
        if name not in self._shown or self._key.generator(step).random() >= self._share:
            self._shown[name] = image.copy()
        return self._shown[name]


@dataclass(frozen=True)
class StateBias(ObservationFilter):
    """The robot's sensors are off by a constant: joints and orientation by an angle, the hand by a distance.

    Attributes:
        amount: Distance in joint space and angle of the hand, [rad]; distance of the hand, [m]. Fingers: a tenth.
    """

    amount: float

    def open(self, key: DrawKey) -> ObservationChannel:
        """Return the channel of an episode."""
        return _BiasChannel(self.amount, key)


class _BiasChannel(ObservationChannel):
    def __init__(self, amount: float, key: DrawKey):
        self._turn = quat_from_axis_angle(direction(key.generator("turn"), 3), amount)[None]
        self._offsets = {
            name: factor * amount * direction(key.generator(name), size)
            for name, size, factor in (
                ("joint_states", 7, 1.0),
                ("ee_pos", 3, 1.0),
                ("gripper_states", 2, _FINGERS),
            )
        }

    def state(self, entries: Mapping[str, np.ndarray], step: int) -> Mapping[str, np.ndarray]:
        biased = {name: entries[name] + off for name, off in self._offsets.items() if name in entries}
        if "ee_quat" in entries:
            biased["ee_quat"] = quat_multiply(self._turn, entries["ee_quat"][None])[0]
        if "ee_ori" in entries:
            axis = entries["ee_ori"]
            angle = float(np.linalg.norm(axis))
            quat = quat_from_axis_angle(axis / angle if angle else np.eye(3)[0], angle)
            biased["ee_ori"] = quat_to_axis_angle(quat_multiply(self._turn, quat[None]))[0]
        return {**entries, **biased}


KINDS = (
    Kind(
        "noise",
        "observation",
        "grey levels",
        50.0,
        "normal noise on each pixel of all cameras, with this standard deviation of 255 levels",
        lambda levels, rng: PixelNoise(levels),
    ),
    Kind(
        "blur",
        "observation",
        "pixels of 128",
        4.0,
        "Gaussian blur of all cameras, with this standard deviation in an image of 128 pixels height",
        lambda pixels, rng: Blur(pixels),
    ),
    Kind(
        "occlusion",
        "observation",
        "share of the picture",
        0.4,
        "a grey rectangle hides this share of each picture, at a place that stays for the episode",
        lambda share, rng: Occlusion(share),
    ),
    Kind(
        "latency",
        "observation",
        "control steps",
        10,
        "pictures arrive this many steps of 50 ms later; the robot's own state does not",
        lambda steps, rng: Latency(int(steps)),
        scale="count",
    ),
    Kind(
        "dropped_frames",
        "observation",
        "share",
        0.9,
        "this share of the pictures is lost, and the last that arrived stays",
        lambda share, rng: DroppedFrames(share),
    ),
    Kind(
        "proprio_bias",
        "observation",
        "m and rad",
        0.1,
        "the robot's sensors are off by this distance of the hand, and this angle of the hand and in joint space",
        lambda amount, rng: StateBias(amount),
    ),
)
