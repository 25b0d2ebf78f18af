"""Wide motion recorded with the original, repeated here: arm stretched, folded, turned, pressed onto the table.

The recordings are those of `experiments/parity`. What the arm does before it touches anything depends on no object,
so the package's own models will do; after a touch the models of the original are needed.
"""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "experiments" / "parity"
RECORDINGS = sorted((FOLDER / "recordings").glob("*.npz"))
JOINT_LIMITS = 1e-5  # [rad] versions of MuJoCo differ at the limits of joints, which are constraints too
pytestmark = pytest.mark.sim
every_recording = pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: path.stem)


@pytest.fixture(scope="module")
def replay():
    spec = importlib.util.spec_from_file_location("replay", FOLDER / "replay.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.replay


@every_recording
def test_free_motion_agrees(path, replay):
    with np.load(path, allow_pickle=False) as stored:
        touches = stored["touches"]
    free = int(np.argmax(touches > 0)) if touches.any() else len(touches)
    found = replay(path, "builtin", steps=min(free, 60))
    assert found.free_steps == min(free, 60) > 4
    assert found.robot.max() < JOINT_LIMITS


@pytest.mark.slow
@every_recording
def test_motion_agrees_through_contact(path, replay, shared):
    old = tuple(int(n) for n in mujoco.__version__.split(".")[:2]) < (3, 4)
    found = replay(path, shared / "official" / "assets", steps=100)
    assert found.robot[: found.free_steps].max() < JOINT_LIMITS
    if old:  # contact is computed as in the recordings
        assert found.robot_segments.max() < 1e-6
