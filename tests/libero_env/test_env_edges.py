"""Edges of the environments: what is refused changes nothing, and what cannot work says so."""

import copy
import multiprocessing as mp
import os
import pickle
import subprocess
import sys
import threading

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError as GymClosed

from libero_env import BatchEnv, LiberoEnv
from libero_env.envs import EnvConfig
from libero_env.errors import (
    ActionError,
    ClosedEnvironmentError,
    InvalidInputError,
    LiberoError,
    RenderError,
    SimulationError,
    UnknownNameError,
)
from libero_env.mujoco_compat import mujoco
from libero_env.sim.osc import rotate

TASK = "libero_object/3"

BAD_VALUES = {
    "horizon": (0, 1.5, True),
    "camera_size": (0, True, "64", (0, 1), (1, 2, 3)),
    "cameras": ("agentview", [3]),
    "control_delta": (1,),
    "reward_scale": (float("nan"),),
    "assets": (3,),
    "drawing": (3,),
}


@pytest.mark.parametrize("name", BAD_VALUES)
def test_options_outside_of_their_bounds_are_named_with_their_value(name):
    for value in BAD_VALUES[name]:
        with pytest.raises(InvalidInputError, match=rf"\b{name}.* is "):
            EnvConfig(**{name: value})


def test_options_of_numpy_and_whole_floats_are_made_plain():
    config = EnvConfig(horizon=np.int64(5), camera_size=np.array([32, 48]), reward_scale=np.float32(0.5))
    assert (config.horizon, config.camera_size, config.reward_scale) == (5, (32, 48), 0.5)
    assert all(
        EnvConfig(camera_size=size).camera_size == (64, 64) for size in (64, 64.0, np.int64(64), [64, 64])
    )
    assert EnvConfig(cameras=iter(["agentview"])).cameras == ("agentview",)
    assert EnvConfig(observations=["rgb"]).observations == ("rgb",)
    with pytest.raises(UnknownNameError, match="strict"):
        EnvConfig(semantics="stric")
    assert type(EnvConfig(horizon=7.0).horizon) is int


def test_arguments_of_constructors_are_checked():
    with pytest.raises(InvalidInputError, match="^task is"):
        LiberoEnv(None, cameras=())
    with pytest.raises(InvalidInputError, match="^num_envs is"):
        BatchEnv(TASK, 0, cameras=())
    for threads in (-1, 10**6):
        with pytest.raises(InvalidInputError, match="^num_threads is"):
            BatchEnv(TASK, 2, num_threads=threads, cameras=())
    with pytest.raises(InvalidInputError, match="^config is"):
        LiberoEnv(TASK, config={"horizon": 3})


@pytest.mark.sim
def test_simulations_that_do_not_fit_into_memory_are_refused():
    with pytest.raises(LiberoError, match=r"num_envs=1000000000 needs about .* are free: take fewer"):
        BatchEnv(TASK, 10**9, cameras=())


@pytest.mark.sim
def test_names_of_gymnasium_take_the_same_checks():
    import libero_env.registration  # noqa: F401 - registers the tasks

    with pytest.raises(InvalidInputError, match="horizon is 0; expected greater than or equal to 1"):
        gymnasium.make("libero/libero_object-3", horizon=0, cameras=())


@pytest.fixture(scope="module")
def env():
    with LiberoEnv(TASK, cameras=()) as made:
        yield made


@pytest.fixture(scope="module")
def batch():
    with BatchEnv(TASK, 2, cameras=()) as made:
        yield made


def digest(env):
    """All that the future of an environment depends on."""
    if isinstance(env, BatchEnv):
        states = [env.get_state(i) for i in range(env.num_envs)]
        return (
            np.array(states).tobytes(),
            env.running.tolist(),
            str([g.bit_generator.state for g in env.generators]),
        )
    return env.get_state().tobytes(), env.batch.running.tolist(), str(env.np_random.bit_generator.state)


def interrupted(*_: object):
    """What a call does during which Ctrl-C is pressed."""
    raise KeyboardInterrupt


SEEDS = (-1, 1.5, "abc", True, [1], np.float64(3), 1j)
INIT_STATES = (99, -1, 1.0, "a", None, [1, 2], True, [], 10**30, {}, [[1], [2, 3]])


@pytest.mark.sim
def test_refused_resets_change_nothing(env, batch):
    for one in (env, batch):
        one.reset(seed=4)
        before = digest(one)
        for seed in SEEDS:
            with pytest.raises(InvalidInputError, match="seed"):
                one.reset(seed=seed)
        for chosen in INIT_STATES:
            if (one, chosen) != (batch, [1, 2]):
                with pytest.raises(
                    InvalidInputError, match="init_state.*0 to 49" if chosen == 99 else "init_state"
                ):
                    one.reset(seed=5, options={"init_state": chosen})
        for options in ([1], "abc", 3, [("init_state", 0)]):
            with pytest.raises(InvalidInputError, match="expected a dictionary"):
                one.reset(seed=5, options=options)
        for options in ({"int_state": 1}, {1: 2}, {None: 1}, {10**5000: 1}):
            with pytest.raises(UnknownNameError):
                one.reset(seed=5, options=options)
        assert digest(one) == before
    wide = len(batch.get_state(0))
    masks = ([True], "ab", [0.5, np.nan], [[True, False]], [0, 1])
    others = {"reset_mask": masks, "outdated_controller": (1, "no")}
    others["start"] = (3, "a", np.zeros((2, 3)), np.full((2, wide), np.nan), [[1], [1, 2]])
    for name, values in others.items():
        for value in values:
            with pytest.raises(InvalidInputError, match=f"{name}|a start has"):
                batch.reset(seed=5, options={name: value})
    assert digest(batch) == before


@pytest.mark.sim
def test_seeds_of_any_integer_type_are_the_same(env):
    states = []
    for seed in (3, np.int64(3), np.uint8(3), np.array(3)):
        env.reset(seed=seed)
        states.append(env.get_state())
    assert (np.array(states) == states[0]).all()
    env.reset(seed=2**200)


BAD_ACTIONS = [np.zeros(7) * 1j, [None] * 7, ["1"] * 7, None, {}, np.zeros(8), np.zeros((1, 7)), [np.nan] * 7]
BAD_ACTIONS += [[10**400] * 7, [[1], [2, 3]], np.zeros(7, "m8[s]"), np.array([object()] * 7)]
BAD_ACTIONS += [np.ma.masked_array(np.zeros(7), mask=[0] * 6 + [1])]


@pytest.mark.sim
def test_refused_actions_change_nothing(env):
    import torch

    env.reset(seed=4)
    before = digest(env)
    for action in [*BAD_ACTIONS, torch.zeros(7, requires_grad=True), torch.zeros(7, dtype=torch.complex64)]:
        with pytest.raises(ActionError, match="actions"):
            env.step(action)
    assert digest(env) == before
    for action in (
        torch.zeros(7), [True] * 7, np.zeros(7, object), np.ma.masked_array(np.zeros(7)), (0,) * 7
    ):  # fmt: skip
        env.step(action)


@pytest.mark.sim
def test_refused_states_change_nothing(env, batch):
    env.reset(seed=4), batch.reset(seed=4)
    own, short = env.get_state(), env.simulations.physics_state(0)
    bad = [own * np.nan, own[:-1], None, own * 1j, own[None], np.append(own[:-1], 1.5)]
    bad += [np.append(own[:-1], -1.0), own * 1e300, short * np.nan, short + 1e12]
    before = digest(env), digest(batch)
    for state in bad:
        with pytest.raises(InvalidInputError, match="state"):
            env.set_state(state)
        with pytest.raises(InvalidInputError, match="state"):
            batch.set_state(1, state)
    for index in (2, -1, 0.5, "a", None, True):
        with pytest.raises(InvalidInputError, match="index is"):
            batch.set_state(index, own)
        with pytest.raises(InvalidInputError, match="index is"):
            batch.get_state(index)
        if index is not None:
            with pytest.raises(InvalidInputError, match="indices|index"):
                batch.render_cameras(index if index == "a" else [index])
    assert (digest(env), digest(batch)) == before
    batch.set_state(1, short)  # as files of the original have it
    env.set_state(own.astype(object))
    np.testing.assert_array_equal(env.get_state(), own)


@pytest.mark.sim
def test_after_close_every_method_says_so():
    single, many = LiberoEnv(TASK, cameras=(), render_mode="rgb_array"), BatchEnv(TASK, 2, cameras=())
    single.reset(seed=0), many.reset(seed=0)
    state, view = single.get_state(), single.view
    for env in (single, many):
        env.close()
        env.close()
    uses = [single.reset, single.render, single.get_state, single.render_cameras]
    uses += [lambda: single.step(np.zeros(7)), lambda: single.set_state(state)]
    uses += [many.reset, many.render, many.render_cameras, lambda: many.step(np.zeros((2, 7)))]
    uses += [lambda: many.get_state(0), lambda: many.set_state(0, state)]
    for use in uses:
        with pytest.raises(GymClosed, match="closed; make") as caught:
            use()
        assert isinstance(caught.value, ClosedEnvironmentError)
    inner = [lambda: view.eef_pos, lambda: many.check_goal(0), many.proprioception]
    inner += [lambda: single.simulations.step([0], np.zeros((1, 7))), lambda: many.simulations.data(0)]
    inner += [lambda: many.simulations.time(0), lambda: single.observer.render(0, "agentview")]
    for use in inner:
        with pytest.raises(ClosedEnvironmentError):
            use()
    assert single.action_space.sample().shape == (7,)


@pytest.mark.sim
def test_environments_are_not_copied(env, batch):
    for one in (env, batch):
        for duplicate in (copy.deepcopy, pickle.dumps):
            with pytest.raises(InvalidInputError, match="cannot be copied or pickled"):
                duplicate(one)


@pytest.mark.sim
def test_images_belong_to_the_thread_that_renders():
    env = LiberoEnv(TASK, cameras=("agentview",), camera_size=(16, 16))
    env.reset(seed=0)
    state, errors = env.get_state(), []

    def elsewhere():
        for use in (env.render_cameras, env.close):
            try:
                use()
            except RenderError as error:
                errors.append(str(error))

    thread = threading.Thread(target=elsewhere, name="other")
    thread.start()
    thread.join()
    assert len(errors) == 2
    assert (
        "thread 'MainThread'; this is thread 'other'" in errors[0]
        and "make an environment in each" in errors[0]
    )
    np.testing.assert_array_equal(env.get_state(), state)
    env.render_cameras()
    env.close()
    first = LiberoEnv(TASK, cameras=("agentview",), camera_size=(16, 16))
    thread = threading.Thread(target=first.reset, name="first")
    thread.start()
    thread.join()
    with pytest.raises(RenderError, match="thread 'first', which has ended"):
        first.render_cameras()
    first.close()  # its context cannot be freed, its simulation is


def in_fork(use, answers):
    try:
        use()
        answers.send("done")
    except LiberoError as error:
        answers.send(str(error))


@pytest.mark.sim
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forked_processes_raise_where_they_would_hang():
    """They inherit neither the threads of a batch nor those of OpenGL."""
    env = LiberoEnv(TASK, cameras=("agentview",), camera_size=(16, 16))
    many = BatchEnv(TASK, 2, cameras=())
    env.reset(seed=0), many.reset(seed=0)
    uses = [
        lambda: env.step(np.zeros(7)),
        lambda: many.step(np.zeros((2, 7))),
        lambda: LiberoEnv(TASK, cameras=("agentview",), camera_size=(16, 16)).reset(seed=0),
        lambda: (env.close(), many.close()),
    ]
    said = []
    for use in uses:
        here, there = mp.Pipe()
        process = mp.get_context("fork").Process(target=in_fork, args=(use, there))
        process.start()
        said.append(here.recv() if here.poll(60.0) else "hangs")
        process.kill()
        process.join()
    assert said[3] == "done" and all("was forked" in text and "spawn" in text for text in said[:3]), said
    env.step(np.zeros(7)), many.step(np.zeros((2, 7)))
    env.close(), many.close()


@pytest.mark.sim
def test_an_interrupted_step_or_reset_ends_the_episode(env, batch, monkeypatch):
    for one, action in ((env, np.zeros(7)), (batch, np.zeros((2, 7)))):
        one.reset(seed=0)
        state = one.get_state(*(() if one is env else (0,)))
        for call in (lambda one=one, action=action: one.step(action), lambda one=one: one.reset(seed=1)):
            with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
                patch.setattr(one.simulations, "_substeps", interrupted)
                patch.setattr(one.simulations, "_start", interrupted)
                call()
            if one is env:
                with pytest.raises(LiberoError, match="interrupted; call reset"):
                    one.step(action)
            else:
                assert not one.running.any()
        one.reset(seed=0)
        np.testing.assert_array_equal(one.get_state(*(() if one is env else (0,))), state)
        one.step(action)


NO_GL = [{"MUJOCO_GL": name} for name in ("wgl", " OFF ")]  # of another system, and none
NO_GL += [{"MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "osmesa"}, {"MUJOCO_EGL_DEVICE_ID": "99"}]
DRAW = """
from libero_env import LiberoEnv
env = LiberoEnv("libero_object/3", cameras=())
env.reset(seed=0)
env.step([0.0] * 7)
try:
    env.observer.render(0, "agentview")
except Exception as error:
    print(type(error).__name__, error)
"""


@pytest.mark.sim
@pytest.mark.parametrize("variables", NO_GL, ids=lambda one: " ".join(one.values()))
def test_only_what_is_drawn_needs_opengl(variables):
    environ = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")} | variables
    done = subprocess.run(
        [sys.executable, "-c", DRAW], env=environ, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    wrong = next(reversed(variables))
    assert line.startswith("RenderError") and (wrong in line) and "valid" in line or "Remedy" in line
    command = [sys.executable, "-m", "libero_cli", "doctor", "--gl"]
    told = subprocess.run(command, env=environ, capture_output=True, text=True, check=False)
    assert told.returncode == 1 and told.stdout.startswith("FAIL  GL:") and not told.stderr


def test_rotations_whose_squares_vanish_are_none():
    current, out = np.linspace(-1.0, 1.0, 9), np.empty(9)
    for small in (1e-320, 1e-170, -1e-300, 5e-324):
        rotate(np.array([small, 0.0, -small]), current, out)
        np.testing.assert_array_equal(out, current)


@pytest.mark.sim
def test_steps_with_vanishing_rotations_are_steps_without(env):
    states = []
    for rotation in ((0.0, 0.0, 0.0), (1e-170, 0.0, 1e-300)):
        env.reset(seed=0)
        env.step([0.1, 0.0, 0.0, *rotation, 1.0])
        states.append(env.get_state())
    np.testing.assert_allclose(*states, atol=1e-9)


@pytest.mark.sim
@pytest.mark.parametrize("first", [True, False], ids=["first step", "later"])
def test_a_simulation_that_diverges_ends_its_episode_with_an_error(first):
    """It is neither a success nor a failure, and the others go on; MuJoCo itself resets it with a warning only."""
    with (
        BatchEnv(TASK, 2, cameras=()) as pair,
        BatchEnv(TASK, 1, cameras=()) as alone,
        LiberoEnv(TASK, cameras=()) as env,
    ):
        for one in (pair, alone, env):
            one.reset(options={"init_state": 0})
        if not first:
            pair.step(np.zeros((2, 7))), env.step(np.zeros(7))
        for one in (pair, env):
            one.simulations.fields["qvel"][-1, 12] = np.nan
        with pytest.raises(SimulationError, match="simulation 0: it has diverged"):
            env.step(np.zeros(7))
        with pytest.raises(LiberoError, match="no episode is running"):
            env.step(np.zeros(7))
        _, _, terminated, truncated, info = pair.step(np.zeros((2, 7)))
        assert list(info["errors"]) == [1] and "diverged" in info["errors"][1]
        assert not terminated.any() and truncated.tolist() == [False, True] == (~pair.running).tolist()
        _, info = pair.reset(options={"init_state": 0, "reset_mask": [False, True]})
        assert "errors" not in info and pair.running.all()
        np.testing.assert_array_equal(pair.get_state(1), alone.get_state(0))


def test_a_window_shows_every_step_of_human_mode(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    with pytest.raises(RenderError, match="no window: neither DISPLAY nor WAYLAND_DISPLAY names a screen"):
        LiberoEnv(TASK, cameras=(), render_mode="human")
    monkeypatch.setenv("DISPLAY", ":0")
    shown = []

    class Window:
        opt = mujoco.MjvOption()

        def sync(self):
            shown.append(data[0].time)

        def close(self):
            shown.append("closed")

    data = []

    def launch_passive(model, state):
        assert model.nq == state.qpos.size and not data
        data.append(state)
        return Window()

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch_passive)
    env = LiberoEnv(TASK, cameras=(), render_mode="human")
    env.reset(seed=1)
    env.step(np.zeros(7))
    assert env.render() is None
    env.close()
    env.close()
    start, moved = shown[0], shown[1]
    assert moved - start == pytest.approx(0.05) and shown[2:] == [moved, "closed"]
    assert not Window.opt.geomgroup[0]
