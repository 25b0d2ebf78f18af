"""All 130 tasks can be built, start as their files state, and accept the states of the original."""

import json

import numpy as np
import pytest

from libero_env.assets.pack import select_pack
from libero_env.init_states import load_init_states, start_errors
from libero_env.init_states.pickles import read_states
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import build_scene
from libero_env.sim.state import StateView
from libero_env.tasks import Atom, get_suite, get_task, suite_names

pytestmark = pytest.mark.sim

TASKS = sorted({task.id for name in suite_names() for task in get_suite(name).tasks})
PREDICATE_RECORDINGS = (
    "libero_10-03", "libero_10-08", "libero_90-01", "libero_90-70", "libero_goal-01", "libero_object-00",
    "libero_spatial-02"
)  # fmt: skip
IDLE_STEPS = 10
STILL = 0.005  # m, what may move in the idle steps
FARTHER = 0.02  # m, what may move farther than with the original's models


@pytest.fixture(scope="module")
def settling(shared) -> dict:
    """Motion of objects in the original, task -> record."""
    return json.loads((shared / "official" / "settling.json").read_text())


def idle(simulations: LoopSimulations) -> None:
    for _ in range(IDLE_STEPS):
        simulations.step([0], np.zeros((1, 7)))


def moved(view: StateView, before: dict[str, np.ndarray]) -> dict[str, float]:
    return {name: float(np.linalg.norm(view.body_pos(name) - pos)) for name, pos in before.items()}


@pytest.mark.parametrize("key", TASKS)
def test_init_states_are_at_rest_in_the_regions_of_the_task(key):
    task = get_task(key)
    scene = build_scene(task.problem)
    rows = load_init_states(task, scene)
    assert len(rows) == 50 and len(np.unique(rows, axis=0)) == 50
    qpos, qvel, fixtures = scene.split_states(rows)
    simulations = LoopSimulations(scene.model, 1, scene.fixture_bodies)
    view = StateView(scene, simulations)
    for i in np.random.default_rng(TASKS.index(key)).choice(50, 2, replace=False):
        simulations.reset([0], qpos[[i]], qvel[[i]], fixtures=fixtures[[i]])
        assert start_errors(view) == []
        assert not evaluate(task.problem.goal, view)
        before = {name: view.body_pos(name) for name in scene.objects}
        idle(simulations)
        assert max(moved(view, before).values()) < STILL
        assert start_errors(view) == []


@pytest.mark.parametrize("key", TASKS)
def test_states_of_the_original_fit(shared, settling, key):
    task = get_task(key)
    scene = build_scene(task.problem)
    suite, record = task.suite, settling[key]
    assert 1 + scene.model.nq + scene.model.nv == record["state_size"]
    rows = read_states(shared / "official" / "init_files" / suite / f"{task.name}.pruned_init")
    qpos, qvel, _ = scene.split_states(rows)
    simulations = LoopSimulations(scene.model, 1, scene.fixture_bodies)
    view = StateView(scene, simulations)
    for i in (0, 20):
        simulations.reset([0], qpos[[i]], qvel[[i]])
        assert not evaluate(task.problem.goal, view)
        before = {name: view.body_pos(name) for name in scene.objects}
        idle(simulations)
        assert not evaluate(task.problem.goal, view)
        for name, distance in moved(view, before).items():
            assert distance < record["drift_m"][name] + FARTHER, name


@pytest.mark.parametrize("original", [False, True], ids=["builtin", "original"])
@pytest.mark.parametrize("recording", PREDICATE_RECORDINGS)
def test_predicates_agree_with_recordings(shared, recording, original):
    """Regions agree exactly; of all, at least 999 of 1,000: contacts differ between versions of MuJoCo."""
    with np.load(shared / "parity" / f"{recording}-predicates.npz") as z:
        states, atoms, truth = z["qpos"], json.loads(str(z["atoms"])), z["truth"]
        poses, key = json.loads(str(z["fixtures"])), f"{z['suite']}/{int(z['task_id'])}"
    pack = select_pack(shared / "official" / "assets") if original else None
    scene = build_scene(get_task(key).problem, pack)
    fixtures = np.array([poses[name] for name in scene.fixtures]).reshape(1, -1, 7)
    simulations = LoopSimulations(scene.model, 1, scene.fixture_bodies)
    view = StateView(scene, simulations)
    goals = [Atom(name.capitalize(), tuple(args)) for name, *args in atoms]
    in_regions, told = [name == "in" or args[-1].startswith("floor_") for name, *args in atoms], []
    for qpos in states:
        simulations.reset([0], qpos[None], np.zeros((1, scene.model.nv)), fixtures=fixtures)
        told.append([evaluate(goal, view) for goal in goals])
    agree = np.array(told) == truth.astype(bool)
    assert np.mean(agree) > 0.999 and agree[:, in_regions].all()
