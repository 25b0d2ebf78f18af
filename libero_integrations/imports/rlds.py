"""Reader of RLDS, episodes as TensorFlow Datasets stores them in TFRecord files, without TensorFlow.

`libero_integrations.exports.rlds` describes the format.
"""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.hdf5 import BrokenDemoError, damage_named
from libero_env.demos.read import Episode
from libero_env.errors import DemoError
from libero_env.storage import read_json
from libero_integrations.exports.layouts import PUBLISHED
from libero_integrations.exports.rlds import checksum
from libero_integrations.imports.lerobot import decode_images

_OBSERVED = "steps/observation/"
_PUBLISHED = {"image", "wrist_image", "state", "joint_state"}  # observations of OpenVLA's sets
_BYTES, _FLOATS = 1, 2  # fields of a `tf.train.Feature`


class RldsSet:
    """A data set of TensorFlow Datasets. `layout` is the published one whose features it has, or None.

    Args:
        root: Its folder, or that of its version, with `features.json`.

    Raises:
        DemoError: It has several versions, files of another format, or no state or action of the expected size.
    """

    def __init__(self, root: Path):
        files = sorted((*root.glob("features.json"), *root.glob("*/features.json")))
        if len(files) != 1:
            raise DemoError(f"{root} has {len(files)} files features.json; name the folder of one version")
        self.root, file = files[0].parent, files[0]
        features = read_json(file, DemoError)
        with damage_named(str(file)):
            step = _parts(_parts(features)["steps"]["sequence"]["feature"])
            observed = _parts(step["observation"])
            sizes = {
                key: one["tensor"]["shape"]["dimensions"] for key, one in observed.items() if "tensor" in one
            }
            sizes["action"] = step["action"]["tensor"]["shape"]["dimensions"]
        found = sizes.get("state"), sizes["action"]
        if found != (["8"], ["7"]):
            raise DemoError(f"{file}: sizes of state and action are {found}; expected 8 and 7")
        self.layout = PUBLISHED["openvla/modified_libero_rlds"] if set(observed) == _PUBLISHED else None
        self._images = [key for key, one in observed.items() if "image" in one]

    def episodes(self) -> Iterator[tuple[str, Callable[[], Episode]]]:
        """Yield the instruction of each episode, and what reads it."""
        for file in sorted(self.root.glob("*.tfrecord*")):
            with damage_named(str(file)):
                content = np.memmap(file, np.uint8, "r").data
            at, number = 0, 0
            while at < len(content):
                where = f"{file.name}: record {number}"
                with damage_named(str(file.parent / where)):
                    head, end = (
                        content[at : at + 12],
                        at + 12 + int.from_bytes(content[at : at + 8], "little"),
                    )
                    if checksum(head[:8]) != head[8:] or end + 4 > len(content):
                        raise BrokenDemoError(f"{file.parent / where} is not whole")
                    record, at, number = content[at + 12 : end + 4], end + 4, number + 1
                    texts = _values(record[:-4])["steps/language_instruction"]
                    (instruction,) = {bytes(text).decode() for text in texts}
                yield instruction, partial(self._read, record, where)

    def _read(self, record: memoryview, where: str) -> Episode:
        if checksum(record[:-4]) != record[-4:]:
            raise BrokenDemoError(f"{self.root / where} is damaged: its checksum is another")
        with damage_named(str(self.root / where)):
            values = _values(record[:-4])
            actions = values["steps/action"].reshape(-1, 7)
            state = values[f"{_OBSERVED}state"].reshape(len(actions), 8)
            obs = {"ee_pos": state[:, :3], "ee_ori": state[:, 3:6], "gripper_states": state[:, 6:]}
            if f"{_OBSERVED}joint_state" in values:
                obs["joint_states"] = values[f"{_OBSERVED}joint_state"].reshape(len(actions), 7)
            for key in self._images:
                codes = [bytes(code) for code in values[f"{_OBSERVED}{key}"]]
                obs[key] = decode_images(codes, str(self.root / where))
            reached = values.get("steps/reward", np.ones(1))[-1] > 0
            return Episode(actions, np.zeros((len(actions), 0)), obs=obs, success=bool(reached), name=where)


def _parts(feature: Any) -> Mapping[str, Any]:
    """Return the features of a `FeaturesDict`, by name."""
    return feature["featuresDict"]["features"]


def _values(message: memoryview) -> dict[str, Any]:
    """Return the lists of bytes and of floats in a message `tf.train.Example`, by name."""
    found: dict[str, Any] = {}
    for _, features in _fields(message):
        for _, entry in _fields(features):
            (_, name), (_, feature) = sorted(_fields(entry), key=lambda field: field[0])
            for kind, values in _fields(feature):
                parts = [content for _, content in _fields(values)]
                if kind == _BYTES:
                    found[bytes(name).decode()] = parts
                elif kind == _FLOATS:
                    found[bytes(name).decode()] = np.frombuffer(b"".join(parts), "<f4")
    return found


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield number and content of the fields of a message of Protocol Buffers, which all have a length.

    Raises:
        ValueError: One has none, or ends outside of the message.
    """
    at = 0
    while at < len(message):
        if message[at] & 7 != 2:
            raise ValueError(f"field {message[at] >> 3} of another type")
        number, size, shift = message[at] >> 3, 0, 0
        while True:
            at += 1
            size |= (message[at] & 127) << shift
            shift += 7
            if message[at] < 128:
                break
        at += 1 + size
        if at > len(message):
            raise ValueError(f"field {number} is longer than its message")
        yield number, message[at - size : at]
