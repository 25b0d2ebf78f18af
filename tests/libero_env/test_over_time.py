"""Goals over time: what Then, Never and Count mean, what an environment remembers of them, and who deals with them."""

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from libero_cli.main import main
from libero_env import BatchEnv, Expert, LiberoEnv, make_task
from libero_env.demos.read import read_episodes
from libero_env.demos.replay import REPLAY_MODES, replay, rerun_actions
from libero_env.errors import BDDLError, InvalidInputError, LiberoError
from libero_env.expert.expert import Attempt
from libero_env.expert.planning.goal_plan import UnsupportedGoalError, plan_goal
from libero_env.sim.history import History
from libero_env.sim.predicates import SEMANTICS, register_predicate
from libero_env.sim.watch import EpisodeWatch
from libero_env.tasks import Atom, Count, Never, Then, bddl, write_task
from libero_env.tasks.problem import differences
from libero_env.tasks.rules import KINDS
from libero_integrations.exports.regeneration import Regeneration, regenerate
from tests.harness.demos import generate

A, B, C = (Atom("Open", (name,)) for name in ("a", "b", "c"))
GOALS = [
    "(Then (Open a) (Open b))",
    "(Then (Open a) (Open b) (Open c))",
    "(Never (Open a))",
    "(Not (Never (And (Open a) (Open b))))",
    "(Count 1 (Open a))",
    "(Count 3 (Or (Open a) (Not (Open b))))",
    "(And (Then (Open b) (Open a)) (Never (Open c)))",
    "(Then (Count 2 (Open a)) (Not (Open b)))",
    "(Count 2 (Then (Open a) (Open b)))",
    "(Never (Then (Open a) (Never (Open c))))",
]


def holds(node, moments, t):
    """Return whether a goal holds at moment t, literally as it is defined."""
    parts = node.children
    match node:
        case Atom():
            return moments[t][node]
        case Then((before, after)):
            began = t
            while began and holds(after, moments, began - 1):
                began -= 1
            return holds(after, moments, t) and any(holds(before, moments, s) for s in range(began))
        case Never(part):
            return not any(holds(part, moments, s) for s in range(t + 1))
        case Count(number, part):
            seen = [holds(part, moments, s) for s in range(t + 1)]
            return sum(now and not was for was, now in zip(seen, seen[1:], strict=False)) >= number
    found, kind = [holds(part, moments, t) for part in parts], type(node).__name__
    return not found[0] if kind == "Not" else (any if kind == "Or" else all)(found)


@pytest.mark.parametrize("text", GOALS)
def test_what_is_remembered_gives_what_the_definition_says(text):
    goal, rng, ids = bddl.parse_expression(text), np.random.default_rng(0), np.arange(40)
    history = History(goal, len(ids))
    episodes = rng.random((9, 3, len(ids))) < 0.5
    for t in range(len(episodes)):
        held = dict(zip((A, B, C), episodes[t], strict=True))
        for _ in range(2):  # looking again changes nothing
            found = history.look(ids, held)
        for i in ids:
            moments = [dict(zip((A, B, C), moment[:, i], strict=True)) for moment in episodes]
            assert found[i] == holds(goal, moments, t), (t, moments[: t + 1])
            assert bool(history.missing(i, moments[t])) <= (not found[i])


def test_task_files_keep_them_and_differences_see_the_order():
    goals = [bddl.parse_expression(text) for text in GOALS]
    assert [bddl.parse_expression(str(goal)) for goal in goals] == goals
    assert goals[1] == Then((Then((A, B)), C))
    problem = STEPS.problem
    assert bddl.parse(bddl.write(problem)) == problem
    assert differences(problem, replace(problem, goal=Then(tuple(reversed(problem.goal.parts)))))
    counts = (replace(problem, goal=Count(n, problem.goal)) for n in (1, 2))
    assert differences(*counts)


@pytest.mark.parametrize(("text", "message"), [
    ("(Then (Open a))", r"\(Then \(Open a\)\); expected \(Then EXPRESSION EXPRESSION ...\)"),
    ("(Never (Open a) (Open b))", r"expected \(Never EXPRESSION\)"),
    ("(Never a)", "not an atom: a"),
    ("(Count 0 (Open a))", "0 in a Count; expected a whole number from 1 to 999"),
    ("(Count 1.5 (Open a))", "1.5 in a Count"),
    ("(Count (Open a))", r"expected \(Count NUMBER EXPRESSION\)"),
])  # fmt: skip
def test_what_is_none_is_refused_in_one_line(text, message):
    with pytest.raises(BDDLError, match=message) as error:
        bddl.parse_expression(text, "task.bddl", 7)
    assert str(error.value).startswith("task.bddl:7: ") and "\n" not in str(error.value)


def test_in_python_too():
    with pytest.raises(InvalidInputError, match="number is 1000; expected less than or equal to 999"):
        Count(1000, A)
    with pytest.raises(InvalidInputError, match="parts"):
        Then((A,))
    with pytest.raises(LiberoError, match="is not a valid name; use letters.* none of And, Count"):
        register_predicate("never", lambda view, a: True)


def aside(view, name: str, metres: float):
    """Return whether the hand is to the left of a line, whatever the name."""
    return view.eef_pos[1] > metres


@contextmanager
def own():
    register_predicate("aside", aside)
    yield
    KINDS.pop("Aside")
    for table in SEMANTICS.values():
        table.pop("Aside")


@pytest.fixture(scope="module", autouse=True)
def own_predicate():
    with own():
        yield


PLACES = {
    "scene": "kitchen",
    "objects": ["butter", "plate"],
    "place": {"butter_1": (0.0, 0.2), "plate_1": (0.0, -0.2)},
    "language": "wave over the plate and the butter",
}
LEFT, RIGHT = "(Aside plate_1 0.03)", "(Not (Aside plate_1 -0.03))"
with own():  # not longer: the workers of all tests would import this module
    STEPS = make_task(**PLACES, goal=f"(Then {LEFT} {RIGHT})")


def moves(*ways):
    return [[0.0, way, 0, 0, 0, 0, -1] for way in ways for _ in range(12)]


def run(env, actions):
    """Return after which of the actions the goal was reached; None for never."""
    for k, action in enumerate(actions):
        if env.step(np.array(action))[2]:
            return k
    return None


def test_success_follows_the_order_in_every_environment():
    first, wrong = moves(1, -1, -1), moves(-1, 1)
    with LiberoEnv(STEPS, cameras=()) as env:
        env.reset(seed=0)
        reached = run(env, first)
        assert reached is not None and reached > 12, "left, then right"
        env.reset(seed=0)
        assert run(env, wrong) is None, "a reset forgets, and right, then left is another order"
    with BatchEnv(STEPS, 2, cameras=()) as envs:
        envs.reset(seed=[0, 0])
        over = np.full(2, -1)
        for k, pair in enumerate(zip(first, [*wrong, *moves(0)], strict=True)):
            ended = envs.step(np.array(pair))[2]
            over[ended & (over < 0)] = k
        assert over.tolist() == [reached, -1]


def test_a_state_keeps_what_was_remembered():
    actions = moves(1, -1, -1)
    with LiberoEnv(STEPS, cameras=()) as env, BatchEnv(STEPS, 3, cameras=()) as other:
        env.reset(seed=0)
        assert run(env, actions[:24]) is None
        state = env.get_state()
        left = run(env, actions[24:])
        assert left is not None
        other.reset(seed=[1, 2, 3])
        other.set_state(1, state)
        for k, action in enumerate(actions[24:]):
            ended = other.step(np.tile(action, (3, 1)))[2]
            assert ended[1] == (k == left)
            if ended[1]:
                break
        env.reset(seed=5)
        env.set_state(state[: 1 + env.scene.model.nq + env.scene.model.nv])
        assert run(env, actions[24:]) is None, "[time, qpos, qvel] remembers nothing"
        broken = state.copy()
        broken[-2] = 0.5
        with pytest.raises(InvalidInputError, match="what the goal remembers"):
            env.set_state(broken)


def test_recordings_that_are_run_again_are_judged_by_all_their_moments(tmp_path, monkeypatch):
    def wave(env, experts, noise, max_steps):
        actions, states, ended = np.array(moves(1, -1, -1)), [], False
        physics = lambda: [env.simulations.physics_state(i) for i in range(env.num_envs)]  # noqa: E731
        while not np.any(ended):
            states.append(physics())
            ended = env.step(np.tile(actions[len(states) - 1], (env.num_envs, 1)))[2]
        states, done = np.array([*states, physics()]), actions[: len(states)]
        fixtures = env.simulations.fixtures
        return [
            Attempt(bool(ended[i]), states[:, i], done, done, 0, "", fixtures[i].copy())
            for i in range(len(experts))
        ]

    monkeypatch.setattr("libero_env.demos.record.run_experts", wave)
    file = generate(STEPS, 1, path=tmp_path / "wave.hdf5", camera_size=(16, 16), workers=1)
    again = rerun_actions(file, tmp_path / "again.hdf5")
    for recorded in (file, again):
        assert [episode.success for episode in read_episodes(recorded)] == [True]
        assert [one.success for mode in REPLAY_MODES for one in replay(recorded, by=mode)] == [True, True]
    settings = Regeneration(size=(16, 16), assets="builtin", drawing="fast")
    assert [one.success for one in regenerate(file, settings)] == [True]


@pytest.mark.parametrize(("goal", "actions", "cause"), [
    (f"(And (On butter_1 plate_1) (Never {RIGHT}))", moves(-1), "forbidden"),
    (f"(And (On butter_1 plate_1) (Then {RIGHT} {LEFT}))", moves(0), "never reached"),
    ("(Then (Not (Aside plate_1 -0.03)) (Aside plate_1 -9))", moves(-1), "wrong order"),
    (f"(Then (On butter_1 plate_1) {LEFT})", moves(0), "never reached"),
    ("(Count 3 (On butter_1 plate_1))", moves(0), "never reached"),
])  # fmt: skip
def test_causes_of_failure(goal, actions, cause):
    with BatchEnv(make_task(**PLACES, goal=goal), 1, cameras=()) as env:
        env.reset(seed=[0])
        watch = EpisodeWatch(env.views, env.goals.atoms)
        for action in actions:
            env.step(np.array([action]))
            watch.look(0)
        found = watch.failure(0, [False] * len(env.atoms), env.missing(0))
        assert found.cause == cause, found
        assert (found.what[:6] in ("(Never", "(Then ")) == (cause in ("forbidden", "wrong order"))


STOVE = {
    "scene": "kitchen",
    "furniture": ["flat_stove"],
    "objects": ["plate"],
    "place": {"flat_stove_1": (-0.2, 0.2), "plate_1": (0.1, -0.2)},
    "language": "turn the stove on, and then off",
}
ON_OFF = "(Then (Turnon flat_stove_1) (Turnoff flat_stove_1))"


TWICE = "(And (Count 2 (Turnon flat_stove_1)) (Never (Incontact robot plate_1)))"


@pytest.mark.parametrize(("goal", "times"), [(ON_OFF, 1), (TWICE, 2)])
def test_the_expert_solves_them_in_order(goal, times):
    with LiberoEnv(make_task(**STOVE, goal=goal), cameras=(), horizon=900) as env:
        env.reset(seed=0)
        expert, terminated, truncated, seen = Expert(env.task, np.random.default_rng(0)), False, False, []
        while not (terminated or truncated or expert.failure_reason):
            *_, terminated, truncated, info = env.step(expert.act(env.view))
            seen.append(info["progress"]["(Turnon flat_stove_1)"])
        assert terminated, expert.failure_reason
        assert sum(now and not was for was, now in zip(seen, seen[1:], strict=False)) == times


@pytest.mark.parametrize(("goal", "message"), [
    ("(Then (Turnon flat_stove_1) (On plate_1 kitchen_table_all))", "no skill ends it so that it can begin again"),
    ("(And (Turnon flat_stove_1) (Never (Not (Turnon flat_stove_1))))", "is broken, and no skill takes that back"),
])  # fmt: skip
def test_what_the_expert_cannot_do_is_refused_by_name(goal, message):
    regions = {"kitchen_table": {"all": {"at": (0.0, 0.0), "half": 0.5}}}
    with LiberoEnv(make_task(**STOVE, regions=regions, goal=goal), cameras=()) as env:
        env.reset(seed=0)
        with pytest.raises(UnsupportedGoalError, match=message):
            plan_goal(env.task.problem.goal, env.view)


@pytest.mark.parametrize(("task", "options"), [
    (STEPS, {}),
    (make_task(**STOVE, goal="(And (Turnon flat_stove_1) (Not (Up plate_1)))"), {}),  # rewards what must not be
    (make_task(**STOVE, goal="(ForAll (?x - plate) (Up ?x))"), {}),  # has no atoms to reward
    ("libero_goal/6", {"perturb": "goal=1@step40"}),  # has those of both goals
], ids=str)  # fmt: skip
def test_no_staged_reward(task, options):
    with pytest.raises(InvalidInputError, match="reward=staged counts the atoms of one goal that hold, but "):
        BatchEnv(task, 1, cameras=(), reward="staged", **options)


def test_the_original_refuses_them_and_lint_and_certify_say_so(tmp_path, capsys):
    from libero.libero.envs.bddl_utils import robosuite_parse_problem

    path = tmp_path / "on_off.bddl"
    write_task(make_task(**STOVE, goal=ON_OFF), path)
    with pytest.raises(
        BDDLError, match=r"on_off.bddl:\d+: \(Then .*expected a goal without Then, Never and Co"
    ):
        robosuite_parse_problem(str(path))
    main(["tasks", "lint", str(path), "--starts", "1"])
    assert "is of this package: the original's reader refuses such a goal" in capsys.readouterr().out
    main(["tasks", "certify", str(path), "--states", "1", "--jobs", "1", "--out", str(tmp_path)])
    out = capsys.readouterr().out
    assert f"the original's reader refuses {ON_OFF}" in out and "1/1" in out
