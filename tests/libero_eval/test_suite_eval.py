"""Evaluation of policies on tasks: fixed initial states, resumption, user-defined policies."""

import json
import shutil
import sys
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from libero_cli import main as cli
from libero_env import LiberoEnv, memory
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_suite, get_task
from libero_eval.evaluation_file import EvaluationResult, Stopped, overall
from libero_eval.plan import choose_init_states, plan_evaluation
from libero_eval.plan import evaluate as evaluate_request
from libero_eval.repeating import repeated
from libero_eval.requests import EvalRequest
from libero_eval.user_policy import (
    ORIGINAL_NAMES,
    UserPolicy,
    as_original,
    load_callable,
    weights_digest,
)
from lifelong.errors import ConfigError, LifelongError, PolicyError, ProtocolError
from lifelong.results.run_directory import CheckpointFolder
from lifelong.stats.intervals import Estimate, wilson_interval
from tests.harness.evaluations import QUICK, TASKS, Still, evaluate, evaluation, write_policy
from tests.harness.results import result_of, task_result
from tests.harness.runs import make_run

MODULE = """
import numpy as np

class Policy:
    cameras, observations = (), ("proprioception", "ee_quat")
    calls, seeds = [], []

    def reset(self, instruction, num_envs, seeds):
        self.calls.append((instruction, num_envs))
        self.seeds.append(seeds)

    def predict(self, observations):
        return np.tile([0, 0, 1, 0, 0, 0, 0], (len(observations["robot0_eef_pos"]), 1))

def make():
    return Policy()

"""


def test_success_with_intervals_overall_and_by_task(tmp_path):
    policy = Still()
    result = evaluate(tmp_path, policy)
    results = result.tasks
    assert [r.successes for r in results] == [(True, True, True, False)] * 2
    assert results[0].lengths == (3, 4, 9, 10) and results[0].steps == pytest.approx(16 / 3)
    assert np.isnan([results[0].success.low, results[0].success.high]).all(), "of four episodes"
    assert set(policy.instructions) == {t.language for t in TASKS}
    found = json.loads((tmp_path / "eval.json").read_text())
    assert EvaluationResult.read(tmp_path) == result
    assert found["success"]["value"] == 0.75
    low, high = map(float, wilson_interval(6, 8))
    assert overall(results) == Estimate(0.75, low, high), "of all episodes"
    assert found["predicates"] == {"Turnon": 1.0, "On": 0.75}
    assert found["init_states"] == [3, 4, 9, 20] and found["evaluated"] == {"policy": "still"}


def test_results_of_another_evaluation_are_not_mixed_in(tmp_path):
    evaluate(tmp_path)
    with pytest.raises(
        ConfigError, match=r"another evaluation: simulation.mujoco.* there and .* here.*--again"
    ):
        evaluate(tmp_path, versions={"mujoco": "4"})


def test_another_source_of_the_package_is_told_and_stated(tmp_path, capsys):
    """As after another commit: what is done stays, and the result names both."""
    first = evaluation(tmp_path, unit_starts=2, tasks=TASKS[:1], versions={"mujoco": "3", "source": "aaa"})
    request = EvalRequest(policy="expert")
    evaluate_request(request, first)
    assert "another source" not in capsys.readouterr().err
    second = evaluation(tmp_path, unit_starts=2, versions={"mujoco": "3", "source": "bbb"})
    grown = evaluate_request(request, second)
    assert "another source of this package (aaa; here bbb)" in capsys.readouterr().err
    assert grown.versions == {"mujoco": "3", "source": ["aaa", "bbb"]}


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    make_run(path)
    return path


@pytest.mark.parametrize(("policy", "change", "told"), [
    ("run", {"seed": 1}, "evaluated.seed is 0 there and 1 here"),
    ("run", {"horizon": 7}, "protocol.episode.horizon"),
    ("run", {"unit_starts": 3}, "unit_starts"),
    ("expert", {"policy": "run"}, "evaluated.policy is"),
])  # fmt: skip
def test_what_an_evaluation_is_asked_for_is_part_of_it(learned, policy, change, told, tmp_path):
    """A folder of one's own is refused to another evaluation; equal ones and larger ones go on in it."""
    names = {"run": str(learned), "expert": "expert"}
    suite = ("libero_object/0", "libero_object/1")
    words = {"policy": names[policy], "suite": suite, "episodes": 2, "out": tmp_path}

    def join(**more):
        more = {key: names.get(value, value) if key == "policy" else value for key, value in more.items()}
        plan = plan_evaluation(EvalRequest(**{**words, **more}))
        plan.store.join(plan.units)

    join()
    with pytest.raises(ConfigError, match=told):
        join(**change)
    join(workers=2, retries=3, threads=1)
    join(episodes=4, suite=(*suite, "libero_object/2"))


def test_a_protocol_says_how_many_episodes_and_tasks_it_counts(tmp_path):
    own, words = tmp_path / "own.yaml", {"policy": "expert", "suite": ("libero_goal/0",), "out": tmp_path}
    own.write_text("extends: libero\ncounting:\n  trials: 2\n  tasks: 1\n")
    count = lambda **more: len(plan_evaluation(EvalRequest(**words, protocol=str(own), **more)).init_states)  # noqa: E731
    assert (count(), count(episodes=3), count(starts="selection")) == (2, 3, 20)
    with pytest.raises(ConfigError, match=r"own counts 1 tasks of a suite .*; these are 10 of libero_goal"):
        words["suite"] = ("libero_goal",)
        count()


OPTIONS = {
    "names": "original", "size": 64, "timeout": 3.0, "in_flight": 2, "device": "cuda:9", "after": 0, "allow": ("foo",),
    "perturb_seed": 3, "policy_threads": 2
}  # fmt: skip


@pytest.mark.parametrize(("policy", "options"), [
    ("expert", ("names", "size", "timeout", "in_flight", "device", "after", "allow", "perturb_seed", "policy_threads")),
    ("ws://localhost:1", ("names", "size", "device", "after", "allow", "perturb_seed", "policy_threads")),
    ("run", ("names", "size", "timeout", "in_flight", "perturb_seed")),
    ("os:getcwd", ("timeout", "in_flight", "device", "after", "allow", "perturb_seed")),
])  # fmt: skip
def test_an_option_that_a_policy_does_not_obey_is_refused_by_name(learned, policy, options):
    words = {"policy": str(learned) if policy == "run" else policy, "suite": ("libero_goal/0",)}
    for name in options:
        with pytest.raises(ConfigError, match=f"--{name.replace('_', '-')} "):
            plan_evaluation(EvalRequest(**words, **{name: OPTIONS[name]}))


def test_what_moves_relative_to_its_pose_is_refused_absolute_actions(learned, tmp_path):
    (tmp_path / "own.yaml").write_text("extends: libero\nworld: {delta: false}\n")
    for policy in ("expert", str(learned)):
        with pytest.raises(ConfigError, match="own has absolute actions"):
            plan_evaluation(
                EvalRequest(policy=policy, suite=("libero_goal/0",), protocol=str(tmp_path / "own.yaml"))
            )


@pytest.mark.parametrize("changes", [
    {"episodes": 3}, {"unit_starts": 3}, {"suite": ("libero_10",)},
])  # fmt: skip
def test_a_result_is_run_again_as_it_was_and_in_no_other_way(changes, tmp_path):
    file = result_of(task_result("libero_goal/0", [True]), policy="expert").write(tmp_path / "eval.json")
    request = EvalRequest(policy=str(file), **changes)
    with pytest.raises(ConfigError, match=f"--{next(iter(changes)).replace('_', '-')}.*is run again"):
        repeated(request, EvaluationResult.read(file))


def test_a_result_of_a_run_is_run_again_with_the_episodes_it_had(learned, tmp_path):
    changes = {"horizon": 77, "robot": "robosuite-1.4.1"}
    first = plan_evaluation(EvalRequest(policy=str(learned), suite=("libero_goal/0",), **changes))
    assert first.protocol.world.robot == "robosuite-1.4.1"
    values = {"evaluated": dict(first.identity), "versions": dict(first.versions)}
    task = task_result("libero_goal/0", [True], digest=first.tasks[0].digest)
    file = result_of(task, protocol=first.protocol.resolved(), **values).write(tmp_path / "eval.json")
    assert plan_evaluation(EvalRequest(policy=str(file))).protocol == first.protocol
    with pytest.raises(ProtocolError, match="robot is 'panda'; expected.*robosuite-1.4.1"):
        plan_evaluation(EvalRequest(policy="expert", suite=("libero_goal/0",), robot="panda"))


def test_a_file_of_the_name_libero_is_a_protocol_of_its_own(learned, tmp_path):
    own = tmp_path / "libero.yaml"
    own.write_text("extends: libero\nepisode: {horizon: 33}\nlanguage: {source: bddl}\n")
    plan = plan_evaluation(
        EvalRequest(policy=str(learned), suite=("libero_goal/0",), protocol=str(own), out=tmp_path)
    )
    assert plan.protocol.episode.horizon == 33
    assert plan.protocol.language.source == "file_name", "what a run is told"


def test_a_result_states_the_words_that_were_told(tmp_path):
    task = next(task for task in get_suite("libero_goal").tasks if task.language != task.problem.language)
    told = QUICK.changed({"language.source": "bddl", "language.template": "Task: {instruction}"})
    for protocol, words in ((QUICK, task.language), (told, task.problem.language)):
        result = evaluate(tmp_path / protocol.language.source, tasks=[task], protocol=protocol)
        assert result.tasks[0].instruction == words


def test_task_files_are_evaluated_one_by_one_and_named_again(tmp_path):
    files = [tmp_path / f"{name}.bddl" for name in ("one", "two")]
    for file in files:
        file.write_text(TASKS[0].bddl_text)
    with pytest.raises(ConfigError, match="one and two: task files are evaluated one by one"):
        plan_evaluation(EvalRequest(policy="expert", suite=tuple(map(str, files)), out=tmp_path))
    plan = plan_evaluation(EvalRequest(policy="expert", suite=(str(files[0]),), out=tmp_path))
    task = task_result("file/0", [True], name="one", digest=plan.tasks[0].digest)
    values = {
        "evaluated": dict(plan.identity),
        "protocol": plan.protocol.resolved(),
        "versions": dict(plan.versions),
    }
    path = str(result_of(task, **values).write(tmp_path / "eval.json"))
    with pytest.raises(ConfigError, match="of a task file, one; name the file with --suite"):
        plan_evaluation(EvalRequest(policy=path))
    again = plan_evaluation(EvalRequest(policy=path, suite=(str(files[0]),)))
    assert again.tasks[0].digest == task.digest
    files[0].write_text(TASKS[1].bddl_text)
    with pytest.raises(ConfigError, match="task file/0: "):
        plan_evaluation(EvalRequest(policy=path, suite=(str(files[0]),)))


def test_a_result_that_was_stopped_stays_one_when_it_is_run_again(tmp_path):
    stopped = Stopped("width=0.5", "known", 100)
    assert evaluate(tmp_path, stopped=stopped).stopped == stopped == EvaluationResult.read(tmp_path).stopped


def test_intervals_of_what_was_stopped_are_always_valid_for_each_task_too():
    task = task_result("libero_goal/0", [True] * 15 + [False] * 5)
    result = result_of(task, stopped=Stopped("width=0.5", "known", 100))
    (plain,) = result.to_plain()["tasks"]
    assert plain["success"] == result.to_plain()["success"] != asdict(task.success)


@pytest.mark.parametrize("had", [True, False])
def test_a_result_is_not_run_again_without_its_weights_nor_with_weights_that_it_had_not(
    had, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    Path("weighed.py").write_text(
        "from pathlib import Path\nclass make:\n    def __init__(self):\n"
        "        self.identity = {'weights': 'step 3'} if Path('weights').exists() else {}\n"
        "    def predict(self, observations): ...\n"
    )
    Path("weights").write_text("") if had else None
    first = plan_evaluation(EvalRequest(policy="weighed:make", suite=("libero_goal/0",)))
    values = {"evaluated": dict(first.identity), "versions": dict(first.versions)}
    task = task_result("libero_goal/0", [True], digest=first.tasks[0].digest)
    result_of(task, protocol=first.protocol.resolved(), **values).write("eval.json")
    again = EvalRequest(policy="eval.json", allow=("weighed",))
    assert plan_evaluation(again).identity == first.identity
    Path("weights").unlink() if had else Path("weights").write_text("")
    then, now = ("step 3", "None") if had else ("None", "step 3")
    with pytest.raises(ConfigError, match=f"weights: {then} in the result, {now} here"):
        plan_evaluation(again)
    assert plan_evaluation(replace(again, despite=("weights",)))


def test_episodes_that_were_not_filmed_are_told(tmp_path, capsys):
    request = EvalRequest(policy="expert")
    evaluate_request(request, evaluation(tmp_path))
    evaluate_request(request, evaluation(tmp_path, videos=1))
    assert "to be filmed are done, and are not filmed; --again" in capsys.readouterr().err


def test_other_weights_in_the_same_run_are_another_policy(learned, tmp_path):
    shutil.copytree(learned, tmp_path / "run")
    request = EvalRequest(policy=str(tmp_path / "run"), episodes=2, device="cpu")
    first = plan_evaluation(request)
    first.store.join(first.units)
    saved = CheckpointFolder(tmp_path / "run" / "checkpoints")
    state = saved.load_task(saved.task_path(1))
    next(iter(state["policy"].values())).add_(0.1)
    saved.save_task(1, state["policy"], state["algorithm"])
    second = plan_evaluation(request)
    assert second.out == first.out, "the folder of the run"
    with pytest.raises(ConfigError, match="evaluated.weights is"):
        second.store.join(second.units)
    assert plan_evaluation(replace(request, after=0)).out != first.out


def test_another_version_of_the_expert_is_another_policy(tmp_path, monkeypatch):
    request = EvalRequest(policy="expert", suite=("libero_goal/0",), out=tmp_path)
    first = plan_evaluation(request)
    first.store.join(first.units)
    monkeypatch.setattr("libero_env.demos.config.GENERATOR", "expert-999")
    second = plan_evaluation(request)
    with pytest.raises(ConfigError, match="evaluated.generator is"):
        second.store.join(second.units)


def test_the_expert_that_avoids_is_another_policy_and_is_run_again_from_its_result(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    words = ["--suite", "libero_goal/4", "--episodes", "1", "--horizon", "50", "--threads", "1"]
    for name in ("expert", "expert-avoid"):
        assert cli.main(["eval", name, *words]) == 0
    plain, avoiding = (
        EvaluationResult.read(f"eval/{name}/horizon=50") for name in ("expert", "expert-avoid")
    )
    assert avoiding.evaluated["policy"] == "expert-avoid" and plain.actions != avoiding.actions
    assert (
        cli.main(["eval", "eval/expert-avoid/horizon=50/eval.json", "--threads", "1", "--out", "again"]) == 0
    )
    assert EvaluationResult.read("again").actions == avoiding.actions
    assert cli.main(["eval", "expert-careful", *words]) == 2 and "expert-careful" in capsys.readouterr().err


def test_an_evaluation_grows_by_starts_and_tasks_and_never_shrinks(tmp_path):
    """What is done is kept, and the result is that of asking for all of it at once."""
    first, counted = {"tasks": TASKS[:1], "init_states": (3, 4), "unit_starts": 2}, []
    evaluate(tmp_path / "grown", **first)
    kept = (tmp_path / "grown" / "units" / "libero_goal_00_starts_03_04.json").stat().st_mtime_ns

    class Counting(Still):
        def reset(self, instruction, num_envs):
            counted.append((instruction, num_envs))

    whole = evaluate(tmp_path / "grown", Counting(), unit_starts=2)
    assert counted == [(TASKS[0].language, 2), (TASKS[1].language, 2), (TASKS[1].language, 2)]
    assert whole == evaluate(tmp_path / "at_once", unit_starts=2) == EvaluationResult.read(tmp_path / "grown")
    assert (tmp_path / "grown" / "units" / "libero_goal_00_starts_03_04.json").stat().st_mtime_ns == kept
    for less in ({"tasks": TASKS[:1]}, {"init_states": (3, 4)}, {"init_states": (3, 4, 9, 21)}):
        with pytest.raises(
            ConfigError, match=r"grown holds also the (tasks|init_states) \[.*can grow, but not"
        ):
            evaluate(tmp_path / "grown", **{"unit_starts": 2, **less})
    assert EvaluationResult.read(tmp_path / "grown") == whole


def test_a_batch_that_was_not_full_is_run_again_when_an_evaluation_grows(tmp_path):
    evaluate(tmp_path / "grown", init_states=(3, 4, 9), unit_starts=2)
    found = evaluate(tmp_path / "grown", unit_starts=2)
    assert found == evaluate(tmp_path / "at_once", unit_starts=2)


def test_who_was_asked_for_less_does_not_write_the_result_of_the_whole(tmp_path):
    less = evaluation(tmp_path, init_states=(3, 4), unit_starts=2)
    less.store.join(less.units)
    whole = evaluate(tmp_path, unit_starts=2)
    result = less.result(less.store.done(less.units))
    assert result.init_states == (3, 4) and not less.store.is_whole(less.units)
    assert EvaluationResult.read(tmp_path) == whole


def test_selection_and_reporting_states_are_disjoint():
    chosen, reported = (choose_init_states(which, None, range(15)) for which in ("selection", "reporting"))
    assert set(chosen).isdisjoint(reported) and set(chosen) | set(reported) == set(
        choose_init_states("all", None)
    )
    assert len(chosen) == 15 and choose_init_states("reporting", 4, range(15)) == (15, 16, 17, 18)
    assert choose_init_states("reporting", 2) == (0, 1) and len(choose_init_states("selection", None)) == 20
    with pytest.raises(ConfigError, match="1 to 15"):
        choose_init_states("selection", 16, range(15))


def test_names_and_conventions_of_the_original():
    frames = np.arange(2 * 3 * 4 * 3).reshape(2, 3, 4, 3)
    found = as_original(
        {"agentview_rgb": frames, "ee_quat": np.array([[1.0, 0, 0, 0]]), "other": np.zeros(2)}
    )
    np.testing.assert_array_equal(found["agentview_image"], frames[:, ::-1])
    np.testing.assert_array_equal(found["robot0_eef_quat"], [[0, 0, 0, 1]])
    assert "other" in found and set(ORIGINAL_NAMES) >= {"agentview_rgb", "ee_quat"}


def test_objects_and_the_robot_are_those_of_the_facade_under_the_original_s_names(tmp_path):
    from libero.libero.envs import OffScreenRenderEnv

    task, file = get_task("libero_goal/4"), tmp_path / "task.bddl"
    file.write_text(task.bddl_text)
    native = LiberoEnv(task, cameras=(), observations=("proprioception", "ee_quat", "objects"))
    with closing(native), closing(OffScreenRenderEnv(bddl_file_name=str(file))) as original:
        original.reset()
        seen, _ = native.reset(options={"init_state": 0})
        model = native.scene.model
        wanted = original.set_init_state(native.get_state()[: 1 + model.nq + model.nv])
        found = as_original({name: value[None] for name, value in seen.items()})
        names = [name for name in found if name in wanted and name.endswith(("_pos", "_quat", "_qpos"))]
        assert any("_to_robot0_eef_quat" in name for name in names)
        for name in names:
            np.testing.assert_allclose(found[name][0], wanted[name], atol=1e-5, err_msg=name)


def test_an_identity_does_not_name_what_a_result_states_itself(tmp_path, monkeypatch):
    """The training seed was replaced by `--seed`."""
    monkeypatch.chdir(tmp_path)
    write_policy(tmp_path / "named.py", "None", "identity = {'seed': 5}")
    with pytest.raises(PolicyError, match="identity names seed, .* call it own_seed"):
        UserPolicy(EvalRequest(policy="named:make"))


@pytest.mark.parametrize(("more", "options", "message"), [
    ('observations = ("rgb", "depth")', {}, "the original's depth are in other units.*--names native"),
    ("camera_size = (32, 48)", {"size": 64}, "--size 64: .* has a size of its own, camera_size 32 x 48"),
])  # fmt: skip
def test_what_a_policy_would_misread_is_refused(more, options, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    name = f"odd_{next(iter(options), 'depth')}"
    write_policy(tmp_path / f"{name}.py", "None", more)
    words = {"policy": f"{name}:make", "suite": ("libero_goal/0",), "protocol": "openpi"}
    with pytest.raises(ConfigError, match=message):
        plan_evaluation(EvalRequest(**words, **options))
    assert plan_evaluation(EvalRequest(**words, names="native"))


@pytest.mark.sim
def test_a_policy_sees_the_protocol_s_cameras_unless_it_names_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "one.yaml").write_text("{extends: libero, pixels: {cameras: [agentview]}}")
    for name, own in (("all_seeing", "pass"), ("one_eyed", "cameras = ('robot0_eye_in_hand',)")):
        write_policy(tmp_path / f"{name}.py", "None", own)
        plan = plan_evaluation(
            EvalRequest(policy=f"{name}:make", suite=("libero_goal/0",), protocol="one.yaml")
        )
        with closing(plan.env(plan.tasks[0], 1)) as env:
            assert env.config.cameras == (("robot0_eye_in_hand",) if "cameras" in own else ("agentview",))


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_own_policy.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    return "my_own_policy"


def test_a_policy_from_a_module_of_the_working_directory(module):
    before = list(sys.path)
    assert load_callable(f"{module}:make").calls == []
    assert sys.path == before


def test_a_module_of_another_folder_with_the_same_name_is_refused(module, tmp_path, monkeypatch):
    load_callable(f"{module}:make")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / f"{module}.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path / "other")
    with pytest.raises(LifelongError, match="already imported my_own_policy from .*, which is not .*other"):
        load_callable(f"{module}:make")


@pytest.mark.sim
def test_a_result_is_run_again_from_its_file(module, tmp_path, capsys):
    command = ["eval", f"{module}:make", "--suite", "libero_goal/3", "--episodes", "2", "--horizon", "3"]
    command += ["--protocol", "openpi", "--seed", "4", "--names", "original", "--threads", "1"]
    assert cli.main([*command, "--out", "found"]) == 0
    calls, printed = sys.modules[module].Policy.calls, capsys.readouterr().out
    assert "libero_goal/3" in printed and "0/2" in printed and "mean over tasks" in printed
    assert cli.main([*command, "--out", "found"]) == 0 and len(calls) == 1, "it is done"
    assert cli.main([*command, "--out", "found", "--again"]) == 0 and len(calls) == 2
    assert cli.main(["eval", "found/eval.json", "--threads", "1"]) == 2
    assert f"--allow {module}" in capsys.readouterr().err, "a result may be somebody else's"
    assert cli.main(["eval", "found/eval.json", "--threads", "1", "--allow", module]) == 0
    first, again = EvaluationResult.read("found"), EvaluationResult.read("found/again")
    assert (first.outcomes, first.actions) == (again.outcomes, again.actions)
    seeds = sys.modules[module].Policy.seeds
    assert len(set(seeds[0])) == 2 and seeds[0] == seeds[1] == seeds[2]
    assert calls == [(first.tasks[0].instruction, 2)] * 3
    assert (first.evaluated, first.protocol) == (again.evaluated, again.protocol)
    other = replace(first, versions={**first.versions, "mujoco": "3.0.0"})
    other.write(tmp_path / "other" / "eval.json")
    capsys.readouterr()
    assert cli.main(["eval", "other/eval.json", "--allow", module]) == 2
    assert "mujoco: 3.0.0 in the result" in (err := capsys.readouterr().err) and "--despite mujoco" in err
    assert cli.main(["eval", "other", "--threads", "1", "--allow", module, "--despite", "mujoco"]) == 0
    assert EvaluationResult.read("other/again").actions == first.actions


@pytest.mark.sim
@pytest.mark.slow
def test_several_workers_of_the_command_line_have_the_result_of_one(module, tmp_path, capsys, monkeypatch):
    command = ["eval", f"{module}:make", "--suite", "libero_object/3", "libero_goal/0", "--episodes", "5"]
    command += ["--protocol", "openpi", "--horizon", "3", "--unit-starts", "2"]
    assert cli.main([*command, "--out", "one"]) == 0
    assert cli.main([*command, "--out", "two", "--workers", "2"]) == 0
    printed = capsys.readouterr()
    assert printed.out.count("libero_goal/0") == 2 and "6 of 6 units, 10 of 10 episodes" in printed.err
    one, two = (EvaluationResult.read(tmp_path / name) for name in ("one", "two"))
    assert one == two and one.actions == two.actions and one.unit_starts == 2
    assert (one.environment["robot"], one.environment["models"]) == ("robosuite-1.4.1", "builtin")
    assert cli.main([*command, "--out", "until", "--workers", "2", "--until", "width=0.6"]) == 0
    until = EvaluationResult.read(tmp_path / "until")
    assert until.stop_note == "stopped after 6 of 10; width=0.6: known" and until.init_states == (0, 2, 4)
    assert until.tasks == tuple(task.of_starts(until.init_states) for task in one.tasks)
    assert cli.main([*command, "--out", "two", "--unit-starts", "5"]) == 2
    assert "unit_starts is 2 there and 5 here" in capsys.readouterr().err
    monkeypatch.setattr(memory, "host_memory", lambda: (10**9, 10**10))
    assert cli.main([*command, "--out", "three", "--workers", "3"]) == 2
    assert "by 3 processes needs about 1.8 GB" in capsys.readouterr().err and not Path("three").exists()


@pytest.mark.sim
def test_a_policy_sees_a_camera_that_it_adds(tmp_path, monkeypatch, capsys):
    quat = tuple(build_scene(get_task("libero_goal/0").problem).model.camera("agentview").quat)
    agent = f"Camera('agent', pos=(0.658613, 0, 1.61035), quat={[*map(float, quat)]})"
    own = f"cameras, camera_size, observations = ({agent}, 'agentview'), (32, 32), ('rgb',)"
    equal = "np.zeros((np.array_equal(observations['agent_rgb'], observations['agentview_rgb']) * 2, 7))"
    write_policy(tmp_path / "watching_policy.py", equal, "from libero_env import Camera", own)
    monkeypatch.chdir(tmp_path)
    command = ["eval", "watching_policy:make", "--suite", "libero_goal/0", "--episodes", "2", "--horizon"]
    command += ["2"]
    assert cli.main([*command, "--threads", "1", "--videos", "1"]) == 0
    assert EvaluationResult.read(next(tmp_path.glob("eval/*/*/eval.json"))).tasks[0].lengths == (2, 2)
    card = tmp_path / "mine.yaml"
    card.write_text("extends: libero\ntitle: t\npixels: {cameras: ['top,pos=0 0 2,lookat=0 0 1']}\n")
    assert cli.main([*command, "--protocol", str(card)]) == 2
    assert "pixels.cameras.0 is 'top,pos=0 0 2,lookat=0 0 1'; expected 'agentview'" in capsys.readouterr().err


@pytest.mark.sim
@pytest.mark.parametrize(("protocol", "position"), [("libero", "ee_pos"), ("openpi", "robot0_eef_pos")])
def test_a_unit_does_not_depend_on_those_before_it(protocol, position, tmp_path, monkeypatch):
    """The actions depend on every bit of the position, and their digest is part of the result."""
    x = f"observations['{position}']"
    actions = f"np.tanh(10 * np.concatenate([{x}, np.sin(1e6 * {x}), {x}[:, :1]], axis=1))"
    own = "cameras, observations = (), ('proprioception', 'ee_quat')"
    write_policy(tmp_path / "feeling_policy.py", actions, own)
    monkeypatch.chdir(tmp_path)
    request = EvalRequest(
        policy="feeling_policy:make", suite=("libero_goal/0",), episodes=4, unit_starts=2, horizon=5
    )
    plan = plan_evaluation(replace(request, protocol=protocol))
    monkeypatch.delitem(sys.modules, "feeling_policy")
    with plan.pool() as pool:
        in_turn = [plan.evaluate(unit, pool).result for unit in plan.units]
    with plan.pool() as pool:
        alone = plan.evaluate(plan.units[1], pool).result
    assert alone == in_turn[1] and len({*in_turn[0].actions, *in_turn[1].actions}) == 4


def test_a_seed_is_refused_where_nothing_takes_it(module, tmp_path):
    file = tmp_path / f"{module}.py"
    file.write_text(file.read_text().replace(", seeds)", ")").replace("self.seeds.append(seeds)", ""))
    with pytest.raises(ConfigError, match="--seed 7: .* an argument `seeds`"):
        UserPolicy(EvalRequest(policy=f"{module}:make", seed=7))


def test_what_a_policy_imports_and_holds_is_part_of_its_identity(module, tmp_path):
    """Another module beside it, or other weights with the same source, are another policy."""
    file, beside, weights = (tmp_path / name for name in (f"{module}.py", f"{module}_net.py", "weights.npy"))
    file.write_text(
        f"import {module}_net\nimport numpy as np\n"
        + file.read_text()
        + f"\nPolicy.w = [np.load({str(weights)!r})]\n"
    )

    def identity(source: str, value: float):
        beside.write_text(source)
        np.save(weights, np.full(3, value))
        for name in (module, f"{module}_net"):
            sys.modules.pop(name, None)
        return UserPolicy(EvalRequest(policy=f"{module}:make")).identity

    first = identity("x = 1", 0.0)
    assert identity("x = 1", 0.0) == first
    code, held = identity("x = 10", 0.0), identity("x = 1", 1.0)
    assert code["source"] != first["source"] and code["weights"] == first["weights"]
    assert held["source"] == first["source"] and held["weights"] != first["weights"]


def _of_closure(weights):
    class Policy:
        def predict(self, observations):
            return weights

    return Policy()


@dataclass(slots=True)
class _Slotted:
    weights: np.ndarray

    def act(self, observations):
        return self.weights


@pytest.mark.parametrize("make", [
    _of_closure,
    _Slotted,
    lambda weights: SimpleNamespace(predict=partial(np.add, weights)),
    lambda weights: SimpleNamespace(predict=_Slotted(weights).act),
    lambda weights: SimpleNamespace(steps=(SimpleNamespace(stats={"action": {"mean": weights}}),)),  # LeRobot's
], ids=["closure", "slots", "partial", "method", "processors"])  # fmt: skip
def test_weights_that_no_attribute_has_are_part_of_the_digest(make):
    digests = [weights_digest(make(np.full(3, value))) for value in (0.0, 0.0, 1.0)]
    assert digests[0] == digests[1] != digests[2] is not None
