"""Settings of the demonstrations that a policy learns from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS
from libero_env.demos.read import LOW_DIM_KEYS
from libero_env.errors import UnknownNameError
from libero_env.sim.scene import DRAWINGS
from lifelong.data.loading import BACKENDS, MEMORY
from lifelong.types import PolicySpec

CAMERAS = {
    "agentview_rgb": "agentview",
    "eye_in_hand_rgb": "robot0_eye_in_hand",
}  # view -> camera in the model


@dataclass(frozen=True)
class DataSettings:
    """Settings of the demonstrations that a policy learns from; see configs/data.

    Attributes:
        demos: Number of demonstrations of each task.
        image_size: Height and width of the images, pixels.
        seq_len: Number of steps in a window of training data, T.
        views: Names of the images that the policy sees, keys of `CAMERAS`.
        proprio: Names of the proprioceptive readings that the policy sees, keys of `LOW_DIM_KEYS`.
        pairing: `aligned` pairs each action with the observation before it; `stored` reads files as they are.
        labels: `expert` learns the actions that the expert chose, `executed` those with noise that were executed.
        robot: Model of the arm in demonstrations and evaluation, see `libero_env.assets.robot`.
        folder: Folder of the demonstrations; None for `libero_env.paths.demos_dir()`.
        memory: Where frames are held, see `lifelong.data.loading`; batches do not depend on it.
        backend: What reads the windows, see `lifelong.data.loading`; batches do not depend on it.
        drawing: How images are drawn, in the demonstrations and in evaluations of the policy: `fast`, `faithful`, or
            None for the default of the models. The saved configuration of a run has the one that was used.
    """

    demos: int
    image_size: int
    seq_len: int
    views: Sequence[str]
    proprio: Sequence[str]
    pairing: Literal["aligned", "stored"] = "aligned"
    labels: Literal["expert", "executed"] = "expert"
    robot: str = DEFAULT_ROBOT
    folder: str | None = None
    memory: str = "auto"
    backend: str = "native"
    drawing: Literal["fast", "faithful"] | None = None

    def __post_init__(self) -> None:
        valid = {
            "pairing": ("aligned", "stored"),
            "labels": ("expert", "executed"),
            "robot": ROBOTS,
            "memory": MEMORY,
            "backend": BACKENDS,
            "views": CAMERAS,
            "proprio": LOW_DIM_KEYS,
            "drawing": (None, *DRAWINGS),
        }
        for key, names in valid.items():
            value = getattr(self, key)
            for name in [value] if value is None or isinstance(value, str) else value:
                if name not in names:
                    raise UnknownNameError(f"data.{key}", name, names)

    def spec(self, language_dim: int) -> PolicySpec:
        """Return the inputs and outputs of a policy for these data.

        Args:
            language_dim: Size of the embedding of an instruction.
        """
        return PolicySpec(
            views=tuple(self.views),
            image_size=(self.image_size, self.image_size),
            proprio={name: LOW_DIM_KEYS[name] for name in self.proprio},
            language_dim=language_dim,
            seq_len=self.seq_len,
        )
