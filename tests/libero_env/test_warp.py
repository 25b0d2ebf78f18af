"""The back end `warp` is the same environment as `mujoco`: states, truths, episodes, and what it does not offer."""

import os

import numpy as np
import pytest

from libero_env.demos.config import DemoConfig
from libero_env.demos.contents import read_header
from libero_env.demos.generate import RecordingJob, demo_path, make_demos
from libero_env.envs.batch import BatchEnv
from libero_env.errors import InvalidInputError, LiberoError, SimulationError, UnknownNameError
from libero_env.expert import Expert, Shapes
from libero_env.expert.expert import run_experts
from libero_env.mujoco_compat import mujoco
from libero_env.sim.appearance import Appearance
from libero_env.sim.backend import Backend
from libero_env.sim.engine import Goals, make_simulations
from libero_env.sim.predicates import register_predicate
from libero_env.tasks.expression import And, Atom, ForAll, Not, Or

wp = pytest.importorskip("warp")
mjw = pytest.importorskip("mujoco_warp")
warp_simulations = pytest.importorskip("libero_env.warp.simulations")

EVERYTHING = os.environ.get("LIBERO_WARP") == "all"  # twenty minutes more on a processor
TASK = "libero_10/3"  # a bowl into a drawer that is then closed: fixtures, joints, contacts
WARP = "warp,device=cpu"
NUM = 3
FREE_STEPS = 50 if EVERYTHING else 8
EXPERT_TASKS, EXPERT_STARTS = ["libero_object/3", "libero_spatial/0", "libero_goal/5", "libero_90/1"], 25
TEN_TASKS = ["libero_spatial/0", "libero_object/3", "libero_object/7", "libero_goal/0", "libero_goal/5"]
TEN_TASKS += ["libero_10/3", "libero_10/9", "libero_90/1", "libero_90/20", "libero_90/60"]

pytestmark = pytest.mark.sim


def make_pair(backends=("mujoco", WARP), **options):
    """The same environment on both back ends, `mujoco` first."""
    options = {"cameras": (), "observations": ("proprioception", "objects"), **options}
    return [BatchEnv(TASK, NUM, num_threads=1, backend=backend, **options) for backend in backends]


@pytest.fixture(scope="module")
def pair():
    envs = make_pair(horizon=5)
    yield envs
    for env in envs:
        env.close()


def reset(envs, **options):
    return [env.reset(options={"init_state": [0, 1, 2], **options}) for env in envs]


def smooth_actions(steps, seed=0):
    """Actions that lift the hand from its rest pose."""
    rng, found = np.random.default_rng(seed), []
    for step in range(steps):
        if step % 10 == 0:
            action = rng.uniform(-0.5, 0.5, (NUM, 7))
            action[:, 2], action[:, 6] = 0.3 * np.abs(action[:, 2]), np.sign(action[:, 6])
        found.append(action)
    return found


def assert_close(ours, theirs, atol=1e-5):
    assert ours.keys() == theirs.keys()
    for name, values in theirs.items():
        assert ours[name].shape == values.shape and ours[name].dtype == values.dtype
        np.testing.assert_allclose(ours[name], values, atol=atol, rtol=0, err_msg=name)


def test_a_reset_gives_the_same_observations_and_contacts(pair):
    (theirs, their_info), (ours, our_info) = reset(pair)
    assert pair[1].observation_space == pair[0].observation_space
    assert pair[1].action_space == pair[0].action_space
    assert_close(ours, theirs, 1e-6)
    assert {k: v.tolist() for k, v in our_info.items()} == {k: v.tolist() for k, v in their_info.items()}
    mujoco_sims, warp_sims = (env.simulations for env in pair)
    for i in range(NUM):  # fixtures are elsewhere in each, and their geoms with them
        touching = [sorted(map(tuple, sims.contact_geoms(i))) for sims in (warp_sims, mujoco_sims)]
        assert touching[0] == touching[1]
        geoms = warp_sims.device_data.geom_xpos.numpy()[i]
        np.testing.assert_allclose(geoms, mujoco_sims.data(i).geom_xpos, atol=1e-6)
    assert np.ptp(warp_sims.fixtures[:, :, :3], axis=0).max() > 1e-4


def test_episodes_are_the_same(pair):
    reset(pair)
    for action in smooth_actions(5):
        (theirs, *rest), (ours, *own) = (env.step(action) for env in pair)
        assert_close(ours, theirs)
        for a, b in zip(own[:3], rest[:3], strict=True):
            assert a.dtype == b.dtype and (a == b).all()
        for name in ("success", "progress"):
            assert (own[3][name] == rest[3][name]).all()
    assert own[2].all() and not pair[1].running.any()  # the horizon


def test_a_simulation_does_not_move_while_another_does(pair):
    env = pair[1]
    before, _ = reset(pair)[1]
    actions = smooth_actions(1)[0]
    env.simulations.step([1], actions)
    after = env.proprioception()
    for name, values in before.items():
        assert (after[name][[0, 2]] == values[[0, 2]]).all()
    assert (after["ee_pos"][1] != before["ee_pos"][1]).any()
    assert env.simulations.time(1) > env.simulations.time(0) == 0.0


def test_what_a_simulation_does_depends_on_itself_alone(pair):
    env, actions, found = pair[1], smooth_actions(1), []
    for others in (1.0, -1.0):
        reset([env])
        for action in actions:
            own = action * others
            own[0] = action[0]
            found.append(env.step(own)[0]["joint_states"][0])
    assert (found[0] == found[1]).all()


@pytest.mark.parametrize("outdated", [False, True])
def test_a_graph_does_what_its_kernels_do(pair, outdated):
    env, action, found = pair[1], smooth_actions(1)[0], []
    for uses_graphs in (False, True):
        env.simulations.uses_graphs = uses_graphs
        env.reset(options={"init_state": [0, 1, 2], "outdated_controller": outdated})
        env.simulations.step([0, 2], action)
        found.append(env.simulations.fields["qpos"].copy())
        found.append(env.simulations.fields["qvel"].copy())
    assert (found[0] == found[2]).all() and (found[1] == found[3]).all()


def test_a_masked_reset_leaves_the_others_alone(pair):
    env = pair[1]
    reset(pair)
    moved = env.step(smooth_actions(1)[0])[0]
    again, _ = env.reset(options={"init_state": 4, "reset_mask": [False, True, False]})
    theirs, _ = pair[0].reset(options={"init_state": 4})
    for name, values in again.items():
        assert (values[[0, 2]] == moved[name][[0, 2]]).all()
        np.testing.assert_allclose(values[1], theirs[name][1], atol=1e-6)


def test_a_new_placement_is_that_of_mujoco(pair):
    (theirs, _), (ours, _) = (env.reset(seed=[5, 6, 7]) for env in pair)
    assert_close(ours, theirs, 1e-5)


def test_a_state_is_restored_to_the_same_bits(pair):
    env, (first, second) = pair[1], smooth_actions(11)[::10]
    reset(pair)
    env.step(first)
    state = env.get_state(0)
    expected = env.step(second)[0]
    env.set_state(0, state)
    found = env.step(second)[0]
    assert all((found[name][0] == expected[name][0]).all() for name in found)


def test_the_outdated_controller_is_that_of_mujoco(pair):
    reset(pair, outdated_controller=True)
    for action in smooth_actions(2):
        (theirs, *_), (ours, *_) = (env.step(action) for env in pair)
        assert_close(ours, theirs)


def test_it_is_observed_within_a_step_as_mujoco():
    envs = make_pair(observed="substep")
    reset(envs)
    (theirs, *_), (ours, *_) = (env.step(smooth_actions(1)[0]) for env in envs)
    assert_close(ours, theirs)
    for env in envs:
        env.close()


def test_truths_are_those_of_the_predicates():
    pair = make_pair(backends=("mujoco", f"{WARP},contacts=2048"))  # bodies anywhere, also in each other
    scene, rng = pair[0].scene, np.random.default_rng(0)
    names, regions = list(scene.entities), [r.address for r in scene.problem.regions]
    sites = [name for name in scene.joints if name not in names and name in regions and scene.joints[name]]
    atoms = [Atom(p, (a, b)) for p in ("On", "In", "Stack") for a in scene.objects for b in regions]
    pairs = [(a, b) for a in scene.objects for b in names if a != b]
    atoms += [Atom(p, pair) for p in ("On", "Stack", "Incontact") for pair in pairs]
    atoms += [Atom("Up", (name,)) for name in scene.objects] + [Atom("True", (names[0],))]
    atoms += [Atom(p, (site,)) for p in ("Open", "Close") for site in sites]
    every = ForAll((("b", scene.objects[names[0]].category),), Atom("Up", ("b",)))
    goal = Or((And(tuple(atoms[:3])), Not(every)))
    checkers = [Goals(goal, atoms, env.views, "original") for env in pair]
    assert checkers[1].one_by_one == (Atom("True", (names[0],)),)
    seen = []
    for _ in range(20):  # objects anywhere around the fixtures, joints anywhere
        qpos = np.tile(scene.model.qpos0, (NUM, 1))
        for joint in range(scene.model.njnt):
            address, low, high = scene.model.jnt_qposadr[joint], *scene.model.jnt_range[joint]
            if scene.model.jnt_type[joint] == 0:
                near = pair[0].simulations.fixtures[0, rng.integers(len(scene.fixtures)), :3]
                qpos[:, address : address + 3] = near + rng.uniform(-0.15, 0.25, (NUM, 3))
            else:
                qpos[:, address] = rng.uniform(low, high, NUM)
        for env in pair:
            env.simulations.reset(range(NUM), qpos, np.zeros((NUM, scene.model.nv)))
        (reached, truths), (our_reached, our_truths) = (one.check(range(NUM)) for one in checkers)
        assert (our_reached == reached).all()
        wrong = [atoms[k] for k in np.flatnonzero((our_truths != truths).any(axis=0))]
        assert not wrong
        seen.append(truths)
    assert 0.01 < np.mean(seen) < 0.9


def test_predicates_of_users_and_of_strict_semantics_are_evaluated_on_the_host(pair):
    env = pair[1]
    register_predicate("Leftof", lambda view, a, b: bool(view.body_pos(a)[1] < view.body_pos(b)[1]))
    a, b = list(env.scene.entities)[:2]
    atom, reset_ = Atom("Leftof", (a, b)), reset(pair)
    assert reset_
    checker = Goals(atom, [atom], env.views, "original")
    assert checker.one_by_one == (atom,)
    theirs = Goals(atom, [atom], pair[0].views, "original").check(range(NUM))[0]
    assert (checker.check(range(NUM))[0] == theirs).all()
    strict = Goals(env.task.problem.goal, env.goals.atoms, env.views, "strict")
    assert {one.predicate for one in strict.one_by_one} == {"In"}


def test_too_many_contacts_are_an_error_of_that_simulation_that_says_what_to_set(pair, monkeypatch):
    full = BatchEnv(TASK, 1, cameras=(), backend="warp,device=cpu,contacts=4")
    with pytest.raises(SimulationError, match=r"simulation 0: .* set backend='warp,contacts=8' \(now 4\)"):
        full.reset(options={"init_state": 0})
    full.close()
    env = pair[1]
    reset(pair)
    kinds, simulations = warp_simulations.mjw.OverflowType, env.simulations
    flags, substep = np.array([0, int(kinds.NEFC), int(kinds.ITERATIONS)], np.int32), simulations._substep
    monkeypatch.setattr(simulations, "uses_graphs", False)
    overflowing = lambda: (substep(), simulations.device_data.overflow.assign(flags))  # noqa: E731
    monkeypatch.setattr(simulations, "_substep", overflowing)
    info = env.step(smooth_actions(1)[0])[4]
    assert list(info["errors"]) == [1] and env.running.tolist() == [True, False, True]
    assert env.simulations.limits_reached == {"ITERATIONS": 1}


def test_a_start_with_too_many_contacts_is_an_error_of_that_simulation_and_leaves_the_others_theirs():
    env = BatchEnv(TASK, 2, cameras=(), backend="warp,device=cpu,contacts=4")
    simulations, model = env.simulations, env.scene.model
    states = np.tile(env.init_states[0], (2, 1))
    for joint in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        states[0, 1 + model.jnt_qposadr[joint] + 2] += 0.5  # nothing touches anything
    env.reset(options={"start": states})
    assert len(simulations.contact_geoms(0)) == 0
    np.testing.assert_allclose(simulations.fields["qpos"][0], states[0, 1 : 1 + model.nq], atol=1e-6)
    info = env.step(np.zeros((2, 7)))[4]
    assert list(info["errors"]) == [1] and "contacts=8" in info["errors"][1]
    assert env.running.tolist() == [True, False]
    env.reset(options={"start": states[[0, 0]]})
    assert "errors" not in env.step(np.zeros((2, 7)))[4] and env.running.all()
    env.close()


def test_a_simulation_that_diverges_ends_its_episode_with_an_error(pair):
    env = pair[1]
    reset(pair)
    with wp.ScopedDevice("cpu"):
        env.simulations.device_data.qvel.numpy()[1, 12] = np.nan
    _, _, terminated, truncated, info = env.step(smooth_actions(1)[0])
    assert list(info["errors"]) == [1] and "diverged" in info["errors"][1]
    assert not terminated.any() and truncated.tolist() == [False, True, False]
    reset(pair)
    assert "errors" not in env.step(smooth_actions(1)[0])[4]


def test_memory_that_does_not_suffice_is_said_in_one_line(monkeypatch):
    def fail(*args, **kwargs):
        raise RuntimeError("Failed to allocate 99 bytes on device 'cpu'")

    monkeypatch.setattr(warp_simulations.mjw, "make_data", fail)
    with pytest.raises(LiberoError, match=r"no room for 2 simulations .* fewer contacts than 192"):
        BatchEnv(TASK, 2, cameras=(), backend=WARP)


def test_closed_simulations_say_so():
    env = BatchEnv(TASK, 1, cameras=(), backend=WARP)
    env.close()
    with pytest.raises(LiberoError, match="closed"):
        env.simulations.step([0], np.zeros((1, 7)))
    with pytest.raises(LiberoError, match="closed"):
        env.proprioception()


def test_results_name_it(pair):
    theirs, ours = (env.simulations.record() for env in pair)
    assert theirs == {"backend": "mujoco"}
    assert ours["backend"] == "warp" and ours["backend_device"] and ours["mujoco-warp"] and ours["warp-lang"]


@pytest.mark.parametrize("options, told", [
    ({"backend": "warp,device=cuda:7"}, "there is no device 'cuda:7'; here are: cpu"),
    ({"backend": WARP, "controller": "joint_position"}, "backend=mujoco has"),
    ({"backend": WARP, "observations": ("segmentation_class",)}, "segmentation needs backend=mujoco"),
])  # fmt: skip
def test_what_it_does_not_offer_is_said_in_one_line(options, told):
    with pytest.raises(LiberoError, match=told) as caught:
        BatchEnv(TASK, 1, **options)
    assert "\n" not in str(caught.value)


def test_appearances_need_the_other_back_end(pair):
    observer = pair[1].observer
    observer.set_appearance(0, Appearance())
    with pytest.raises(LiberoError, match="need backend=mujoco"):
        observer.set_appearance(0, Appearance(materials={"wall": "floor"}))
    with pytest.raises(InvalidInputError, match="name its camera in cameras="):
        observer.render(0, "agentview")


@pytest.mark.parametrize("text, error, told", [
    ("wrap", UnknownNameError, "warp"),
    ("warp,devise=cpu", UnknownNameError, "device"),
    ("warp,contacts=0", InvalidInputError, "from 1 to"),
    ("warp,device=", InvalidInputError, "cuda:0"),
    ("mujoco,device=cpu", InvalidInputError, "no settings"),
    ("warp,contacts=64,contacts=256", InvalidInputError, "contacts is given twice"),
    (7, InvalidInputError, "expected a text"),
])  # fmt: skip
def test_a_back_end_that_is_not_valid_is_said(text, error, told):
    with pytest.raises(error, match=told):
        Backend.read(text)


def test_a_back_end_is_written_as_it_is_read():
    for text in ("mujoco", "warp", "warp,device=cuda:1", "warp,device=cpu,contacts=256"):
        assert str(Backend.read(text)) == text


def test_demonstrations_name_it(tmp_path):
    plain, warp, other = (DemoConfig(TASK, backend=name) for name in ("mujoco", WARP, "warp,device=cuda:3"))
    assert warp.header() == {**plain.header(), "backend": "warp"}
    assert demo_path(tmp_path, warp) == demo_path(tmp_path, other) != demo_path(tmp_path, plain)
    assert demo_path(tmp_path, plain) == demo_path(tmp_path, DemoConfig(TASK))
    assert warp.batch > plain.batch


@pytest.mark.slow
def test_demonstrations_are_recorded(tmp_path, monkeypatch):
    monkeypatch.setattr(DemoConfig, "batch", 1)
    config = DemoConfig("libero_90/20", (32, 32), backend=WARP)
    job = RecordingJob(config, tmp_path / "demo.hdf5")
    report = make_demos([job], 1, workers=1, progress=False)[job.path]
    assert report.recorded == 1 and read_header(job.path)["backend"] == "warp"


@pytest.mark.slow
def test_pictures_show_the_same():
    cameras = ("agentview", "robot0_eye_in_hand")
    envs = make_pair(cameras=cameras, observations=("rgb", "depth"), camera_size=(48, 64))
    (theirs, _), (ours, _) = reset(envs)
    for name, values in theirs.items():
        assert ours[name].shape == values.shape and ours[name].dtype == values.dtype
        apart = np.abs(ours[name].astype(float) - values)
        if name.endswith("depth"):
            assert np.mean(apart < 0.005) > 0.95, name
        else:
            for one, other in zip(ours[name], values, strict=True):
                assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.8, name
    assert (ours["agentview_rgb"][0] != ours["agentview_rgb"][1]).any()
    assert (envs[1].observer.render(2, "agentview") == ours["agentview_rgb"][2]).all()
    for env in envs:
        env.close()


def free_actions(env, seed):
    """Actions of some control steps; None where the robot touches something."""
    env.reset(options={"init_state": list(range(NUM))})
    actions, bodies = smooth_actions(FREE_STEPS, seed), env.scene.model.geom_bodyid
    robot = env.scene.bodies["robot"]
    for action in actions:
        env.simulations.step(range(NUM), action)
        pairs = np.concatenate([env.simulations.contact_geoms(i) for i in range(NUM)])
        if (np.isin(bodies[pairs], robot).sum(axis=1) == 1).any():
            return None
    return actions


@pytest.mark.slow
@pytest.mark.parametrize("task", TEN_TASKS if EVERYTHING else TEN_TASKS[:1])
def test_free_motion_is_that_of_mujoco(task):
    """Within 1e-5 rad and m."""
    env = BatchEnv(task, NUM, cameras=(), num_threads=1)
    fixtures = env.scene.fixture_bodies
    ours = make_simulations(env.scene.model, NUM, fixture_bodies=fixtures, backend=Backend.read(WARP))
    theirs, actions = env.simulations, next(filter(None, (free_actions(env, seed) for seed in range(20))))
    env.reset(options={"init_state": list(range(NUM))})
    ours.reset(range(NUM), theirs.fields["qpos"], theirs.fields["qvel"], fixtures=theirs.fixtures)
    for action in actions:
        for simulations in (ours, theirs):
            simulations.step(range(NUM), action)
        np.testing.assert_allclose(ours.fields["qpos"], theirs.fields["qpos"], atol=1e-5, rtol=0)


def won_by_the_expert(task, starts, backend):
    """Which of the starts the expert solves."""
    env = BatchEnv(task, starts, cameras=(), num_threads=1, backend=backend)
    env.reset(options={"init_state": list(range(starts))})
    shapes = Shapes(env.scene)
    experts = [Expert(env.task, np.random.default_rng([0, i]), shapes=shapes) for i in range(starts)]
    won = [attempt.success for attempt in run_experts(env, experts)]
    env.close()
    return np.array(won)


if EVERYTHING:  # otherwise `test_demonstrations_are_recorded` shows it on one start

    def test_the_expert_succeeds_as_often():
        """Within 2 points over 100 starts of tasks of four suites."""
        theirs, ours = (
            np.mean([won_by_the_expert(task, EXPERT_STARTS, backend) for task in EXPERT_TASKS])
            for backend in ("mujoco", WARP)
        )
        assert theirs > 0.9 and abs(ours - theirs) <= 0.02


MESH = np.random.default_rng(0).normal(size=(12, 3))  # twelve corners of a convex body of a few centimetres
MESH = 0.05 * MESH / np.linalg.norm(MESH, axis=1, keepdims=True)


def contact_scene(*bodies):
    """A model of free bodies, each a position and a geom, and of fixed geoms, each with a position of its own."""
    placed = [geom if at is None else f'<body pos="{at}"><freejoint/>{geom}</body>' for at, geom in bodies]
    corners = " ".join(f"{x:.9f}" for x in MESH.ravel())
    mesh = f'<asset><mesh name="m" vertex="{corners}"/></asset>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{mesh}<worldbody>{''.join(placed)}</worldbody></mujoco>")


def beside(geom, away):
    mesh = '<geom type="mesh" mesh="m" margin="0.03"/>'
    return (f"0 {away} 0", mesh), (f"0.12 {away + 0.01} 0", f'<geom {geom} margin="0.03"/>')


def overlapping(away):
    mesh = '<geom type="mesh" mesh="m" gap="0.01"/>'
    return (f"0 {away} 0", mesh), (f"0.08 {away} 0.01", mesh)


# in brackets the issues of MuJoCo Warp, before 4.0.0
TOUCHING = (
    *overlapping(0),  # (1527)
    *overlapping(1),  # far from the origin (1546)
    *beside('type="sphere" size="0.05"', 2),  # (1649)
    *beside('type="box" size="0.05 0.05 0.05"', 3),
    *beside('type="capsule" size="0.05 0.05"', 4),
)
TABLE, BOX = '<geom type="box" size="0.3 0.3 0.02"/>', '<geom type="box" size="0.1 0.1 0.1"/>'
RESTING = (
    (None, TABLE),
    ("-0.2 0 0.034", '<geom type="cylinder" size="0.014 0.03" euler="0 90 0"/>'),  # lying (1555)
    ("0.1 0 0.12", BOX),  # stacked (1526)
    ("0.11 0 0.32", BOX),
)


def by_pair(geoms, distances):
    """Each pair of geoms with its distance [m], in order."""
    pairs = np.sort(geoms, axis=1).tolist()
    return np.array(sorted((*pair, distance) for pair, distance in zip(pairs, distances, strict=True)))


@pytest.mark.slow
@pytest.mark.release  # of MuJoCo Warp, whose version is pinned
@pytest.mark.parametrize(("bodies", "seconds", "error"), [(TOUCHING, 0.0, 1e-6), (RESTING, 0.5, 1e-4)])
def test_contacts_that_were_wrong_once_are_those_of_mujoco(bodies, seconds, error):
    model = contact_scene(*bodies)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with wp.ScopedDevice("cpu"):
        on_device = mjw.put_model(model)
        worlds = mjw.put_data(model, data, nworld=1, nconmax=64, njmax=256)
        mjw.forward(on_device, worlds)
        if seconds:
            steps = round(seconds / model.opt.timestep)
            mujoco.mj_step(model, data, steps)
            mjw.step(on_device, worlds)
            with wp.ScopedCapture() as capture:
                mjw.step(on_device, worlds)
            for _ in range(steps - 1):
                wp.capture_launch(capture.graph)
            assert max(abs(data.qvel).max(), abs(worlds.qvel.numpy()).max()) < 2e-3, "all rest"
            np.testing.assert_allclose(worlds.qpos.numpy()[0], data.qpos, atol=error)
        count = int(worlds.nacon.numpy()[0])
        assert count == data.ncon > 0 and int(worlds.nefc.numpy()[0]) == data.nefc

        theirs = worlds.contact.geom.numpy()[:count], worlds.contact.dist.numpy()[:count]
        ours = data.contact.geom, data.contact.dist
        np.testing.assert_allclose(*(by_pair(*contacts) for contacts in (theirs, ours)), rtol=0, atol=error)
