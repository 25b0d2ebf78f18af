"""Task files by their name, and the window of `has_renderer`."""

import mujoco.viewer
import pytest

from libero.libero.envs.bddl_utils import task_file

NAME = "open_the_middle_drawer_of_the_cabinet.bddl"
BLIND = {"use_camera_obs": False, "has_offscreen_renderer": False}


def test_a_task_file_is_found_by_its_name(tmp_path, suite):
    there = tmp_path / NAME
    assert task_file(NAME).endswith(f"/libero_goal/{NAME}")
    assert task_file(f"./libero/libero/bddl_files/libero_goal/{NAME}") == task_file(NAME)
    assert task_file(suite.get_task(3).bddl_file) == suite.get_task_bddl_file_path(3)
    # nothing is guessed: a file that is missing elsewhere, of another suite, or of no task
    for name in (there, f"libero/bddl_files/libero_10/{NAME}", "my_task.bddl", "libero_goal/my_task.bddl"):
        assert task_file(name) == str(name)
    there.write_text("")
    assert task_file(there) == str(there)


class Viewer:
    """Stands for MuJoCo's viewer, which needs a screen."""

    def __init__(self, model, data, **_):
        self.cam, self.synced, self.running = type("Camera", (), {})(), 0, True

    def is_running(self):
        return self.running

    def sync(self):
        self.synced += 1

    def close(self):
        self.running = False


@pytest.mark.sim
def test_a_window_shows_what_render_draws(make_env, monkeypatch):
    opened = []
    monkeypatch.setenv("DISPLAY", ":0")
    launch = lambda *a, **k: opened.append(Viewer(*a, **k)) or opened[-1]  # noqa: E731
    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    env = make_env(has_renderer=True, render_camera="agentview", **BLIND)
    env.reset()
    env.env.render()
    env.env.render()
    (viewer,) = opened
    assert viewer.synced == 2
    assert viewer.cam.fixedcamid == env.sim.model.camera_name2id("agentview")
    viewer.running = False  # closed by hand: it stays closed, and the script continues
    env.env.render()
    assert (len(opened), viewer.synced) == (1, 2)
    env.close()
    env.close()


@pytest.mark.sim
def test_without_a_screen_there_is_one_warning(make_env, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    env = make_env(has_renderer=True, **BLIND)
    obs = env.reset()
    with pytest.warns(UserWarning, match="no screen") as caught:
        env.env.render()
        env.env.render()
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert env.get_observation().keys() == obs.keys()
    env.env.render()


@pytest.mark.sim
def test_without_has_renderer_render_does_nothing(make_env):
    env = make_env(**BLIND)
    env.reset()
    env.env.render()
