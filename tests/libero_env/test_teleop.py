"""Teleoperation by a scripted user: key events become actions, episodes and a demonstration file."""

import json
import struct
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

from libero_cli import main as cli
from libero_env.demos.read import read_demos
from libero_env.demos.replay import replay
from libero_env.sim.render import renderer_name
from libero_env.tasks import get_task
from libero_env.teleop import screens as teleop_screens
from libero_env.teleop.screens import MouseReader, as_text, key_name, press_typed
from libero_env.teleop.session import (
    GRIPPER,
    MOTIONS,
    QUIT,
    RESET,
    Keyboard,
    SpaceMouse,
    Teleop,
    record_session,
)

TASK = "libero_90/0"  # KITCHEN_SCENE10_close_the_top_drawer_of_the_cabinet
# (x, y, z) for the gripper, m: before the open drawer, down to its front, and against it
WAY = ((0.0, 0.08, 1.17), (0.0, 0.08, 1.11), (0.0, -0.3, 1.11))


@pytest.mark.parametrize("key", MOTIONS)
def test_a_key_moves_along_one_axis(key):
    keyboard = Keyboard()
    keyboard.press(key.upper())
    entry, direction = MOTIONS[key]
    expected = np.zeros(7)
    expected[entry], expected[6] = direction * (1.0 if entry < 3 else 0.15), -1.0
    assert np.allclose(keyboard.action(), expected)


def test_keys_are_those_of_robosuite():
    """Its keyboard device: w, a, f towards smaller coordinates; the rotation vector as `input2action` turns it."""
    down = {key for key, (_, direction) in MOTIONS.items() if direction < 0}
    assert down == set("wafzgc")
    assert {key: entry for key, (entry, _) in MOTIONS.items()} == dict(
        zip("wsadfrzxtgcv", (0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5), strict=True)
    )


def test_taps_and_held_keys():
    keyboard = Keyboard(pos_sensitivity=0.1)
    keyboard.press("d")
    assert [keyboard.action()[1] for _ in range(3)] == [0.375, 0.375, 0.0]
    keyboard.press("d", held=True)
    keyboard.press("s", held=True)
    assert all(np.allclose(keyboard.action()[:3], (0.375, 0.375, 0.0)) for _ in range(20))
    keyboard.release("d")
    assert np.allclose(keyboard.action()[:2], (0.375, 0.375)), "a short tap is not lost"
    assert np.allclose(keyboard.action()[:2], (0.375, 0.0))
    keyboard.press("w", held=True)
    assert keyboard.action()[0] == 0.0, "opposite keys cancel"
    keyboard.press("m")
    assert keyboard.command is None
    full = Keyboard(pos_sensitivity=0.27)  # as the help of --pos-sensitivity says
    full.press("d")
    assert full.action()[1] == 1.0


def test_gripper_and_commands():
    keyboard = Keyboard()
    for expected in (1.0, -1.0, 1.0):
        keyboard.press(GRIPPER)
        assert keyboard.action()[6] == expected
    keyboard.restart()
    assert keyboard.action()[6] == -1.0
    for key in (RESET, QUIT):
        keyboard.press(key)
        assert keyboard.command == key


def test_reports_of_a_mouse():
    mouse = SpaceMouse()
    mouse.report(struct.pack("<B6h", 1, 350, 175, -700, 70, 0, -35))
    assert np.allclose(mouse.action(), (0.3125, 0.625, 0.625, 0.0, 0.05, 0.025, -1.0))
    mouse.report(struct.pack("<B3h", 1, 0, 0, 0))
    mouse.report(struct.pack("<B3h", 2, 0, 350, 0))
    mouse.report(struct.pack("<BH", 3, 1))
    assert np.allclose(mouse.action(), (0.0, 0.0, 0.0, 0.25, 0.0, 0.0, 1.0))
    mouse.report(struct.pack("<BH", 3, 0))
    mouse.press("s")
    assert np.allclose(mouse.action(), (1.0, 0.0, 0.0, 0.25, 0.0, 0.0, -1.0))
    mouse.report(struct.pack("<BH", 3, 2))
    mouse.report(b"")
    assert mouse.command == RESET


def test_a_mouse_hands_on_all_reports_that_are_pending(monkeypatch):
    opened, reports = [], [struct.pack("<Bhhh", 1, 0, 350, 0), struct.pack("<BH", 3, 1), b""]
    device = SimpleNamespace(
        open=lambda *ids: opened.append(ids), set_nonblocking=bool, read=lambda _: reports.pop(0)
    )
    monkeypatch.setitem(teleop_screens.sys.modules, "hid", SimpleNamespace(device=lambda: device))
    mouse = MouseReader(2.0, 1.0, vendor_id=5)
    mouse.poll()
    assert opened == [(5, 50741)] and not reports
    assert np.allclose(mouse.action(), (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def test_keys_of_windows_and_terminals():
    assert [key_name(code) for code in (256, 32, ord("W"), ord("Q"), ord("M"), 300)] == [
        QUIT, GRIPPER, "w", "q", None, None
    ]  # fmt: skip
    keyboard = Keyboard()
    press_typed(keyboard, "\x1b[A")
    assert (keyboard.command, keyboard.steps) == (None, {})
    press_typed(keyboard, "wd")
    assert keyboard.steps.keys() == {"w", "d"}
    press_typed(keyboard, "\x1b")
    assert keyboard.command == QUIT


def test_images_as_text():
    picture = np.zeros((4, 2, 3), np.uint8)
    picture[1, 0] = (1, 2, 3)
    lines = as_text(picture).split("\n")
    assert len(lines) == 2
    assert "\x1b[38;2;0;0;0m\x1b[48;2;1;2;3m▀" in lines[0]
    assert lines[0].count("▀") == 2


class User:
    """Scripted user that looks at the position of the gripper and taps one key per control step."""

    def __init__(self, keyboard, way=WAY, give_up_after=1000, resets_at=()):
        self.keyboard, self.way, self.goals, self.clock = keyboard, way, list(way), 0
        self.give_up_after, self.resets_at, self.shown = give_up_after, resets_at, []

    def poll(self, env):
        self.clock += 1
        if self.clock > self.give_up_after:
            return self.keyboard.press(QUIT)
        if self.clock in self.resets_at:
            self.goals = list(self.way)
            return self.keyboard.press(RESET)
        if not self.keyboard.closed:
            self.goals = list(self.way)  # a new episode
            return self.keyboard.press(GRIPPER)
        away = np.subtract(self.goals[0], env.proprioception()["ee_pos"][0])
        if np.abs(away).max() < 0.02 and len(self.goals) > 1:
            self.goals.pop(0)
        axis = int(np.abs(away).argmax())
        self.keyboard.press(("ws", "ad", "fr")[axis][int(away[axis] > 0)])
        return None

    def show(self, env, status):
        self.shown.append(status)

    def close(self):
        """Nothing."""


@pytest.fixture
def session():
    made = []

    def make(**kwargs):
        keyboard = Keyboard(pos_sensitivity=0.1)
        made.append(Teleop(get_task(TASK), keyboard, User(keyboard, **kwargs), seed=3))
        return made[-1]

    yield make
    for teleop in made:
        teleop.close()


@pytest.mark.sim
def test_an_episode_ends_when_the_goal_has_held(session):
    teleop = session()
    recording = teleop.episode()
    assert len(recording.actions) == len(recording.states) > 20
    assert np.abs(recording.actions).max() <= 1.0
    truths = [all(status.progress.values()) for status in teleop.screen.shown]
    assert truths[-10:] == [True] * 10
    assert not truths[-11]
    assert recording.fixtures.shape == (1, 7)


@pytest.mark.sim
def test_restarting_drops_the_episode_and_stopping_ends_the_session(session):
    teleop = session(resets_at=(5,))
    recording = teleop.episode()
    steps = [status.step for status in teleop.screen.shown]
    assert steps[:6] == [1, 2, 3, 4, 1, 2]
    assert len(recording.actions) == steps[-1]
    stopped = session(give_up_after=3)
    assert stopped.episode() is None
    assert len(stopped.screen.shown) == 3


@pytest.mark.sim
def test_recorded_episodes_are_demonstrations(session, tmp_path):
    renderer_name()
    file, lines = tmp_path / "by_hand.hdf5", []
    assert record_session(session(), file, 1, size=(16, 16), report=lines.append) == 1
    assert record_session(session(), file, 2, size=(16, 16), report=lines.append) == 2
    assert [line.partition(":")[0] for line in lines] == ["demonstration 0", "demonstration 1"]
    first, second = read_demos(file)
    assert first.success
    assert first.obs["agentview_rgb"].shape == (len(first), 16, 16, 3)
    assert not np.array_equal(first.states[0], second.states[0])
    with h5py.File(file) as handle:
        attrs = handle["data"].attrs
        assert attrs["generator"] == "teleoperation"
        assert json.loads(attrs["problem_info"])["language_instruction"] == get_task(TASK).language
    assert [found.success for found in replay(file)] == [True, True]


@pytest.mark.sim
def test_the_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(
        teleop_screens, "open_screen", lambda kind, keyboard, *_: User(keyboard, give_up_after=2)
    )
    out = tmp_path / "mine.hdf5"
    assert cli.main(["teleop", TASK, "--out", str(out), "--pos-sensitivity", "0.1"]) == 1
    assert not out.exists()
    monkeypatch.setattr(teleop_screens, "open_screen", lambda kind, keyboard, *_: User(keyboard))
    assert cli.main(["teleop", TASK, "--out", str(out), "--pos-sensitivity", "0.1", "--size", "16"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"{out}: 1 of 1 demonstrations"
    assert len(read_demos(out)) == 1
