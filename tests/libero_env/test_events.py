"""Perturbations that begin during an episode: bits before them, their moments, what they move, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from libero_env import BatchEnv, Expert, get_task
from libero_env.demos.config import RenderConfig
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.expert.expert import solved_from_events
from libero_env.perturbations import Perturbation, format_perturbations, parse_perturbations
from libero_env.tasks.expression import Atom, ForAll

TASK = "libero_goal/6"  # the cream cheese into the bowl


def episode(perturb, starts=(0, 1), steps=14):
    """Return the pictures and the positions after each step, and the last infos."""
    action = np.tile([0.0, 0.2, -0.5, 0.0, 0.0, 0.0, 1.0], (len(starts), 1))
    options = {"cameras": ("agentview",), "camera_size": (32, 32), "horizon": 100, "perturb": perturb}
    with BatchEnv(TASK, len(starts), **options) as env:
        env.reset(options={"init_state": list(starts)})
        seen = []
        for _ in range(steps):
            obs, *_, info = env.step(action)
            seen.append((obs["agentview_rgb"], env.simulations.fields["qpos"].copy()))
        return [np.stack(part) for part in zip(*seen, strict=True)], info, env


@pytest.fixture(scope="module")
def matched():
    return episode("")[0]


@pytest.mark.parametrize("kind", ["camera=0.5", "noise=1", "gain=1", "object=1", "receptacle=1", "distractor=1",
    "obstacle=0.5", "goal=1"])  # fmt: skip
@pytest.mark.parametrize("trigger", ["step10", "10%"])
def test_all_before_an_event_is_the_matched_episode_to_the_bit_and_nothing_after_it(matched, kind, trigger):
    (pictures, positions), info, env = episode(f"{kind}@{trigger}")
    np.testing.assert_array_equal(pictures[:10], matched[0][:10])
    np.testing.assert_array_equal(positions[:10], matched[1][:10])
    assert info["began"].tolist() == [[10], [10]]
    one = env.config.perturb[0]
    acts, moves = one.kind != "goal", one.definition.physical and one.kind != "goal"
    assert (positions[10] != matched[1][10]).any(axis=-1).all() == moves
    assert (pictures[10] != matched[0][10]).any() == acts
    assert info["moved"].tolist() == [False, False], "it has just begun in the step before only"
    (alone, where), _, _ = episode(f"{kind}@{trigger}", starts=(1,))
    np.testing.assert_array_equal(alone[:, 0], pictures[:, 1])  # whatever runs beside it
    np.testing.assert_array_equal(where[:, 0], positions[:, 1])


def test_an_object_is_moved_so_far_and_draws_that_are_not_valid_are_counted(matched):
    (_, positions), info, env = episode("object=1@step10", steps=11)
    address = env.scene.pose_address("cream_cheese_1")
    moved = positions[10, :, address : address + 2] - matched[1][10, :, address : address + 2]
    np.testing.assert_allclose(np.linalg.norm(moved, axis=-1), 0.1, atol=2e-3)
    assert info["attempts"].tolist() == [[1], [0]], "that of start 0 would stand inside another object"


def test_an_event_whose_moment_never_comes_changes_nothing(matched):
    seen, info, _ = episode("receptacle=1@touched,noise=1@lifted")
    assert info["began"].tolist() == [[-1, -1]] * 2
    for part, same in zip(seen, matched, strict=True):
        np.testing.assert_array_equal(part, same)


def test_events_add_to_what_acts_from_the_start():
    (pictures, _), info, _ = episode("noise=0.2,noise=1@step5,camera=0.3", starts=(0,), steps=8)
    (without, _), _, _ = episode("noise=0.2,camera=0.3", starts=(0,), steps=8)
    assert info["began"].tolist() == [[5]]
    np.testing.assert_array_equal(pictures[:5], without[:5])
    assert (pictures[5:] != without[5:]).any(axis=(1, 2, 3, 4)).all()


def test_phases_come_one_after_the_other_and_another_episode_waits_again():
    perturb = "fov=0.2@touched,light=0.2@lifted,camera=0.2@over_goal"
    with BatchEnv(TASK, 1, cameras=(), horizon=300, perturb=perturb) as env:
        env.reset(options={"init_state": [0]})
        expert, done = Expert(env.task, np.random.default_rng(0)), False
        while not done:
            _, _, terminated, truncated, info = env.step(expert.act(env.views[0])[None])
            done = bool((terminated | truncated).all())
        by_kind = dict(zip([one.kind for one in env.perturbed.perturbations], info["began"][0], strict=True))
        assert 0 < by_kind["fov"] < by_kind["light"] < by_kind["camera"] and info["success"].all()
        _, info = env.reset(options={"init_state": [0]})
        assert info["began"].tolist() == [[-1, -1, -1]]


def act(env, experts, done=lambda info: False):
    """Let experts act, and plan again where something has moved, until their episodes are over."""
    info = {}
    while env.running.any() and not done(info):
        actions = np.stack([one.act(env.views[i]) for i, one in enumerate(experts)])
        info = env.step(actions)[-1]
        for i in np.flatnonzero(info["moved"]):
            experts[i].replan(env.task_of(i))
    return info


def test_what_has_just_moved_belongs_to_its_step():
    with BatchEnv(TASK, 2, cameras=(), perturb="object=1@step0") as env:
        env.reset(options={"init_state": [0, 1]})
        assert env.step(np.zeros((2, 7)))[-1]["moved"].tolist() == [True, True]
        info = env.reset(options={"init_state": 0, "reset_mask": np.array([True, False])})[1]
        assert info["moved"].tolist() == [False, True]


def test_another_goal_of_the_scene_is_judged_from_the_event_on():
    with BatchEnv(TASK, 2, cameras=(), horizon=400, perturb="goal=1@lifted") as env:
        env.reset(options={"init_state": [0, 1]})
        own, experts = env.task, [Expert(env.task, np.random.default_rng(0)) for _ in range(2)]
        info = act(env, experts, done=lambda info: info and (info["began"] >= 0).all())
        other = env.task_of(0)
        assert other.language != own.language and other.id == own.id and env.task is own
        assert {str(atom) for task in (own, other) for atom in task.problem.goal.atoms()} == set(env.atoms)
        states = [env.get_state(i) for i in range(2)]
        info = act(env, experts)
        assert info["success"].all() and (info["began"] > 0).all()
        names = dict(zip(env.atoms, info["progress"].T, strict=True))
        assert all(names[str(atom)].all() for atom in other.problem.goal.atoms())
        assert not all(names[str(atom)].all() for atom in own.problem.goal.atoms())
        env.set_state(0, states[0])  # the goal that an event has changed belongs to the state
        assert env.task_of(0) is other and not env.check_goal(0)[0]
        env.reset(options={"init_state": [0, 1]})
        assert env.task_of(0) is own and env.perturbed.event_states == {}


def test_a_restored_state_has_the_events_that_had_begun():
    perturb, action = "camera=0.5@step3,noise=1@step8", np.tile([0.0, 0.2, -0.5, 0.0, 0.0, 0.0, 1.0], (2, 1))
    with BatchEnv(TASK, 2, cameras=("agentview",), camera_size=(32, 32), perturb=perturb) as env:
        env.reset(options={"init_state": [0, 0]})
        for step in range(12):
            info = env.step(action)[-1]
            if step == 4:
                state = env.get_state(0)
        assert state[-2:].tolist() == [3, -1] and info["began"][0].tolist() == [3, 8]
        env.set_state(1, state)  # of another simulation: only the camera has moved
        assert env.perturbed.began[1].tolist() == [3, -1]
        with pytest.raises(InvalidInputError, match="ends with its number of steps, those before each event"):
            env.set_state(0, np.append(state[:-1], 0.5))


def roll(env, actions):
    """Return the infos and positions after each action, and the last pictures."""
    infos, positions, obs = [], [], {}
    for action in actions:
        obs, *_, info = env.step(action)
        infos.append(info["began"][0].tolist())
        positions.append(env.simulations.fields["qpos"][0].copy())
    return infos, positions, obs["agentview_rgb"][0]


def test_a_state_goes_on_to_the_same_bits_in_an_environment_that_has_seen_nothing_of_its_episode():
    options = {"cameras": ("agentview",), "camera_size": (32, 32), "horizon": 300}
    with BatchEnv(TASK, 1, perturb="camera=0.6,gain=0.3,action_noise=0.2@lifted", **options) as env:
        env.reset(options={"init_state": [1], "outdated_controller": True})
        expert, states, actions = Expert(env.task, np.random.default_rng(0)), [], []
        while not actions or env.perturbed.began[0, 0] < 0:
            states.append(env.get_state(0))
            actions.append(expert.act(env.views[0])[None])
            env.step(actions[-1])
        env.set_state(0, states[0])
        expected = roll(env, actions)
        assert expected[0][-2:] == [[-1], [len(actions) - 1]], "it was raised in the last step but one"
    for start in (0, len(states) - 1):  # the controller is outdated; raised, and the event is due
        with BatchEnv(TASK, 1, perturb="camera=0.6,gain=0.3,action_noise=0.2@lifted", **options) as other:
            other.reset(options={"init_state": [0]})
            other.set_state(0, states[start])
            infos, positions, seen = roll(other, actions[start:])
            assert infos == expected[0][start:]
            np.testing.assert_array_equal(positions, expected[1][start:])
            np.testing.assert_array_equal(seen, expected[2])


def test_an_event_that_did_not_happen_is_tried_again_after_a_state_before_it(monkeypatch):
    monkeypatch.setattr("libero_env.perturbations.episodes.TRIES", 1)
    monkeypatch.setattr("libero_env.perturbations.hooks.TRIES", 1)
    still = np.zeros((1, 7))
    with BatchEnv(TASK, 1, cameras=(), perturb="object=1@step2") as env:
        env.reset(options={"init_state": [1]})  # whose first draw is valid
        state, short = env.get_state(0), env.simulations.physics_state(0)
        for before in (state, short):
            env.reset(options={"init_state": [0]})
            for _ in range(4):
                info = env.step(still)[-1]
            assert info["began"].tolist() == [[-1]] and info["attempts"].tolist() == [[1]]
            failed = env.get_state(0)
            env.reset(options={"init_state": [1]})
            env.set_state(0, failed)
            assert env.step(still)[-1]["attempts"].tolist() == [[1]], "it is not tried again later"
            env.set_state(0, before)
            for _ in range(4):
                info = env.step(still)[-1]
            assert info["began"].tolist() == [[2]] and info["attempts"].tolist() == [[0]]


def test_objects_that_a_quantifier_stands_for_are_those_that_the_goal_is_about():
    """The same goal, said of each object of a category: triggers, draws, causes and progress are the same."""
    task = get_task(TASK)
    (atom,) = task.problem.goal.atoms()
    with BatchEnv(TASK, 1, cameras=()) as env:
        starts = env.init_states[:1]
    every = ForAll((("?x", task.problem.objects[atom.args[0]]),), Atom("On", ("?x", atom.args[1])))
    seen = []
    for goal in (task.problem.goal, every):
        said = replace(task, problem=replace(task.problem, goal=goal))
        perturb = "light=1@touched,camera=0.2@over_goal,object=1@step5,obstacle=0.5@step6"
        with BatchEnv(said, 1, cameras=(), horizon=300, perturb=perturb) as env:
            env.reset(options={"start": starts})
            expert, infos = Expert(task, np.random.default_rng(0)), []
            while env.running[0]:
                infos.append(env.step(expert.act(env.views[0])[None])[-1])
                if infos[-1]["moved"][0]:
                    expert.replan(task)
            assert (infos[-1]["began"] >= 0).all() and env.atoms == (str(atom),)
            seen.append([[info[key].tolist() for info in infos] for key in ("began", "progress", "success")])
            assert env.watch.wanted(0) == ["cream_cheese_1"]
    assert seen[0] == seen[1]


def test_the_expert_tells_whether_the_rest_can_be_solved():
    with BatchEnv(TASK, 2, cameras=(), horizon=150, perturb="receptacle=1@touched,light=1@step140") as env:
        env.reset(options={"init_state": [0, 2]})  # in start 1 the hand touches the bowl, too
        experts = [Expert(env.task, np.random.default_rng(0)) for _ in range(2)]
        info = act(env, experts, done=lambda info: info and (info["began"][:, 1] >= 0).all())
        still = np.array([[1.0], [0.0]])  # the second one stands still from there on
        while env.running.any():
            actions = np.stack([one.act(env.views[i]) for i, one in enumerate(experts)])
            info = env.step(still * actions)[-1]
        began = info["began"]
        assert (began[:, 1] > 0).all() and began[:, 0].tolist() == [-1, 140]
        assert solved_from_events(env).tolist() == [[-1, 1], [0, 1]], "in ten steps it cannot be done"


def test_the_text_of_events():
    found = parse_perturbations("noise=1@25%,camera=0.5@lifted@7,camera=0.1@3", events=True)
    assert found[1] == Perturbation("camera", 0.5, 7, "lifted") and found[0] == Perturbation("camera", 0.1, 3)
    assert format_perturbations(found) == "camera=0.1@3,camera=0.5@lifted@7,noise=1@25%"


@pytest.mark.parametrize(("text", "error", "message"), [
    ("camera=0.5@lift", UnknownNameError, "unknown trigger 'lift'. Did you mean 'lifted'?"),
    ("camera=0.5@100%", UnknownNameError, "unknown trigger '100%'"),
    ("camera=0.5@step", UnknownNameError, "unknown trigger 'step'"),
    ("layout=1@step4", InvalidInputError, "layout cannot begin during an episode"),
    ("goal=1@step4,goal=1@lifted", InvalidInputError, "goal cannot be combined with goal"),
    ("object=1@lifted", InvalidInputError, "the robot touches the object then, so that it is not moved"),
    ("light=1@lifted,light=0.5@lifted", InvalidInputError, "light is named twice"),
    ("light=1@lifted@x", InvalidInputError, "expected KIND=SEVERITY"),
])  # fmt: skip
def test_what_is_no_event_is_refused_in_one_line(text, error, message):
    with pytest.raises(error) as found:
        parse_perturbations(text, events=True)
    assert message in str(found.value) and "\n" not in str(found.value)


def test_where_there_are_no_episodes_there_are_no_events():
    with pytest.raises(InvalidInputError, match="expected KIND=SEVERITY"):
        parse_perturbations("camera=0.5@lifted")  # where there are no episodes, such as in certifying
    with pytest.raises(InvalidInputError, match="camera=0.5@lifted"):
        RenderConfig(perturb="camera=0.5@lifted")


@pytest.mark.parametrize(("severity", "aside"), [(1, 0.0), (0.5, 0.06)])
def test_an_obstacle_stands_between_an_object_and_its_place(severity, aside):
    with BatchEnv("libero_object/0", 1, cameras=(), perturb=f"obstacle={severity}@step2") as env:
        env.reset(options={"init_state": [3]})
        qpos, address = env.simulations.fields["qpos"][0], env.scene.pose_address
        places = {name: slice(address(name), address(name) + 2) for name in env.scene.objects}
        before = qpos.copy()
        for _ in range(3):
            *_, info = env.step(np.zeros((1, 7)))
        (moved,) = (at for at in places.values() if np.linalg.norm(qpos[at] - before[at]) > 0.02)
        soup = before[places["alphabet_soup_1"]]
        way, to = before[places["basket_1"]] - soup, qpos[moved] - soup
    length = np.linalg.norm(way)
    assert abs(way[0] * to[1] - way[1] * to[0]) / length == pytest.approx(aside, abs=2e-3)
    assert 0.39 < to @ way / length**2 < 0.61 and info["began"].tolist() == [[2]]
