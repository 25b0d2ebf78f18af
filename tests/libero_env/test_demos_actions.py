"""Converted actions: the controller of their kind does with them what was recorded."""

import json
from dataclasses import replace

import numpy as np
import pytest

from libero_env.demos.actions import KINDS, ActionConverter
from libero_env.demos.config import RenderConfig
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import read_episodes
from libero_env.demos.replay import replay
from libero_env.errors import DemoError
from libero_env.geometry import rotation_about
from libero_env.sim.controller import get_controller
from libero_integrations.exports.demonstrations import ORIGIN, export_demos
from tests.harness.demos import generate

pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_ASSETS", "builtin")
        out = tmp_path_factory.mktemp("demos") / "put_the_bowl_on_the_stove_demo.hdf5"
        yield generate("libero_goal/1", 1, path=out, camera_size=(16, 16), workers=1, progress=False)


@pytest.fixture(scope="module")
def episode(file):
    return next(read_episodes(file))


def converted(file, episode, kind):
    converter = ActionConverter(file, kind)
    result = converter.convert(episode)
    converter.close()
    return result.actions


@pytest.mark.parametrize(("kind", "drift"), [("absolute", 1e-3), ("joint", 0.02)])
def test_a_converted_demonstration_succeeds_by_the_controller_of_its_kind(file, kind, drift):
    """The arm does not leave the recorded motion by more than `drift` rad."""
    (result,) = replay(file, actions=kind)
    assert result.success and result.arm_drift.max() < drift


def test_poses_are_the_goals_of_the_recorded_actions(file, episode):
    poses = converted(file, episode, "absolute")
    renderer = StateRenderer.of_file(file, RenderConfig(()))
    renderer.prepare(episode, "")
    for t in (0, len(episode) // 2, len(episode) - 1):
        renderer.env.set_state(episode.states[t])
        view = renderer.env.view
        position, turn = episode.actions[t, :3], 0.5 * episode.actions[t, 3:6]
        np.testing.assert_allclose(poses[t, :3], view.eef_pos + 0.05 * position, atol=1e-9)
        goal = rotation_about(turn / np.linalg.norm(turn), np.linalg.norm(turn)) @ view.eef_mat
        vector = poses[t, 3:6]
        angle = np.linalg.norm(vector)
        np.testing.assert_allclose(rotation_about(vector / angle, angle), goal, atol=1e-6)
    renderer.close()
    np.testing.assert_array_equal(poses[:, 6], episode.actions[:, 6])
    assert np.abs(np.diff(poses[:, 3:6], axis=0)).max() < 0.5  # no vector turns into its opposite
    assert poses[0, 3:6].max() == np.abs(poses[0, 3:6]).max()


def test_without_a_rotation_the_goal_of_the_rotation_stays(file, episode):
    actions = episode.actions.copy()
    actions[5:9, 3:6] = 0.0
    poses = converted(file, replace(episode, actions=actions), "absolute")
    np.testing.assert_array_equal(poses[5:9, 3:6], np.tile(poses[4, 3:6], (4, 1)))


def test_joints_are_within_their_limits_and_lead_the_arm(file, episode):
    goals = converted(file, episode, "joint")
    controller = get_controller(*KINDS["joint"])
    assert goals.shape == (len(episode), 8)
    assert (goals >= controller.low).all() and (goals <= controller.high).all()
    np.testing.assert_array_equal(goals[:, 7], episode.actions[:, 6])
    joints = episode.states[:, 1:8]
    moving = np.abs(joints[4:] - joints[:-4]) > 0.02
    ahead = np.sign(goals[:-4, :7] - joints[:-4]) == np.sign(joints[4:] - joints[:-4])
    assert ahead[moving].mean() > 0.8


def test_exports_hold_them_and_say_so(file, episode, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    pytest.importorskip("av")
    for kind, dim in (("absolute", 7), ("joint", 8)):
        root = tmp_path / kind
        export_demos([file], root, labels="executed", actions=kind, progress=False)
        info = json.loads((root / "meta/info.json").read_text())["features"]["action"]
        assert info["shape"] == [dim] and len(info["names"]) == dim
        table = parquet.read_table(root / "data/chunk-000/file-000.parquet")
        expected = converted(file, episode, kind).astype(np.float32)
        np.testing.assert_array_equal(table["action"].to_pylist(), expected)
        origin = json.loads((root / ORIGIN).read_text())
        assert (origin["actions"], origin["controller"], origin["control_delta"]) == (kind, *KINDS[kind])


def test_states_are_replayed_without_converted_actions(file):
    with pytest.raises(DemoError, match="by state executes no joint actions"):
        next(replay(file, by="state", actions="joint"))
