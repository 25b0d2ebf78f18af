"""What data sets call things: features, their names and shapes, frames per second.

`RECORDED` are the forms of recordings as they are, `PUBLISHED` those of published sets of human demonstrations on the
Hugging Face Hub. Sources: of `physical-intelligence/libero` the script that made it,
examples/libero/convert_libero_data_to_lerobot.py of Physical-Intelligence/openpi, and its data set card;
`lerobot/libero` is `HuggingFaceVLA/libero` (its card has the features, each with `fps`) after
`convert_image_to_video_dataset` of LeRobot, which keeps the features and replaces those of the indices by LeRobot's
default ones. `IPEC-COMMUNITY/libero` are its sets `libero_*_no_noops_1.0.0_lerobot`, on which examples/LIBERO of GR00T
trains: meta/modality.json as NVIDIA/Isaac-GR00T getting_started/data_preparation.md has it, with the keys of
`libero_sim` in gr00t/configs/data/embodiment_configs.py. `openvla/modified_libero_rlds` has OpenVLA's
`libero_*_no_noops`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from libero_env.curating.video import AV1, H264, PIXEL_FORMAT, Codec
from libero_env.storage import parse_yaml

ROBOT_TYPE = "panda"
STATE = ("ee_pos", "ee_ori", "gripper_states")  # observations that are the 8 numbers of state
FILES_PER_CHUNK = 1000
ORIGIN = "meta/libero.json"  # how a data set was made
GRIPPER = {False: "-1 opens, +1 closes", True: "1 opens, 0 closes"}  # by `Layout.open_gripper`
INDICES = ("frame_index", "episode_index", "index", "task_index")
_AXES = ("height", "width", "channel")


@dataclass(frozen=True)
class Layout:
    """Names and numbers of a kind of data set.

    Attributes:
        version: Version of LeRobot's format; `rlds` is the format of TensorFlow Datasets.
        fps: Frames per second in metadata, timestamps and videos; control steps are at 20 Hz whatever it says.
        state: Feature of the state: position, rotation vector, fingers.
        action: Feature of the action.
        state_names: Names of the state's entries.
        action_names: Names of the action's entries.
        cameras: Camera -> feature of its images; others are named alike.
        codec: How videos are encoded; None stores PNG files in the tables.
        mirrored: Whether images are mirrored left to right.
        outcome: Whether there are columns `next.reward` and `next.done`.
        states_fps: Whether features state `fps`, too.
        open_gripper: Whether the last number of an action is 1 to open and 0 to close the gripper, not -1 and +1.
        action_dim: Length of an action.
        data_mb: Size from which a table is continued in another file, [MiB].
        video_mb: Size from which a video is continued in another file, [MiB].
    """

    version: str
    fps: int
    state: str
    action: str
    state_names: Sequence[str]
    action_names: Sequence[str]
    cameras: Mapping[str, str]
    codec: Codec | None
    mirrored: bool
    outcome: bool = False
    states_fps: bool = False
    open_gripper: bool = False
    action_dim: int = 7
    data_mb: int = 100
    video_mb: int = 200

    def image_feature(self, key: str) -> str:
        """Return the feature of a camera's images, such as `eye_in_hand_rgb` -> `observation.images.image2`."""
        camera, (prefix, dot, _) = key.removesuffix("_rgb"), self.cameras["agentview"].rpartition(".")
        return self.cameras.get(camera, f"{prefix}{dot}{camera}")

    def features(self, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Any]:
        """Return the features as in info.json.

        Args:
            shapes: Feature of a camera -> height, width and number of channels of its images.
        """
        fps = {"fps": float(self.fps)} if self.states_fps else {}
        number = {"shape": [1], "names": None}
        features: dict[str, Any] = {}
        for key, (height, width, channels) in shapes.items():
            info = self._video_info(height, width, channels)
            kind = {"dtype": "image" if self.codec is None else "video"}
            features[key] = kind | {"shape": [height, width, channels], "names": list(_AXES)} | fps | info
        features[self.state] = {"dtype": "float32", "shape": [8], "names": list(self.state_names)} | fps
        names = list(self.action_names)
        features[self.action] = {"dtype": "float32", "shape": [self.action_dim], "names": names} | fps
        features["timestamp"] = {"dtype": "float32", **number}
        if self.outcome:
            features |= {
                "next.reward": {"dtype": "float32", **number},
                "next.done": {"dtype": "bool", **number},
            }
        return features | {key: {"dtype": "int64", **number} for key in INDICES}

    def of_joints(self) -> "Layout":
        """Return the layout with actions that are goals of the joints."""
        names = (*(f"joint{number}" for number in range(1, 8)), "gripper")
        return replace(self, action_names=names, action_dim=len(names))

    def modality(self, videos: Iterable[str]) -> dict[str, Any]:
        """Return what GR00T reads in meta/modality.json: where parts of states and actions are, names of videos.

        Args:
            videos: Features of the cameras.
        """
        return {
            "state": _parts(self.state_names),
            "action": _parts(self.action_names),
            "video": {key.rpartition(".")[2]: {"original_key": key} for key in videos},
            "annotation": {"human.action.task_description": {"original_key": "task_index"}},
        }

    def _video_info(self, height: int, width: int, channels: int) -> dict[str, Any]:
        if self.codec is None:
            return {}
        info = {
            "video.height": height,
            "video.width": width,
            "video.channels": channels,
            "video.codec": self.codec.name,
            "video.pix_fmt": PIXEL_FORMAT,
            "video.fps": self.fps,
            "video.is_depth_map": False,
            "has_audio": False,
        }
        # The published sets do not say it. Here it keeps LeRobot from merging images of different orientation.
        orientation = {} if self.mirrored else {"image.first_row": "top", "image.mirrored": False}
        return {"info": info | orientation}


def _read_layouts() -> dict[str, Mapping[str, Layout]]:
    """Return the layouts of each section of `layouts.yaml`, by name."""
    codecs = {codec.name: codec for codec in (AV1, H264)}
    data = parse_yaml(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    return {
        section: MappingProxyType(
            {
                name: Layout(**{**fields, "codec": codecs.get(fields["codec"])})
                for name, fields in group.items()
            }
        )
        for section, group in data.items()
        if section != "own"
    }


_LAYOUTS = _read_layouts()
PUBLISHED, RECORDED = _LAYOUTS["published"], _LAYOUTS["recorded"]


def _parts(names: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return where each part of an array begins and ends; entries of one name are one part."""
    return {name: {"start": names.index(name), "end": len(names) - names[::-1].index(name)} for name in names}
