"""RLDS: episodes as TensorFlow Datasets stores them, written without TensorFlow.

A data set is a folder `<name>/1.0.0` with `features.json`, `dataset_info.json` and shards of records, one for each
episode: `tfds.builder_from_directory` reads it. The features are those of OpenVLA's `libero_*_no_noops`: images as JPEG
of quality 95; `steps/is_terminal` and, after a success, `steps/reward` are 1 at the last step.

A record is a message `tf.train.Example` of Protocol Buffers, framed as in TFRecord: its length, 8 bytes, their masked
CRC-32C, the message, its masked CRC-32C.
"""

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.compilation import compiled
from libero_env.curating.video import encode_image
from libero_env.demos.hdf5 import BrokenDemoError
from libero_env.demos.read import Episode
from libero_env.errors import DemoError, InvalidInputError
from libero_integrations.exports.layouts import STATE, Layout
from libero_integrations.exports.lerobot import DatasetWriter, write_json

VERSION = "1.0.0"
_QUALITY = 95  # that of TensorFlow's encoder
_FEATURES = "tensorflow_datasets.core.features"


class RldsWriter(DatasetWriter):
    """Writes a data set of TensorFlow Datasets with the split `train`.

    Args:
        root: Folder to write into, in which the folder of the version is made.
        layout: Names and numbers of the data set.
        name: Name of the data set.

    Raises:
        InvalidInputError: The name is not one of TensorFlow Datasets.
    """

    numbers = ("state", "joint_state")

    def __init__(self, root: Path, layout: Layout, name: str):
        super().__init__(root, layout)
        if not re.fullmatch(r"[a-zA-Z]\w*", name):
            raise InvalidInputError(
                f"--out {name}: the folder is the name of the data set, which TensorFlow Datasets takes from letters, "
                "digits and _ only, a letter first"
            )
        self._folder, self._name = root / VERSION, name
        self._folder.mkdir()
        self._lengths: list[int] = []  # of each shard, in episodes
        self._frames = self._bytes = 0

    def add(self, episode: Episode, language: str, where: str) -> None:
        """Append an episode.

        Args:
            episode: Its actions, observations and success.
            language: The instruction.
            where: File and demonstration, for error messages; the file's name is stored.

        Raises:
            DemoError: It lacks joints or images, or has other images than the episodes before.
        """
        if "joint_states" not in episode.obs:
            raise BrokenDemoError(f"{where}/obs/joint_states is missing; expected it for steps/observation")
        steps = len(episode)
        last = np.arange(steps) == steps - 1
        state = np.concatenate([episode.obs[key] for key in STATE], axis=1)
        columns: dict[str, Any] = {
            f"observation/{key}": [encode_image(frame, "JPEG", quality=_QUALITY) for frame in frames]
            for key, frames in self._images(episode, where).items()
        }
        columns |= {
            "observation/state": state.astype(np.float32),
            "observation/joint_state": episode.obs["joint_states"].astype(np.float32),
            "action": episode.actions.astype(np.float32),
            "discount": np.ones(steps, np.float32),
            "reward": (last & episode.success).astype(np.float32),
            "is_first": np.arange(steps) == 0,
            "is_last": last,
            "is_terminal": last,
            "language_instruction": [language.encode()] * steps,
        }
        record = _example(
            {f"steps/{key}": values for key, values in columns.items()}
            | {"episode_metadata/file_path": [Path(where).name.encode()]}
        )
        self._write(record)
        self._frames += steps

    def _write(self, record: bytes) -> None:
        limit = self.layout.data_mb * 2**20
        if not self._lengths or self._shard(len(self._lengths) - 1).stat().st_size > limit:
            self._lengths.append(0)
        length = len(record).to_bytes(8, "little")
        with self._shard(len(self._lengths) - 1).open("ab") as file:
            file.write(length + checksum(length) + record + checksum(record))
        self._lengths[-1] += 1
        self._bytes += len(record)

    def _shard(self, number: int) -> Path:
        return self._folder / f"shard-{number}"

    def finish(self) -> tuple[int, int]:
        """Name the shards and write the metadata; return the number of episodes and the number of frames."""
        if not self._lengths:
            raise DemoError("no demonstrations to export")
        for number in range(len(self._lengths)):
            name = f"{self._name}-train.tfrecord-{number:05d}-of-{len(self._lengths):05d}"
            os.rename(self._shard(number), self._folder / name)
        split = {
            "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
            "name": "train",
            "numBytes": str(self._bytes),
            "shardLengths": list(map(str, self._lengths)),
        }
        info = {"fileFormat": "tfrecord", "name": self._name, "version": VERSION, "splits": [split]}
        write_json(self._folder / "dataset_info.json", info)
        write_json(self._folder / "features.json", self._features())
        return sum(self._lengths), self._frames

    def _features(self) -> dict[str, Any]:
        images = {
            key: _feature("image_feature.Image", image={**_array("uint8", *shape), "encodingFormat": "jpeg"})
            for key, shape in self._shapes.items()
        }
        numbers = dict(zip(self.numbers, (8, 7), strict=True))
        steps = {
            "observation": _dict(images | {key: _tensor("float32", size) for key, size in numbers.items()}),
            "action": _tensor("float32", self.layout.action_dim),
            **{key: _tensor("float32") for key in ("discount", "reward")},
            **{key: _tensor("bool") for key in ("is_first", "is_last", "is_terminal")},
            "language_instruction": _feature("text_feature.Text", text={}),
        }
        sequence = {"feature": _dict(steps), "length": "-1"}
        path = _feature("text_feature.Text", text={})
        return _dict(
            {
                "steps": _feature("dataset_feature.Dataset", sequence=sequence),
                "episode_metadata": _dict({"file_path": path}),
            }
        )


def _feature(kind: str, **content: Any) -> dict[str, Any]:
    return {"pythonClassName": f"{_FEATURES}.{kind}", **content}


def _dict(features: Mapping[str, Any]) -> dict[str, Any]:
    return _feature("features_dict.FeaturesDict", featuresDict={"features": dict(features)})


def _tensor(dtype: str, *shape: int) -> dict[str, Any]:
    kind = "tensor_feature.Tensor" if shape else "scalar.Scalar"
    return _feature(kind, tensor={**_array(dtype, *shape), "encoding": "none"})


def _array(dtype: str, *shape: int) -> dict[str, Any]:
    return {"dtype": dtype, "shape": {"dimensions": list(map(str, shape))} if shape else {}}


def _example(columns: Mapping[str, Any]) -> bytes:
    """Return a message `tf.train.Example`: a map from names to lists of bytes, of floats, or of integers."""
    entries = [
        _message(1, _message(1, key.encode()) + _message(2, _list(values))) for key, values in columns.items()
    ]
    return _message(1, b"".join(entries))


def _list(values: Any) -> bytes:
    if isinstance(values, list):
        return _message(1, b"".join(_message(1, value) for value in values))
    if values.dtype == np.float32:
        return _message(2, _message(1, values.astype("<f4").tobytes()))
    return _message(3, _message(1, values.astype(np.uint8).tobytes()))  # truths: integers of one byte


def _message(number: int, content: bytes) -> bytes:
    """Return field `number` of a message, of the type that has a length."""
    length, rest = bytearray([number << 3 | 2]), len(content)
    while rest > 127:
        length.append(rest & 127 | 128)
        rest >>= 7
    length.append(rest)
    return bytes(length) + content


def checksum(content: bytes | memoryview) -> bytes:
    """Return the masked CRC-32C of some bytes, 4 bytes."""
    crc = int(_crc32c(np.frombuffer(content, np.uint8)))
    return (((crc >> 15 | crc << 17) + 0xA282EAD8) % 2**32).to_bytes(4, "little")


@compiled
def _crc32c(content):
    """Return the CRC-32C (Castagnoli) of bytes."""
    table = np.empty(256, np.uint32)
    for byte in range(256):
        value = np.uint32(byte)
        for _ in range(8):
            value = (value >> np.uint32(1)) ^ (np.uint32(0x82F63B78) * (value & np.uint32(1)))
        table[byte] = value
    crc = np.uint32(0xFFFFFFFF)
    for byte in content:
        crc = table[(crc ^ byte) & np.uint32(255)] ^ (crc >> np.uint32(8))
    return crc ^ np.uint32(0xFFFFFFFF)
