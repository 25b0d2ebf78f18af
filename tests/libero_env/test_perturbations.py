"""Perturbations: each kind does something, nothing at severity 0, and the same for the same seed in any batch."""

import gc
import pickle
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from libero_env import BatchEnv, LiberoEnv, make_task
from libero_env.envs import EnvConfig
from libero_env.errors import InvalidInputError, LiberoError, PlacementError, UnknownNameError
from libero_env.geometry import quat_to_axis_angle
from libero_env.perturbations import (
    KINDS,
    LAYERS,
    Perturbation,
    RobotJoints,
    format_perturbations,
    parse_perturbations,
    sample_key,
)
from libero_env.perturbations.appearance import CAMERA, pivot_of
from libero_env.perturbations.filters import PixelNoise
from libero_env.perturbations.instructions import edit_distance, reword, split_clauses
from libero_env.perturbations.kinds import Episode
from libero_env.perturbations.pairing import moved
from libero_env.perturbations.starts import posed
from libero_env.sim.appearance import Appearance, CameraView, Light
from libero_env.sim.predicates import register_predicate
from libero_env.sim.scene_spec import zone_boxes
from libero_env.tasks import get_suite, get_task
from libero_env.tasks.expression import Atom

TASK = "libero_goal/3"
SMALL = {"camera_size": (32, 32), "cameras": ("agentview",)}
ON_OBJECT = "libero_goal/6"  # the cream cheese into the bowl
OF_TWO = "libero_10/2"  # turn on the stove and put the moka pot on it
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")


@pytest.fixture
def world_of(closing):
    """Return a function that resets an environment under perturbations: the environment, observation and info."""

    def make(perturb, start=0, task=TASK, **options):
        env = closing(LiberoEnv(task, perturb=perturb, **{**SMALL, **options}))
        return env, *env.reset(options={"init_state": start})

    return make


def episode(env, start=0, steps=4):
    """Return the observations of a reset and of some steps."""
    rng = np.random.default_rng(start)
    seen = [env.reset(options={"init_state": start})[0]]
    seen += [env.step(rng.uniform(-1, 1, 7))[0] for _ in range(steps)]
    return seen


def same(a, b):
    return all(
        x.keys() == y.keys() and all(np.array_equal(x[k], y[k]) for k in x) for x, y in zip(a, b, strict=True)
    )


@pytest.fixture(scope="module")
def plain():
    env = LiberoEnv(TASK, **SMALL)
    yield env, episode(env, steps=4)
    env.close()


def test_a_text_gives_values_in_the_order_of_application():
    found = parse_perturbations(" noise=0.25, camera=0.3@7 ,fov=0", seed=2)
    assert found == (
        Perturbation("camera", 0.3, 7),
        Perturbation("fov", 0, 2),
        Perturbation("noise", 0.25, 2),
    )
    assert format_perturbations(found) == "camera=0.3@7,noise=0.25@2"
    assert parse_perturbations(format_perturbations(found)) == (found[0], found[2])
    assert [k.layer for k in KINDS.values()] == sorted((k.layer for k in KINDS.values()), key=LAYERS.index)


@pytest.mark.parametrize("text", ["camera", "camera=", "camera=x", "camera=1.1", "camera=-0.1", "camera=nan",
                                  "camera=0.1@x", "camera=0.1@-1", "camera=0.1,camera=0.2"])  # fmt: skip
def test_what_is_typed_wrongly_is_one_line(text):
    with pytest.raises(InvalidInputError, match="camera") as error:
        parse_perturbations(text)
    assert "\n" not in str(error.value)
    with pytest.raises(UnknownNameError, match="'camera'"):
        EnvConfig(perturb="camra=0.1")
    with pytest.raises(InvalidInputError, match="perturb"):
        EnvConfig(perturb=[0.3])


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_does_something(closing, kind, plain):
    base, seen = plain
    task = {"receptacle": ON_OBJECT, "partial": OF_TWO}.get(kind, TASK)
    if task != TASK:
        base = closing(LiberoEnv(task, **SMALL))
        seen = episode(base, steps=4)
    pictures = KINDS[kind].layer in ("appearance", "observation")
    env = closing(LiberoEnv(task, perturb=f"{kind}=1", **SMALL | ({} if pictures else {"cameras": ()})))
    changed = episode(env, steps=4)
    known = [{name: obs[name] for name in changed[0]} for obs in seen]
    reworded = env.task.language != base.task.language
    assert reworded or not same(known, changed) or in_sight(env) != in_sight(base)


def in_sight(env):
    """Return the objects and where they are."""
    return {name: env.view.body_pos(name).tolist() for name in env.scene.objects}


def test_severity_0_changes_no_bit(closing, plain):
    _, seen = plain
    nothing = ",".join(f"{kind}=0" for kind, definition in KINDS.items() if not definition.exclusive)
    env = closing(LiberoEnv(TASK, perturb=nothing, **SMALL))
    assert same(episode(env), seen) and env.config.perturb == () and env.batch.perturbed is None
    empty = closing(LiberoEnv(TASK, perturb=[Appearance()], **SMALL))
    assert same(episode(empty), seen)


def test_draws_do_not_depend_on_the_batch_or_its_order(closing):
    left_out = ("receptacle", "partial")  # the goal is a drawer
    perturb = ",".join(f"{n}=0.5" for n, kind in KINDS.items() if not kind.exclusive and n not in left_out)
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 3, 7))
    batch = closing(BatchEnv(TASK, 3, perturb=perturb, **SMALL))
    alone = closing(LiberoEnv(TASK, perturb=perturb, **SMALL))
    for starts in ([2, 0, 1], [1, 2, 0]):
        seen = [batch.reset(options={"init_state": starts})[0]]
        seen += [batch.step(a[starts])[0] for a in actions]
        own = [alone.reset(options={"init_state": 2})[0], *(alone.step(a[2])[0] for a in actions)]
        assert same(own, [{name: rows[starts.index(2)] for name, rows in obs.items()} for obs in seen])


def test_kinds_do_not_disturb_each_other_and_another_seed_is_another_draw(world_of):
    def joints(perturb):
        env, observation, _ = world_of(perturb, cameras=())
        env.close()
        return observation["joint_states"]

    alone = joints("robot=0.4")
    assert np.array_equal(alone, joints("robot=0.4,gain=0.2,delay=0.1"))
    assert not np.array_equal(alone, joints("robot=0.4@1"))
    rest = joints("")
    step = alone - rest
    assert np.allclose(joints("robot=0.8") - rest, 2 * step)  # further in the same direction


def test_absolute_changes_can_be_given_as_they_are(world_of):
    qpos = (0.1, -0.2, 0.0, -2.3, 0.0, 2.2, 0.7)
    view = CameraView(pos=(1.0, 0.1, 1.5), quat=(0.6, 0.35, 0.35, 0.63), fovy=50.0)
    env, observation, _ = world_of([RobotJoints(qpos), Appearance(cameras={CAMERA: view})])
    assert np.array_equal(observation["joint_states"], qpos)
    pose = env.observer.camera_to_world(0, CAMERA)
    assert np.array_equal(pose[:3, 3], view.pos)
    assert env.observer.intrinsics(CAMERA)[0, 0] == pytest.approx(16 / np.tan(np.deg2rad(25)))
    env, moved, _ = world_of([RobotJoints(qpos), Perturbation("robot", 0.4)], cameras=())  # starts from there
    assert np.linalg.norm(moved["joint_states"] - qpos) == pytest.approx(KINDS["robot"].amount(0.4))
    with pytest.raises(UnknownNameError, match="lamp"):
        world_of([Appearance(lights={"lamp": Light()})])


@pytest.mark.parametrize("severity", [0.2, 1.0])
def test_the_camera_orbits_by_degrees(severity, plain, world_of):
    base, _ = plain
    env, _, _ = world_of(f"camera={severity}", start=3)
    before, after = (e.observer.camera_to_world(0, CAMERA) for e in (base, env))
    pivot = pivot_of(env.scene)
    rays = [pose[:3, 3] - pivot for pose in (before, after)]
    cosine = rays[0] @ rays[1] / np.linalg.norm(rays[0]) / np.linalg.norm(rays[1])
    assert np.rad2deg(np.arccos(cosine)) == pytest.approx(KINDS["camera"].at_one * severity, abs=1e-6)
    assert np.cross(after[:3, 2], rays[1] / np.linalg.norm(rays[1])) == pytest.approx(np.zeros(3), abs=1e-6)
    assert after[2, 0] == pytest.approx(0, abs=1e-9)  # upright


def test_light_is_a_ratio_of_all_lights_and_the_field_of_view_is_in_degrees(plain, world_of):
    base, _ = plain
    env, _, _ = world_of("light=0.5,fov=0.5")
    drawn = [e.observer.renderer._scene for e in (base, env)]
    lights = ([*one.lights[: one.nlight]] for one in drawn)
    pairs = [
        (getattr(a, n), getattr(b, n)) for a, b in zip(*lights, strict=True) for n in ("diffuse", "specular")
    ]
    ratios = [np.sum(after) / max(np.sum(before), 1e-9) for before, after in pairs]
    ratio = KINDS["light"].amount(0.5)
    assert np.allclose(ratios, ratio) or np.allclose(ratios, 1 / ratio)
    fovy = [np.rad2deg(2 * np.arctan2(16, e.observer.intrinsics(CAMERA)[0, 0])) for e in (base, env)]
    assert abs(fovy[1] - fovy[0]) == pytest.approx(KINDS["fov"].amount(0.5))
    eye = drawn[1].camera[0]
    assert np.rad2deg(2 * np.arctan(eye.frustum_top / eye.frustum_near)) == pytest.approx(fovy[1], rel=1e-5)


@pytest.mark.parametrize("severity", [0.2, 1.0])
def test_the_robot_is_at_an_exact_distance_within_limits_and_touches_nothing(severity, world_of):
    base, observation, _ = world_of("", start=1, cameras=())
    env, moved, info = world_of(f"robot={severity}", start=1, cameras=())
    offset = moved["joint_states"] - observation["joint_states"]
    assert np.linalg.norm(offset) == pytest.approx(KINDS["robot"].at_one * severity, rel=1e-12)
    low, high = env.scene.model.jnt_range[:7].T
    assert ((moved["joint_states"] > low) & (moved["joint_states"] < high)).all()
    assert not any(env.view.in_contact("robot", name) for name in env.scene.entities)
    assert info["attempts"].shape == (1,) and not info["success"]
    nq = env.scene.nq_robot
    rest = [e.simulations.fields["qpos"][0, nq:] for e in (base, env)]
    assert np.array_equal(*rest)


def test_starts_hold_no_model_of_a_scene(closing):
    scene = closing(BatchEnv("libero_object/0", 1, cameras=())).scene  # without fixtures
    model, data = posed(scene, np.zeros(1 + scene.model.nq + scene.model.nv))
    assert scene.model not in (model, *gc.get_referents(data))


def test_noise_is_in_grey_levels(world_of):
    pictures = []
    for perturb in ("", "noise=0.2"):
        env, observation, _ = world_of(perturb, camera_size=(96, 96))
        pictures.append(observation["agentview_rgb"].astype(float))
        env.close()
    middle = (pictures[0] > 60) & (pictures[0] < 195)  # where nothing is clipped
    difference = (pictures[1] - pictures[0])[middle]
    assert np.std(difference) == pytest.approx(KINDS["noise"].amount(0.2), rel=0.03)


def test_actions_are_delayed_by_steps(world_of):
    delay, action = int(KINDS["delay"].amount(0.5)), np.array([0.5, 0, 0, 0, 0, 0, -1.0])
    late, _, _ = world_of("delay=0.5", cameras=())
    plain, _, _ = world_of("", cameras=())
    for _ in range(delay):
        plain.step(np.zeros(7))
        late.step(action)
    for _ in range(3):
        now, then = plain.step(action)[0], late.step(action)[0]
    assert delay == 2 and same([now], [then])


def test_distractors_are_so_many_at_rest_and_leave_the_others_where_they_are(world_of):
    base, _, _ = world_of("", start=4, cameras=())
    env, _, info = world_of("distractors=0.5", start=4, cameras=())
    scene, old = env.scene, env.batch.base_scene
    added = [name for name in scene.objects if name not in old.objects]
    assert len(added) == KINDS["distractors"].amount(0.5) == 3 and not info["success"]
    assert env.task.id == base.task.id and env.task.problem.goal == base.task.problem.goal
    for name in old.entities:
        assert np.array_equal(env.view.body_pos(name), base.view.body_pos(name))
        assert not any(env.view.in_contact(name, other) for other in added)
    before = [env.view.body_pos(name) for name in added]
    for _ in range(10):
        env.step(np.zeros(7))
    assert np.allclose(before, [env.view.body_pos(name) for name in added], atol=1e-3)


def test_distractors_never_lie_where_the_goal_wants_an_object(closing):
    env = closing(BatchEnv("libero_goal/5", 32, cameras=(), perturb="distractors=1"))
    env.reset(options={"init_state": range(32)})
    added = [name for name in env.scene.objects if name not in env.base_scene.objects]
    region = env.scene.problem.region("main_table_stove_front_region")
    ((centre, half),) = zone_boxes(region, env.scene.workspace)
    places = np.array([[view.body_pos(name) for name in added] for view in env.views])
    assert places.shape == (32, 6, 3)
    assert not (np.abs(places - centre)[..., :2] < half[:2]).all(-1).any()


def test_every_instruction_of_the_benchmark_can_be_reworded_at_a_given_distance():
    full = KINDS["instruction"].at_one
    for language in sorted({task.language for suite in SUITES for task in get_suite(suite).tasks})[::16]:
        assert reword(language, 0.0, np.random.default_rng(0)) == language
        for severity in (0.25, 1.0):
            said = reword(language, full * severity, np.random.default_rng(0))
            assert said == reword(language, full * severity, np.random.default_rng(0)) != language
            assert edit_distance(language, said) == pytest.approx(full * severity, abs=0.1)
            assert said.isascii() and "{" not in said


def test_the_edit_distance_counts_tokens_and_clauses_are_split_at_and():
    assert edit_distance("a b c", "a b c") == 0 and edit_distance("a b c d", "a x c") == 0.5
    clauses = ["open the top drawer", "put the bowl inside"]
    assert split_clauses(" and ".join(clauses)) == clauses
    for whole in (
        "put the yellow and white mug in the microwave",
        "pick up the milk and place it in the basket",
    ):
        assert split_clauses(whole) == [whole]


def test_an_episode_from_a_seed_is_paired_with_the_same_placement(closing):
    texts = ("", "robot=0.3,distractors=0.2")
    plain, perturbed = (closing(LiberoEnv(TASK, cameras=(), perturb=text)) for text in texts)
    plain.reset(seed=5)
    first = perturbed.reset(seed=5)[0]
    for name in plain.scene.entities:
        assert np.array_equal(plain.view.body_pos(name), perturbed.view.body_pos(name))
    assert same([first], [perturbed.reset(seed=5)[0]])


def test_places_of_what_is_new_are_named_by_the_start_whatever_was_reset_before(closing):
    first, second = (closing(BatchEnv(TASK, 1, cameras=(), perturb="distractors=0.2")) for _ in range(2))
    second.reset(options={"start": second.init_states[:1]})  # named by its numbers
    for env in (first, second):
        env.reset(options={"init_state": 0})
    assert np.array_equal(*(env.simulations.physics_state(0) for env in (first, second)))


def test_a_seed_of_words_moves_no_object(world_of):
    places = []
    for perturb in ("distractors=0.2@1", "distractors=0.2@1,instruction=0.5@1"):
        env, _, _ = world_of(perturb, cameras=())
        places.append({name: env.view.body_pos(name).tolist() for name in env.scene.objects})
    assert places[0] == places[1]


@pytest.mark.parametrize("perturb", ["layout=1", "layout=1,distractors=0.2"])
def test_a_start_whose_moved_objects_collide_is_refused(closing, perturb):
    env = closing(BatchEnv("libero_object/3", 1, cameras=(), perturb=perturb))
    shifts = dict(moved(env.base_task.problem, env.task.problem))
    (one, by), (other, away) = list(shifts.items())[:2]
    at, there = (1 + env.base_scene.pose_address(name) for name in (one, other))
    start = env.init_states[:1].copy()
    start[0, there : there + 2] = start[0, at : at + 2] + by - away  # where both come to the same place
    with pytest.raises(PlacementError, match="a moved object touches another"):
        env.reset(options={"start": start})


def test_another_goal_of_the_scene_comes_with_its_instruction(world_of):
    goals = {task.language: task.problem.goal for task in get_suite("libero_goal").tasks}
    env, _, info = world_of("goal=1", cameras=())
    assert env.task.language != env.batch.base_task.language
    assert env.task.problem.goal == goals[env.task.language] and not info["success"]
    assert env.task.id == TASK and env.scene.problem.objects == env.batch.base_scene.problem.objects
    env, _, _ = world_of("goal=1", task="libero_object/0", cameras=())  # where no task begins in the same way
    carried = env.task.problem.goal.parts[0].args[0]
    assert env.task.problem.objects[carried].replace("_", " ").removeprefix("new ") in env.task.language
    with pytest.raises(InvalidInputError, match="goal cannot be combined with"):
        EnvConfig(perturb="goal=1,instruction=0.5")


@pytest.mark.parametrize("severity", [0.3, 1.0])
def test_a_layout_moves_objects_by_metres_and_keeps_what_the_goal_puts_them_on(severity, world_of):
    base, _, _ = world_of("", task="libero_object/3", start=9, cameras=())
    env, _, info = world_of(f"layout={severity}", task="libero_object/3", start=9, cameras=())
    before, after = ({n: e.view.body_pos(n) for n in e.scene.objects} for e in (base, env))
    ways = {n: np.linalg.norm(after[n] - before[n]) for n in before}
    moved = {n: way for n, way in ways.items() if way > 0}
    assert set(before) - set(moved) == {"basket_1"} and not info["success"]
    assert np.allclose(list(moved.values()), KINDS["layout"].amount(severity), atol=1e-9)
    for name, region in ((a.args[0], env.task.problem.region(a.args[1])) for a in env.task.problem.init):
        x0, y0, x1, y1 = region.ranges[0]
        x, y, _ = after[name] - env.scene.workspace.offset
        assert x0 - 0.02 < x < x1 + 0.02 and y0 - 0.02 < y < y1 + 0.02  # the task says where they are


def test_objects_that_places_tell_apart_move_together(world_of):
    base, _, _ = world_of("", task="libero_spatial/1", cameras=())
    env, _, _ = world_of("layout=0.5", task="libero_spatial/1", cameras=())
    steps = [env.view.body_pos(n) - base.view.body_pos(n) for n in env.scene.objects]
    assert np.allclose(steps, steps[0], atol=1e-9) and np.linalg.norm(steps[0]) == pytest.approx(0.05)


@pytest.mark.parametrize(("kind", "amount"), [("distractors", 3.0), ("objects", 1.0)])
def test_fewer_new_objects_than_asked_for_are_refused(kind, amount):
    scene = SimpleNamespace(pack=SimpleNamespace(categories=lambda: ("yellow_book",)), goal_atoms=())
    with pytest.raises(InvalidInputError, match="are to be new, and 1 categories are neither in the task"):
        KINDS[kind].sample(amount, np.random.default_rng(0), get_task("libero_object/0"), scene)


def test_other_objects_stand_where_those_were_that_the_task_is_not_about(world_of):
    base, _, _ = world_of("", task="libero_object/3", cameras=())
    env, _, _ = world_of("objects=1", task="libero_object/3", cameras=())
    old, new = base.task.problem.objects, env.task.problem.objects
    exchanged = [name for name in old if old[name] != new[name]]
    assert set(old) - set(exchanged) == {"bbq_sauce_1", "basket_1"}
    for name in exchanged:
        assert np.allclose(env.view.body_pos(name)[:2], base.view.body_pos(name)[:2], atol=0.01)
    assert np.array_equal(env.view.body_pos("bbq_sauce_1"), base.view.body_pos("bbq_sauce_1"))
    with pytest.raises(InvalidInputError, match="no object that could be another"):
        world_of("objects=1", task="libero_90/12")


def test_objects_start_at_a_distance_from_their_places_and_carry_what_stands_on_them(world_of):
    task, start = "libero_spatial/3", 2  # the bowl stands on the cookie box
    base, _, _ = world_of("", task=task, start=start, cameras=())
    env, _, _ = world_of("object_pose=0.6", task=task, start=start, cameras=())
    steps = {n: (env.view.body_pos(n) - base.view.body_pos(n))[:2] for n in env.scene.objects}
    lengths = {n: np.linalg.norm(step) for n, step in steps.items()}
    assert lengths["cookies_1"] == pytest.approx(KINDS["object_pose"].amount(0.6))
    assert env.view.in_contact("akita_black_bowl_1", "cookies_1")
    places = ([e.view.body_pos(n) for n in ("akita_black_bowl_1", "cookies_1")] for e in (base, env))
    apart = [np.linalg.norm(bowl - box) for bowl, box in places]
    assert apart[0] == pytest.approx(apart[1])


def arriving(name, severity):
    """Return a function of the name, the image and the step that returns what arrives of an image."""
    kind = KINDS[name]
    change = kind.sample(kind.amount(severity), np.random.default_rng(0))
    episode = Episode(sample_key(name, 0, TASK))

    def image(name, picture, step):
        episode.step = step
        return change.image(name, picture, episode)

    return image


def test_a_users_predicate_among_the_initial_conditions_places_nothing(closing):
    register_predicate("near", lambda view, a, b: True)
    task = get_suite("libero_spatial").tasks[0]
    near = Atom("Near", ("akita_black_bowl_1", "akita_black_bowl_2"))
    with_near = replace(task, problem=replace(task.problem, init=(*task.problem.init, near)))
    envs = [closing(LiberoEnv(one, cameras=(), perturb="object_pose=0.2")) for one in (task, with_near)]
    for env in envs:
        env.reset(seed=0)
    assert np.array_equal(*(env.get_state() for env in envs))  # both bowls move, each its own way


def test_pictures_are_blurred_hidden_late_and_lost():
    taken = np.random.default_rng(0).integers(0, 25, (13, 128, 128, 3), np.uint8)
    step = np.zeros((128, 128, 3), np.uint8)
    step[:, 64:] = 255
    edge = np.diff(arriving("blur", 0.5)("a_rgb", step, 0)[64, :, 0].astype(float))  # it is the kernel
    across = np.arange(127) - edge @ np.arange(127) / edge.sum()
    assert np.sqrt(edge @ across**2 / edge.sum()) == pytest.approx(KINDS["blur"].amount(0.5), rel=0.1)

    hide = arriving("occlusion", 0.5)
    hidden = [(hide("a_rgb", picture, t) != picture).any(axis=-1) for t, picture in enumerate(taken[:3])]
    assert hidden[0].mean() == pytest.approx(KINDS["occlusion"].amount(0.5), abs=0.01)
    assert all(np.array_equal(hidden[0], other) for other in hidden)

    late, steps = arriving("latency", 0.2), int(KINDS["latency"].amount(0.2))
    arrived = [late("a_rgb", picture, t) for t, picture in enumerate(taken)]
    assert steps == 2 and all(np.array_equal(a, taken[max(0, t - 2)]) for t, a in enumerate(arrived))

    lost = arriving("dropped_frames", 0.7)
    arrived = [lost("a_rgb", picture, t) for t, picture in enumerate(taken)]
    kept = [np.array_equal(a, b) for a, b in zip(taken, arrived, strict=True)]
    assert kept[0] and 0 < sum(kept[1:]) < 10
    assert all(now or np.array_equal(arrived[t], arrived[t - 1]) for t, now in enumerate(kept) if t)


def test_late_pictures_do_not_depend_on_which_are_looked_at():
    env = LiberoEnv(TASK, perturb="latency=0.2", **SMALL)
    seen = episode(env, steps=4)[-1]
    env.render_images = False
    env.reset(options={"init_state": 0})
    rng = np.random.default_rng(0)
    for step in range(4):
        env.render_images = step == 3
        last = env.step(rng.uniform(-1, 1, 7))[0]
    assert same([seen], [last])
    env.close()


def test_sensors_are_off_by_metres_and_radians(world_of):
    entries = ("proprioception", "ee_quat")
    base, right, _ = world_of("", observations=entries)
    env, wrong, _ = world_of("proprio_bias=0.5", observations=entries)
    amount = KINDS["proprio_bias"].amount(0.5)
    for name in ("joint_states", "ee_pos"):
        assert np.linalg.norm(wrong[name] - right[name]) == pytest.approx(amount)
    cosine = abs(wrong["ee_quat"] @ right["ee_quat"])
    assert 2 * np.arccos(cosine) == pytest.approx(amount, rel=1e-6)
    assert quat_to_axis_angle(wrong["ee_quat"][None])[0] == pytest.approx(wrong["ee_ori"], abs=1e-9)
    assert np.array_equal(env.view.eef_pos, base.view.eef_pos)


def test_actions_are_scaled_and_noisy_but_not_the_gripper():
    episode, action = Episode(sample_key("x", 0, TASK)), np.full(7, 0.5)
    gain = KINDS["gain"].sample(2.0, episode.key.generator()).act(action, episode)
    assert gain[6] == 0.5 and np.allclose(gain[:6], gain[0]) and gain[0] in (0.25, 1.0)
    noise = KINDS["action_noise"].sample(0.2, episode.key.generator())
    acted = np.array([noise.act(action, Episode(episode.key, step)) for step in range(500)])
    assert (acted[:, 6] == 0.5).all() and acted[:, :6].std() == pytest.approx(0.2, rel=0.05)
    assert np.array_equal(acted[3], noise.act(action, Episode(episode.key, 3)))


@pytest.mark.parametrize("perturb", ["gain=1@1", "action_noise=1"])  # half as far
def test_actions_are_clipped_before_they_are_perturbed(perturb, world_of):
    within, beyond = (world_of(perturb, cameras=())[0] for _ in range(2))
    direction = np.array([1.0, -1.0, 1.0, 0.0, 0.0, 0.0, -1.0])
    assert same([within.step(direction)[0]], [beyond.step(4 * direction)[0]])


def test_a_configuration_with_perturbations_goes_to_other_processes():
    view = CameraView(fovy=50.0)
    config = EnvConfig(
        perturb=[Perturbation("noise", 0.5, 3), Appearance(cameras={CAMERA: view}), PixelNoise(2.0)]
    )
    assert pickle.loads(pickle.dumps(config)) == config


def test_a_part_of_the_goal_holds_at_the_start_and_goes_on_to_hold():
    def held(starts, perturb="partial=1"):
        with BatchEnv(OF_TWO, len(starts), cameras=(), perturb=perturb) as env:
            _, info = env.reset(options={"init_state": starts})
            first, states = info["progress"], [env.simulations.get_state(i) for i in range(len(starts))]
            for _ in range(20):
                info = env.step(np.zeros((len(starts), 7)))[-1]
            assert (info["progress"] >= first).all() and not info["success"].any()
            return first, states

    first, states = held([0, 1, 2, 3])
    assert (first.sum(axis=1) == 1).all(), "never both"
    assert (first.sum(axis=0) > 0).all(), "each atom somewhere"
    np.testing.assert_array_equal(states[2], held([2])[1][0])
    assert (first != held([0, 1, 2, 3], "partial=1@1")[0]).any()


def test_a_share_of_the_atoms_and_what_holds_already():
    task = make_task(
        scene="kitchen", objects=["basket", "butter", "plate", "cream_cheese"], furniture=["flat_stove"],
        place={"basket_1": (0.0, 0.25), "butter_1": (0.0, -0.2), "plate_1": (0.1, -0.25), "cream_cheese_1": (0.1, 0.0),
               "flat_stove_1": (-0.3, 0.3)},
        init_also=["Turnon flat_stove_1"],
        goal=["In butter_1 basket_1_contain_region", "On cream_cheese_1 plate_1", "On plate_1 kitchen_table_left",
              "Turnon flat_stove_1"],
        regions={"kitchen_table": {"left": {"at": (-0.1, 0.0), "half": 0.03}}},
        language="put the butter into the basket, and the cream cheese on the plate to the left, with the stove on",
    )  # fmt: skip
    for severity, count in ((0.1, 1), (0.5, 1), (1.0, 2)):
        with BatchEnv(task, 1, cameras=(), perturb=f"partial={severity}") as env:
            held = env.reset(seed=[0])[1]["progress"][0]
            assert held[3] and held[:3].sum() == count, severity


@pytest.mark.parametrize(("task", "perturb", "message"), [
    ("libero_goal/1", "partial=1", "no part of the goal .And .On akita_black_bowl_1 .* can hold alone"),
    (OF_TWO, "partial=1@lifted", "partial cannot begin during an episode"),
])  # fmt: skip
def test_partial_starts_that_there_are_not_are_refused_in_one_line(task, perturb, message):
    with pytest.raises(LiberoError, match=message) as error:
        BatchEnv(task, 1, cameras=(), perturb=perturb)
    assert "\n" not in str(error.value)
