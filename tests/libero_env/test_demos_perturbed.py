"""Demonstrations rendered again under perturbations: other pictures and words, the same actions and states."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest

from libero_env import LiberoEnv, get_task
from libero_env.assets.pack import BuiltinPack
from libero_env.curating.curate import describe, examine
from libero_env.curating.rendering import rerender
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import read_header
from libero_env.demos.observe import recorded_rendering
from libero_env.demos.read import read_demos, read_episodes
from libero_env.errors import DemoError, InvalidInputError
from libero_env.perturbations import parse_perturbations
from libero_env.perturbations.episodes import rendered_perturbations
from libero_integrations.exports.demonstrations import recorded_language
from tests.harness.demos import STEPS, record_wander

TASK, SIZE = "libero_goal/3", (24, 32)
MIXED = "instruction=0.6,camera=0.5,light=0.5,noise=0.2,proprio_bias=0.5"
KEPT = ("actions", "expert_actions", "states", "robot_states")
pytestmark = pytest.mark.sim


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return record_wander(tmp_path_factory.mktemp("demos") / "goal.hdf5", TASK, SIZE)


@pytest.fixture(scope="module")
def other(path, tmp_path_factory):
    return perturbed(path, tmp_path_factory.mktemp("other") / "other.hdf5", MIXED)


def perturbed(path, target, perturb, **more):
    config = replace(recorded_rendering(path), perturb=perturb)
    return rerender(path, target, config, progress=False, **more)


def contents(file):
    found = {}

    def note(name, node):
        found.update({f"{name}@{key}": value for key, value in node.attrs.items()})
        if isinstance(node, h5py.Dataset):
            found[name] = node[()]

    with h5py.File(file) as handle:
        note("", handle["data"])
        handle["data"].visititems(note)
    return found


def assert_same(file, other):
    before, after = contents(file), contents(other)
    assert before.keys() == after.keys() and "demo_1/obs/agentview_rgb" in before
    for key, value in before.items():
        np.testing.assert_array_equal(value, after[key], err_msg=key)


def test_severity_0_is_the_file_to_the_bit(path, tmp_path):
    assert_same(path, perturbed(path, tmp_path / "again.hdf5", "camera=0,noise=0,instruction=0"))


def test_a_rendered_file_states_its_models_and_cameras_and_has_one_pack(path, tmp_path):
    class Moon(BuiltinPack):
        name = "moon"

    out = tmp_path / "out.hdf5"
    config = RenderConfig(("agentview", "frontview"), (16, 24), ("rgb", "depth"))
    rerender(path, out, config, assets=Moon(), limit=1, progress=False)
    stated = read_header(out)
    assert json.loads(stated["models"])["pack"] == "moon"
    made_with, before = (json.loads(h["env_args"])["env_kwargs"] for h in (stated, read_header(path)))
    assert made_with | {k: v for k, v in before.items() if k.startswith("camera_")} == before
    assert [made_with[f"camera_{k}"] for k in ("names", "heights", "widths", "depths")] == [
        ["frontview", "agentview"], 16, 24, True
    ]  # fmt: skip
    with pytest.raises(DemoError, match="was recorded with other models"):
        rerender(path, out, config, progress=False)


def test_what_happened_stays_and_what_is_seen_and_said_changes(path, other):
    for old, new in zip(read_episodes(path), read_episodes(other), strict=True):
        for key in KEPT:
            np.testing.assert_array_equal(getattr(old, key), getattr(new, key), err_msg=f"{old.name} {key}")
        for key in ("agentview_rgb", "eye_in_hand_rgb", "joint_states", "ee_ori"):
            assert (old.obs[key] != new.obs[key]).mean() > 0.5, (old.name, key)
    with h5py.File(path) as old, h5py.File(other) as new:
        assert new["data"].attrs["perturb"] == MIXED
        said = [json.loads(f["data"].attrs["problem_info"])["language_instruction"] for f in (old, new)]
    env = LiberoEnv(TASK, cameras=(), perturb="instruction=0.6")
    assert said == [get_task(TASK).language, env.task.language] and said[0] != said[1]
    assert [recorded_language(file, get_task(TASK)) for file in (path, other)] == said
    assert f"rendered under {MIXED}" in describe(other) and f"rendered under {MIXED}" in str(examine(other))
    assert "rendered under" not in describe(path) and not examine(other).faults


def test_each_demonstration_has_a_draw_of_its_own(path, tmp_path):
    """It depends on neither the others nor on interruptions, and goes on in the same direction with severity."""
    whole = perturbed(path, tmp_path / "whole.hdf5", "light=0.8,dropped_frames=0.5")
    part = perturbed(path, tmp_path / "part.hdf5", "light=0.8,dropped_frames=0.5", limit=1)
    assert len(read_demos(part)) == 1
    assert_same(whole, perturbed(path, part, "light=0.8,dropped_frames=0.5"))
    means = [[e.obs["agentview_rgb"][0].mean() for e in read_episodes(file)] for file in (path, whole)]
    ratios = np.divide(*means)
    assert abs(ratios[1] - ratios[0]) > 0.05  # each has its own light
    seeded = perturbed(path, tmp_path / "seeded.hdf5", parse_perturbations("light=0.8", seed=1))
    for one, two in zip(read_episodes(whole), read_episodes(seeded), strict=True):
        assert (one.obs["agentview_rgb"][0] != two.obs["agentview_rgb"][0]).any()


def test_filters_with_a_memory_act_along_each_demonstration(path, tmp_path):
    late = perturbed(path, tmp_path / "late.hdf5", "latency=0.3")  # 3 steps
    for old, new in zip(read_episodes(path), read_episodes(late), strict=True):
        for key in ("agentview_rgb", "eye_in_hand_rgb"):
            shown = old.obs[key][np.maximum(np.arange(STEPS) - 3, 0)]
            np.testing.assert_array_equal(new.obs[key], shown)
        np.testing.assert_array_equal(new.obs["joint_states"], old.obs["joint_states"])


def test_it_can_be_undone_and_is_not_mixed(path, other, tmp_path):
    assert_same(path, rerender(other, tmp_path / "back.hdf5", recorded_rendering(other), progress=False))
    with pytest.raises(DemoError, match="perturb"):
        perturbed(path, other, "blur=0.5")


@pytest.mark.parametrize("text", ["robot=0.3", "delay=0.5", "layout=0.2", "camera=0.1,goal=1"])
def test_what_changes_what_happens_is_refused(text):
    with pytest.raises(InvalidInputError, match="changes what happens.*valid: .*instruction.*camera"):
        RenderConfig(perturb=text)
    assert rendered_perturbations("camera=0.5,robot=0") == parse_perturbations("camera=0.5")
