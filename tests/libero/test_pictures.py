"""The original's pictures, depth and segmentation, recorded from its own environments.

Under MuJoCo 3.3.2, which drew the recordings, they agree to the bit. `LIBERO_PICTURES=all` compares all recordings of
../shared/pixels instead of a few.
"""

import json
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import mujoco
import numpy as np
import pytest

from libero.libero import benchmark, get_libero_path
from libero.libero.envs import OffScreenRenderEnv
from libero_env.assets.pack import original_folder
from libero_env.envs.env import LiberoEnv
from libero_env.errors import LiberoError, UnknownNameError

pytestmark = pytest.mark.sim

FEW = ("libero_10-00", "libero_object-02")  # of goal and kitchen, other tests have pictures
CAMERAS = ("agentview", "robot0_eye_in_hand")
SIZE = 64
RECORDED = sorted((Path(__file__).parent / "data").glob("*.npz"))
GEOM, SITE = 5, 6


@pytest.fixture
def original(monkeypatch):
    try:
        folder = original_folder()
    except LiberoError as error:
        pytest.skip(f"the original's whole models are needed: {error}")
    monkeypatch.setenv("LIBERO_ASSETS", str(folder))


@pytest.fixture
def whole(original, make_env):
    """A factory of environments with the original's models, in a recorded state."""

    def make(recorded, **kwargs):
        task = benchmark.get_benchmark_dict()[str(recorded["suite"])]().get_task(int(recorded["task_id"]))
        file = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
        env = make_env(OffScreenRenderEnv, file, camera_heights=SIZE, camera_widths=SIZE, **kwargs)
        for name, pose in json.loads(str(recorded["fixtures"])).items():
            body = env.sim.model.body_name2id(env.env.fixtures_dict[name].root_body)
            env.sim.model.body_pos[body], env.sim.model.body_quat[body] = pose[:3], pose[3:]
        return env

    return make


def assert_drawn(image, wanted, recorded):
    """The same to the bit with the MuJoCo that drew it, and else nearly."""
    difference = np.abs(image.astype(int) - wanted)
    if mujoco.__version__ == str(recorded["mujoco"]):
        assert difference.max() == 0
    assert difference.mean() <= 0.5 and (difference.max(-1) > 2).mean() <= 0.03


def test_pictures_are_the_originals(original, shared):
    paths = sorted((shared / "pixels").glob("*.npz"))
    if os.environ.get("LIBERO_PICTURES") != "all":
        paths = [path for path in paths if path.stem in FEW]
    assert paths
    command = [sys.executable, shared / "pixels" / "compare.py", *paths]  # whole models take memory
    found = subprocess.run(command, capture_output=True, text=True)
    assert found.returncode == 0 and f"{len(paths)}/{len(paths)} recordings agree" in found.stdout, found


def test_native_environments_draw_the_same(original, shared):
    recorded = np.load(shared / "pixels" / "libero_goal-00.npz")
    env = LiberoEnv(f"{recorded['suite']}/{recorded['task_id']}", camera_size=(128, 128))
    poses = json.loads(str(recorded["fixtures"]))
    env.simulations.fixtures[0] = [poses[name] for name in env.scene.fixtures]
    observed = env.set_state(recorded["state"])
    env.close()
    for camera in CAMERAS:  # both drawn in one call
        image = observed[f"{camera.removeprefix('robot0_')}_rgb"][::-1]
        assert_drawn(image, recorded[f"{camera}_128"], recorded)


@pytest.mark.parametrize("path", RECORDED, ids=lambda path: path.stem)
def test_depth_and_segmentation_are_the_originals(whole, path):
    recorded = np.load(path)
    exact = mujoco.__version__ == str(recorded["mujoco"])
    env = whole(recorded, camera_depths=True)
    observed = env.set_init_state(recorded["state"])
    names = element_names(env.sim.model._model)
    for camera in CAMERAS:
        depth, want = observed[f"{camera}_depth"][..., 0], recorded[f"{camera}_depth"]
        near = np.isclose(depth, want, rtol=0, atol=0 if exact else 2e-6)
        assert near.mean() >= (1.0 if exact else 0.99)
        picture = env.sim.render(camera_name=camera, width=SIZE, height=SIZE, segmentation=True)
        found = np.vectorize(lambda kind, index: names.get((kind, index), ""))(*np.moveaxis(picture, -1, 0))
        wanted = np.append(recorded["elements"], "")[recorded[f"{camera}_segmentation"]]
        assert (found == wanted).mean() >= (1.0 if exact else 0.99)


def test_burners_glow_as_the_originals(whole):
    recorded = np.load(next(path for path in RECORDED if "state_on" in np.load(path).files))
    env = whole(recorded)
    off = env.set_init_state(recorded["state"])
    on = env.set_init_state(recorded["state_on"])
    for camera in CAMERAS:
        assert_drawn(on[f"{camera}_image"], recorded[f"{camera}_on"], recorded)
    assert (on["agentview_image"] != off["agentview_image"]).any()


def element_names(model):
    """Names of visual geoms and sites as in experiments/parity/record_pictures.py: (kind, index) -> name."""
    names, count = {}, Counter()
    for geom in range(model.ngeom):
        if model.geom_group[geom] == 1:
            body = model.body(model.geom_bodyid[geom]).name
            names[GEOM, geom] = f"geom:{body}:{count[body]}"
            count[body] += 1
    return names | {(SITE, site): f"site:{model.site(site).name}" for site in range(model.nsite)}


@pytest.mark.parametrize("kind", [None, "element", "instance"])
def test_no_sites_are_drawn_where_observations_have_segmentations(make_env, kind):
    env = make_env(camera_names="robot0_eye_in_hand", camera_segmentations=kind)
    env.reset()
    seen = env.sim.render(128, 128, camera_name="robot0_eye_in_hand", segmentation=True)
    assert (SITE in seen[..., 0]) == (kind is None)


def test_builtin_models_are_drawn_as_natively(make_env, suite):
    env, native = make_env(), LiberoEnv("libero_object/0")
    drawn = env.set_init_state(suite.get_task_init_states(0)[0])
    observed = native.set_state(env.get_sim_state())
    native.close()
    for camera in CAMERAS:
        image = observed[f"{camera.removeprefix('robot0_')}_rgb"]
        assert np.array_equal(drawn[f"{camera}_image"][::-1], image) and image.std() > 10


def test_the_drawing_can_be_asked_for(make_env, monkeypatch):
    envs = [make_env(), make_env(drawing="faithful")]
    monkeypatch.setenv("LIBERO_DRAWING", "faithful")
    envs += [make_env(), make_env(drawing="fast")]
    assert [env.env.drawing for env in envs] == ["fast", "faithful", "faithful", "fast"]
    state = envs[0].reset() and envs[0].get_sim_state()
    seen = [env.set_init_state(state)["agentview_image"].astype(int) for env in envs]
    plain, asked, chosen, overridden = seen
    assert np.array_equal(plain, overridden) and np.array_equal(asked, chosen)
    assert 0 < np.abs(plain - asked).mean() < 10
    for env in envs:
        env.step(np.full(7, 0.3))
        assert np.array_equal(env.get_sim_state(), envs[0].get_sim_state())
    monkeypatch.setenv("LIBERO_DRAWING", "quick")
    with pytest.raises(UnknownNameError, match="LIBERO_DRAWING 'quick'"):
        make_env()
    with pytest.raises(UnknownNameError, match="drawing 'best'"):
        make_env(drawing="best")
