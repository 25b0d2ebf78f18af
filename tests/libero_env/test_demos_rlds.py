"""RLDS: records that hold the recording, and metadata that say what is in them."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from libero_env.demos.read import read_demos
from libero_env.errors import DemoError, InvalidInputError
from libero_integrations.exports.demonstrations import ORIGIN, export_demos
from libero_integrations.exports.layouts import RECORDED
from libero_integrations.exports.rlds import _crc32c
from tests.harness.demos import episode, write

LENGTHS = (9, 14)
LANGUAGE = b"pick up the butter and place it in the basket"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    return write(folder / "butter_demo.hdf5", [episode(i, steps, 32) for i, steps in enumerate(LENGTHS)])


@pytest.fixture(scope="module")
def rlds(file, tmp_path_factory):
    root = tmp_path_factory.mktemp("rlds") / "butter_no_noops"
    assert export_demos([file], root, "rlds", progress=False) == (2, sum(LENGTHS))
    return root


def records(path):
    """Yield the messages of a TFRecord file; checksums are compared."""
    content, at = path.read_bytes(), 0
    while at < len(content):
        (size,) = struct.unpack_from("<Q", content, at)
        message = content[at + 12 : at + 12 + size]
        for part, place in ((content[at : at + 8], at + 8), (message, at + 12 + size)):
            crc = int(_crc32c(np.frombuffer(part, np.uint8)))
            masked = ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF
            assert struct.unpack_from("<I", content, place) == (masked,)
        yield message
        at += 16 + size


def fields(message):
    """Yield (number, content) of a message of Protocol Buffers that has fields with a length only."""
    at = 0
    while at < len(message):
        number, kind = message[at] >> 3, message[at] & 7
        assert kind == 2
        size = shift = 0
        while True:
            at += 1
            size |= (message[at] & 127) << shift
            shift += 7
            if message[at] < 128:
                break
        yield number, message[at + 1 : at + 1 + size]
        at += 1 + size


def values(message):
    """Return what a `tf.train.Example` holds by name."""
    ((one, features),) = fields(message)
    assert one == 1
    found = {}
    for _, entry in fields(features):
        (_, key), (_, feature) = fields(entry)
        ((kind, content),) = fields(feature)
        if kind == 1:
            found[key.decode()] = [value for _, value in fields(content)]
        else:
            ((_, packed),) = fields(content)
            found[key.decode()] = np.frombuffer(packed, "<f4" if kind == 2 else np.uint8)
    return found


def test_the_checksum_is_castagnolis():
    assert int(_crc32c(np.frombuffer(b"123456789", np.uint8))) == 0xE3069283  # RFC 3720


def test_records_hold_the_recording(rlds, file):
    (path,) = (rlds / "1.0.0").glob("*.tfrecord-*")
    assert path.name == "butter_no_noops-train.tfrecord-00000-of-00001"
    for message, demo in zip(records(path), read_demos(file), strict=True):
        found, steps = values(message), len(demo)
        np.testing.assert_array_equal(found["steps/action"], demo.actions.astype(np.float32).ravel())
        state = np.concatenate([demo.obs[key] for key in ("ee_pos", "ee_ori", "gripper_states")], axis=1)
        np.testing.assert_array_equal(found["steps/observation/state"], state.astype(np.float32).ravel())
        joints = demo.obs["joint_states"].astype(np.float32)
        np.testing.assert_array_equal(found["steps/observation/joint_state"], joints.ravel())
        assert found["steps/language_instruction"] == [LANGUAGE] * steps
        ends = [0] * (steps - 1) + [1]
        for key in ("is_last", "is_terminal", "reward"):
            assert found[f"steps/{key}"].tolist() == ends
        assert found["steps/is_first"].tolist() == [1] + [0] * (steps - 1)
        assert found["steps/discount"].tolist() == [1.0] * steps
        for key, name in (("image", "agentview_rgb"), ("wrist_image", "eye_in_hand_rgb")):
            for jpeg, frame in zip(found[f"steps/observation/{key}"], demo.obs[name], strict=True):
                picture = np.array(Image.open(io.BytesIO(jpeg)))
                assert picture.shape == frame.shape
                assert abs(picture.mean() - frame.mean()) < 3.0  # noise is what JPEG keeps least of
        (path_stored,) = found["episode_metadata/file_path"]
        assert path_stored.startswith(b"butter_demo.hdf5: demo_")


def test_metadata_say_what_the_records_hold(rlds):
    info = json.loads((rlds / "1.0.0/dataset_info.json").read_text())
    (split,) = info["splits"]
    assert (info["name"], info["version"], split["name"]) == ("butter_no_noops", "1.0.0", "train")
    assert split["shardLengths"] == ["2"]
    (path,) = (rlds / "1.0.0").glob("*.tfrecord-*")
    assert int(split["numBytes"]) == sum(map(len, records(path)))
    features = json.loads((rlds / "1.0.0/features.json").read_text())["featuresDict"]["features"]
    steps = features["steps"]["sequence"]["feature"]["featuresDict"]["features"]
    assert steps["action"]["tensor"]["shape"] == {"dimensions": ["7"]}
    image = steps["observation"]["featuresDict"]["features"]["wrist_image"]["image"]
    assert image["shape"] == {"dimensions": ["32", "32", "3"]} and image["encodingFormat"] == "jpeg"
    origin = json.loads((rlds / ORIGIN).read_text())
    assert (origin["images"]["mirrored"], origin["actions"]) == (False, "delta")


def test_large_sets_have_several_shards(file, tmp_path, monkeypatch):
    small = {"rlds": replace(RECORDED["rlds"], data_mb=0)}
    monkeypatch.setattr("libero_integrations.exports.demonstrations.RECORDED", small)
    export_demos([file], tmp_path / "set", "rlds", progress=False)
    names = sorted(path.name for path in (tmp_path / "set/1.0.0").glob("*.tfrecord-*"))
    assert names == [f"set-train.tfrecord-0000{i}-of-00002" for i in range(2)]
    info = json.loads((tmp_path / "set/1.0.0/dataset_info.json").read_text())
    assert info["splits"][0]["shardLengths"] == ["1", "1"]


@pytest.mark.parametrize("form", ["gr00t", "rlds"])
def test_a_recording_without_a_camera_is_refused_and_leaves_nothing(form, tmp_path):
    one = episode(0, 9)
    del one.obs["eye_in_hand_rgb"]
    file = write(tmp_path / "blind.hdf5", [one])
    with pytest.raises(DemoError, match=r"blind.hdf5: demo_0 has no images of eye_in_hand.*rerender"):
        export_demos([file], tmp_path / "set", form, progress=False)
    assert [path.name for path in tmp_path.iterdir()] == ["blind.hdf5"]


@pytest.mark.parametrize("name", ["my-set", "2sets"])
def test_a_name_that_tensorflow_datasets_does_not_take_is_refused(file, name, tmp_path):
    with pytest.raises(InvalidInputError, match=f"--out {name}: .*letters, digits and _"):
        export_demos([file], tmp_path / name, "rlds", progress=False)
    assert not list(tmp_path.iterdir())
