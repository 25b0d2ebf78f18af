"""Edges of the environments: what is refused changes nothing, and what cannot work says so."""

import copy
import multiprocessing as mp
import os
import pickle
import subprocess
import sys
import threading
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError as GymClosed

from libero_env import BatchEnv, LiberoEnv, LiberoError, UnknownNameError
from libero_env.envs import EnvConfig
from libero_env.errors import (
    ActionError,
    ClosedEnvironmentError,
    InvalidInputError,
    RenderError,
    SimulationError,
)
from libero_env.mujoco_compat import mujoco
from libero_env.sim.osc import rotate

TASK = "libero_object/3"
pytestmark = pytest.mark.sim

BAD_VALUES = {
    "horizon": (0, 1.5, True), "camera_size": (0, "64", (0, 1), (1, 2, 3)), "cameras": ("agentview", [3]),
    "control_delta": (1,), "reward_scale": (float("nan"),), "assets": (3,), "drawing": (3,)
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_VALUES)
def test_options_outside_of_their_bounds_are_named_with_their_value(name):
    for value in BAD_VALUES[name]:
        with pytest.raises(InvalidInputError, match=rf"\b{name}.* is "):
            EnvConfig(**{name: value})


def test_options_of_numpy_and_whole_floats_are_made_plain():
    config = EnvConfig(horizon=np.int64(5), camera_size=np.array([32, 48]), reward_scale=np.float32(0.5))
    assert (config.horizon, config.camera_size, config.reward_scale) == (5, (32, 48), 0.5)
    assert {EnvConfig(camera_size=n).camera_size for n in (64, 64.0, np.int64(64), [64, 64])} == {(64, 64)}
    config = EnvConfig(cameras=iter(["agentview"]), observations=["rgb"])
    assert (config.cameras, config.observations) == (("agentview",), ("rgb",))
    with pytest.raises(UnknownNameError, match="strict"):
        EnvConfig(semantics="stric")
    assert type(EnvConfig(horizon=7.0).horizon) is int


@pytest.mark.parametrize(("make", "name"), [
    (lambda: LiberoEnv(None), "task"), (lambda: LiberoEnv(TASK, config={"horizon": 3}), "config"),
    (lambda: BatchEnv(TASK, 0), "num_envs"), (lambda: BatchEnv(TASK, 2, num_threads=-1), "num_threads"),
    (lambda: BatchEnv(TASK, 2, num_threads=10**6), "num_threads"),
])  # fmt: skip
def test_arguments_of_constructors_are_checked(make, name):
    with pytest.raises(InvalidInputError, match=f"^{name} is"):
        make()


def test_simulations_that_do_not_fit_into_memory_are_refused():
    with pytest.raises(LiberoError, match=r"num_envs=1000000000 needs about .* are free: take fewer"):
        BatchEnv(TASK, 10**9, cameras=())


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
    if isinstance(env, LiberoEnv):
        return env.get_state().tobytes(), env.batch.running.tolist(), str(env.np_random.bit_generator.state)
    states = np.array([env.get_state(i) for i in range(env.num_envs)])
    return states.tobytes(), env.running.tolist(), str([g.bit_generator.state for g in env.generators])


def interrupted(*_: object):
    """What a call does during which Ctrl-C is pressed."""
    raise KeyboardInterrupt


SEEDS = (-1, 1.5, "abc", True, [1], np.float64(3), 1j)
INIT_STATES = (99, -1, 1.0, "a", None, [1, 2], True, [], 10**30, {}, [[1], [2, 3]])


def test_refused_resets_change_nothing(env, batch):
    for one in (env, batch):
        one.reset(seed=4)
        before = digest(one)
        for seed in SEEDS:
            with pytest.raises(InvalidInputError, match="seed"):
                one.reset(seed=seed)
        starts = [chosen for chosen in INIT_STATES if (one, chosen) != (batch, [1, 2])]
        refused = [([1], "expected a dictionary"), ("abc", "expected a dictionary")]
        refused += [({"init_state": chosen}, "init_state") for chosen in starts]
        for options, message in [*refused, ({"init_state": 99}, "init_state.*0 to 49")]:
            with pytest.raises(InvalidInputError, match=message):
                one.reset(seed=5, options=options)
        for options in ({"int_state": 1}, {None: 1}, {10**5000: 1}):
            with pytest.raises(UnknownNameError):
                one.reset(seed=5, options=options)
        assert digest(one) == before
    wide = len(batch.get_state(0))
    others = {"reset_mask": ([True], "ab", [0.5, np.nan], [[True, False]], [0, 1])}
    others["outdated_controller"] = (1, "no")
    others["start"] = (3, "a", np.zeros((2, 3)), np.full((2, wide), np.nan), [[1], [1, 2]])
    for name, values in others.items():
        for value in values:
            with pytest.raises(InvalidInputError, match=f"{name}|a start has"):
                batch.reset(seed=5, options={name: value})
    assert digest(batch) == before


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


def test_refused_actions_change_nothing(env):
    env.reset(seed=4)
    before = digest(env)
    for action in [*BAD_ACTIONS, torch.zeros(7, requires_grad=True), torch.zeros(7, dtype=torch.complex64)]:
        with pytest.raises(ActionError, match="actions"):
            env.step(action)
    assert digest(env) == before
    accepted = [torch.zeros(7), np.zeros(7, object), np.ma.masked_array(np.zeros(7)), (0,) * 7, [True] * 7]
    for action in accepted:
        env.step(action)


def test_refused_states_change_nothing(env, batch):
    env.reset(seed=4), batch.reset(seed=4)
    own, short = env.get_state(), env.simulations.physics_state(0)
    bad = [own * np.nan, own[:-1], None, own * 1j, own[None], np.append(own[:-1], 1.5)]
    bad += [np.append(own[:-1], -1.0), own * 1e300, short * np.nan, short + 1e12]
    before = digest(env), digest(batch)
    for state in bad:
        for set_state in (env.set_state, partial(batch.set_state, 1)):
            with pytest.raises(InvalidInputError, match="state"):
                set_state(state)
    for index in (2, -1, 0.5, "a", None, True):
        uses = [lambda i: batch.set_state(i, own), batch.get_state]
        for use in uses if index is None else [*uses, lambda i: batch.render_cameras(i if i == "a" else [i])]:
            with pytest.raises(InvalidInputError, match="index is|indices|index"):
                use(index)
    assert (digest(env), digest(batch)) == before
    batch.set_state(1, short)  # as files of the original have it
    env.set_state(own.astype(object))
    np.testing.assert_array_equal(env.get_state(), own)


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


def test_environments_are_not_copied(env, batch):
    for one in (env, batch):
        for duplicate in (copy.deepcopy, pickle.dumps):
            with pytest.raises(InvalidInputError, match="cannot be copied or pickled"):
                duplicate(one)


DRAWN = {"cameras": ("agentview",), "camera_size": (16, 16)}


def in_thread(name, use):
    thread = threading.Thread(target=use, name=name)
    thread.start()
    thread.join()


def test_images_belong_to_the_thread_that_renders(closing):
    env, first, errors = closing(LiberoEnv(TASK, **DRAWN)), closing(LiberoEnv(TASK, **DRAWN)), []
    env.reset(seed=0)
    state = env.get_state()

    def elsewhere():
        for use in (env.render_cameras, env.close):
            try:
                use()
            except RenderError as error:
                errors.append(str(error))

    in_thread("other", elsewhere)
    assert len(errors) == 2 and "thread 'MainThread'; this is thread 'other'" in errors[0]
    assert "make an environment in each" in errors[0]
    np.testing.assert_array_equal(env.get_state(), state)
    env.render_cameras()
    in_thread("first", first.reset)
    with pytest.raises(RenderError, match="thread 'first', which has ended"):
        first.render_cameras()  # its context cannot be freed, its simulation is


def in_fork(use, answers):
    try:
        use()
        answers.send("done")
    except LiberoError as error:
        answers.send(str(error))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_forked_processes_raise_where_they_would_hang(closing):
    """They inherit neither the threads of a batch nor those of OpenGL."""
    env, many, said = closing(LiberoEnv(TASK, **DRAWN)), closing(BatchEnv(TASK, 2, cameras=())), []
    env.reset(seed=0), many.reset(seed=0)
    uses = [lambda: env.step(np.zeros(7)), lambda: many.step(np.zeros((2, 7)))]
    uses += [lambda: LiberoEnv(TASK, **DRAWN).reset(seed=0), lambda: (env.close(), many.close())]
    for use in uses:
        here, there = mp.Pipe()
        process = mp.get_context("fork").Process(target=in_fork, args=(use, there))
        process.start()
        said.append(here.recv() if here.poll(60.0) else "hangs")
        process.kill()
        process.join()
    assert said[3] == "done" and all("was forked" in text and "spawn" in text for text in said[:3]), said
    env.step(np.zeros(7)), many.step(np.zeros((2, 7)))


@pytest.mark.parametrize("call", ["step", "reset"])
@pytest.mark.parametrize("name", ["env", "batch"])
def test_an_interrupted_step_or_reset_ends_the_episode(name, call, request, monkeypatch):
    one, batch = request.getfixturevalue(name), name == "batch"
    action, state = np.zeros((2, 7) if batch else 7), partial(one.get_state, *[0] * batch)
    one.reset(seed=0)
    before = state()
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(one.simulations, "_substeps", interrupted)
        patch.setattr(one.simulations, "_start", interrupted)
        one.step(action) if call == "step" else one.reset(seed=1)
    if batch:
        assert not one.running.any()
    else:
        with pytest.raises(LiberoError, match="interrupted; call reset"):
            one.step(action)
    one.reset(seed=0)
    np.testing.assert_array_equal(state(), before)
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


@pytest.mark.parametrize("variables", NO_GL, ids=lambda one: " ".join(one.values()))
def test_only_what_is_drawn_needs_opengl(variables):
    environ = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "PYOPENGL_PLATFORM")} | variables
    options = {"env": environ, "capture_output": True, "text": True, "check": False}
    done = subprocess.run([sys.executable, "-c", DRAW], **options)
    assert done.returncode == 0, done.stderr
    (line,), wrong = done.stdout.splitlines(), next(reversed(variables))
    assert line.startswith("RenderError") and (wrong in line) and "valid" in line or "Remedy" in line
    told = subprocess.run([sys.executable, "-m", "libero_cli", "doctor", "--gl"], **options)
    assert told.returncode == 1 and told.stdout.startswith("FAIL  GL:") and not told.stderr


def test_rotations_whose_squares_vanish_are_none():
    current, out = np.linspace(-1.0, 1.0, 9), np.empty(9)
    for small in (1e-320, 1e-170, -1e-300, 5e-324):
        rotate(np.array([small, 0.0, -small]), current, out)
        np.testing.assert_array_equal(out, current)


@pytest.mark.parametrize("steps", [0, 1])
def test_a_simulation_that_diverges_ends_its_episode_with_an_error(steps, closing):
    """It is neither a success nor a failure, and the others go on; MuJoCo itself resets it with a warning only."""
    pair, alone = (closing(BatchEnv(TASK, num, cameras=())) for num in (2, 1))
    env = closing(LiberoEnv(TASK, cameras=()))
    for one in (pair, alone, env):
        one.reset(options={"init_state": 0})
    for _ in range(steps):
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
    shown, options = [], mujoco.MjvOption()

    def launch_passive(model, data):
        assert model.nq == data.qpos.size
        shown.append("opened")
        window = {"sync": lambda: shown.append(data.time), "close": lambda: shown.append("closed")}
        return SimpleNamespace(opt=options, **window)

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch_passive)
    env = LiberoEnv(TASK, cameras=(), render_mode="human")
    env.reset(seed=1)
    env.step(np.zeros(7))
    assert env.render() is None
    env.close()
    env.close()
    opened, start, moved, *others = shown
    assert opened == "opened" and moved - start == pytest.approx(0.05) and others == [moved, "closed"]
    assert not options.geomgroup[0]
