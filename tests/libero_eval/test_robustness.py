"""What perturbations take: areas, where half is lost, interactions, the page."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from libero_eval.evaluation_file import EvaluationResult
from libero_eval.robustness.page import curves_figure, render, verdict, write_robustness
from libero_eval.robustness.results import (
    Condition,
    Outcomes,
    Robustness,
    differences,
    half_severity,
    name_of,
)
from libero_eval.robustness.study import read_study
from lifelong.errors import ConfigError, ResultsError
from tests.harness.results import result_of, task_result

TASKS, STARTS = ("libero_goal/0", "libero_goal/1"), tuple(range(10))
A, B = (("camera", 0.5),), (("camera", 1.0),)
C, BOTH = (("light", 1.0),), (("camera", 1.0), ("light", 1.0))


def outcomes(rates: dict[Condition, int], starts: int = 10) -> Outcomes:
    """Return outcomes in which each task's first starts succeed, `rates` of them."""
    rows = [[[s < n for s in range(starts)] for _ in TASKS] for n in rates.values()]
    return Outcomes(TASKS, tuple(range(starts)), tuple(rates), np.array(rows))


def result(wins: int, starts: tuple[int, ...] = STARTS, **changes) -> EvaluationResult:
    rows = [task_result(name, [s < wins for s in starts], starts) for name in TASKS]
    return replace(result_of(*rows, versions={}, protocol={}, evaluated={"run": "r"}), **changes)


def test_area_and_kept_are_those_of_the_trapezoids() -> None:
    camera = outcomes({(): 10, A: 6, B: 0}).axes[0]
    assert camera.kind == "camera" and camera.severities == (0.0, 0.5, 1.0)
    assert camera.area.value == pytest.approx((1 + 0.6) / 4 + (0.6 + 0) / 4)
    assert camera.kept.value == pytest.approx(camera.area.value)
    halved = outcomes({(): 5, A: 3, B: 0}).axes[0]
    assert halved.kept.value == pytest.approx(halved.area.value / 0.5)
    assert camera.area.low < camera.area.value < camera.area.high


@pytest.mark.parametrize(("rates", "half"), [
    ((1.0, 0.6, 0.4), 0.75), ((1.0, 0.5, 0.5), 0.5), ((0.8, 0.7, 0.6), math.inf),
    ((0.8, 0.2, 0.8), 1 / 3),  # the first time
    ((0.0, 0.0, 0.0), math.inf),  # nothing to lose
])  # fmt: skip
def test_half_is_lost_where_the_line_first_falls_to_half(rates: tuple[float, ...], half: float) -> None:
    assert half_severity((0.0, 0.5, 1.0), np.array(rates)) == pytest.approx(half)


def test_a_kind_that_changes_nothing_has_no_p_value_to_speak_of_and_keeps_all() -> None:
    axis = outcomes({(): 7, A: 7, B: 7}).axes[0]
    assert axis.kept.value == 1 and axis.p_value == 1 and axis.half.value == math.inf
    assert axis.kept.high - axis.kept.low < 0.25, "paired starts leave no more than one episode's doubt"
    assert axis.area.high - axis.area.low > axis.kept.high - axis.kept.low


def test_a_kind_that_takes_everything_is_shown_to() -> None:
    camera, light = outcomes({(): 10, A: 3, B: 0, C: 9}).axes
    assert (camera.kind, light.kind) == ("camera", "light"), "the most harmful first"
    assert camera.p_value < 0.01 < light.p_value
    assert camera.half.value == pytest.approx(0.5 / 0.7 * 0.5)


def test_two_that_act_independently_have_no_excess() -> None:
    rng = np.random.default_rng(0)
    base, camera, light = (rng.random((2, 400)) < p for p in (0.9, 0.6, 0.5))
    rows = np.array([base, base & camera, base & light, base & camera & light])
    found = Outcomes(TASKS, tuple(range(400)), ((), B, C, BOTH), rows)
    (pair,) = found.interactions
    assert not outcomes({(): 10, A: 6, C: 5, BOTH: 2}).interactions, (
        "a part was not run alone at its severity"
    )
    assert pair.expected == pytest.approx(0.27, abs=0.05)
    assert pair.excess.low < 0 < pair.excess.high and abs(pair.excess.value) < 0.04
    worse = replace(found, successes=np.array([*rows[:3], base & 0]))
    assert worse.interactions[0].excess.high < -0.2


def test_results_are_paired_by_task_and_start() -> None:
    found = Outcomes.of({B: result(2), (): result(8)})
    assert found.conditions == ((), B) and found.rates.tolist() == [0.8, 0.2]
    with pytest.raises(ResultsError, match=r"camera=1 was not run in the same tasks and starts"):
        Outcomes.of({(): result(8), B: result(2, tuple(range(1, 11)))})
    with pytest.raises(ResultsError, match="without perturbations"):
        Outcomes.of({B: result(2)})


LATE = (("clock", 0.05),)


def played(**sections) -> dict:
    return {"protocol": sections}


@pytest.mark.parametrize(("condition", "base", "other", "told"), [
    (B, played(world={"perturb": ""}), played(world={"perturb": "camera=1"}), ""),
    (B, played(episode={"horizon": 5}), played(episode={"horizon": 6}), "protocol.episode.horizon: 6 instead of 5"),
    (B, played(action={"clock": ""}), played(action={"clock": "latency=50ms"}), "protocol.action.clock: latency=50ms"),
    (LATE, played(action={"clock": ""}), played(action={"clock": "latency=50ms"}), ""),
    (LATE, {}, played(action={"clock": "latency=50ms,wait=hold"}), "protocol.action.clock"),
    (B, {}, {"evaluated": {"run": "other"}}, r"camera=1 .* \(evaluated.run: other instead of r\)"),
    (B, {"versions": {"torch": "3"}}, {"versions": {"torch": "4"}}, ""),
    (B, {"versions": {"mujoco": "3"}}, {"versions": {"mujoco": "4"}}, r"\(versions.mujoco: 4 instead of 3\)"),
])  # fmt: skip
def test_conditions_have_the_settings_of_the_base(condition, base, other, told) -> None:
    results = {(): result(8, **base), condition: result(2, **other)}
    if not told:
        assert Outcomes.of(results).conditions == ((), condition)
        return
    with pytest.raises(ResultsError, match=told):
        Outcomes.of(results)


def test_only_the_conditions_that_are_asked_for_are_read(tmp_path) -> None:
    def write(name: str, perturb: str, wins: int, horizon: int = 5) -> None:
        (tmp_path / "conditions" / name).mkdir(parents=True)
        protocol = {"world": {"perturb": perturb}, "episode": {"horizon": horizon}}
        replace(result(wins), protocol=protocol).write(tmp_path / "conditions" / name / "eval.json")

    write("none", "", 10)
    with pytest.raises(ConfigError, match="holds no finished conditions"):
        read_study(tmp_path)
    write("gain=0.4", "gain=0.4", 6)
    write("latency=0.4", "latency=0.4", 3, horizon=6)
    with pytest.raises(ResultsError, match=r"latency=0.4 .*horizon: 6 instead of 5"):
        read_study(tmp_path)
    write("gain=0.4@3", "gain=0.4@3", 2)
    with pytest.raises(ConfigError, match=r"holds gain=0.4 twice, gain=0.4 and gain=0.4@3"):
        read_study(tmp_path)
    for one, rate in (("gain=0.4", 0.6), ("gain=0.4@3", 0.2)):
        found = read_study(tmp_path, conditions=["", one])
        assert found.outcomes.rates.tolist() == [1, rate] and len(found.outcomes.axes) == 1


def test_policies_beside_each_other_tell_what_differs_besides(tmp_path) -> None:
    found = outcomes({(): 10, A: 6})
    base = {"protocol.episode.horizon": 5, "tasks.libero_goal/0.digest": "a"}
    first = Robustness("a", found, settings=base)
    assert differences([first, Robustness("b", found, settings=base)]) == []
    further = Robustness("b", outcomes({(): 10, A: 6, B: 3}), settings=base)
    assert differences([first, further]) == ["severities of camera: 0, 0.5 in a, 0, 0.5, 1 in b"]
    tasks, other = ("libero_goal/0", "libero_goal/7"), {**base, "tasks.libero_goal/7.digest": "b"}
    second = Robustness("b", replace(found, tasks=tasks), settings={**other, "protocol.episode.horizon": 6})
    third = Robustness("c", replace(found, starts=tuple(range(1, 11))), settings=base)
    assert differences([first, second, third]) == [
        "protocol.episode.horizon: 5 in a, 6 in b",
        "tasks: libero_goal/0, libero_goal/1 in a, libero_goal/0, libero_goal/7 in b",
        "starts: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9 in a, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10 in c",
    ]
    assert "horizon: 5 in a, 6 in b" in write_robustness([first, second], tmp_path).read_text()


def test_control_steps_by_suite_are_those_of_the_suites_that_were_run(tmp_path) -> None:
    steps, found = {"libero_goal": 300, "libero_10": 520}, outcomes({(): 10, A: 6})
    page = write_robustness([Robustness("a", found, horizon=steps)], tmp_path).read_text()
    assert "<dd>300</dd>" in page
    both = replace(found, tasks=("libero_goal/0", "libero_10/0"))
    page = write_robustness([Robustness("a", both, horizon=steps)], tmp_path).read_text()
    assert "<dd>300 libero_goal / 520 libero_10</dd>" in page


def test_a_start_from_which_a_simulation_error_ended_an_episode_is_left_out_of_all_conditions_and_told(
    tmp_path,
) -> None:
    whole, half = result(8), result(2)
    first, second = half.tasks
    rows = {name: getattr(first, name)[:9] for name in ("init_states", "successes", "lengths")}
    broken = replace(first, **rows, simulation_errors=((9, "it has diverged"),))
    found = Outcomes.of({(): whole, B: replace(half, tasks=(broken, second))})
    assert found.starts == tuple(range(9)) and found.lost == 1 and found.successes.shape == (2, 2, 9)
    assert found.rates.tolist() == [8 / 9, 2 / 9]
    policy, told = Robustness("er", found, (), {}), "9 a task, 1 left out, where a simulation error"
    assert told in write_robustness([policy], tmp_path).read_text() and "starts: 9, 1 left out" in render(
        policy
    )


def test_the_page_and_the_text_say_the_same_numbers(tmp_path, tab) -> None:
    found, given_up = outcomes({(): 10, A: 3, B: 0, C: 9, BOTH: 0}), {name_of(B): 2, name_of(C): 0}
    policy = Robustness("sequential", found, ("eval/a",), given_up, horizon=130)
    expert = Robustness("expert", outcomes({(): 10, A: 10, B: 10, C: 10}), horizon=600)
    page = write_robustness([policy, expert], tmp_path)
    assert tab.faults_on_a_phone(page) == []
    text = page.read_text()
    assert "Robustness of sequential" in text and text.count("<svg") == 1
    assert "camera=1" in text and ">2</td>" in text, "draws that were given up are told"
    assert "camera=1,light=1" in text, "so are interactions"
    assert "130 (sequential), 600 (expert)" in text, "the expert had more time"
    assert verdict(policy) in text.replace("&#39;", "'") and "camera" in verdict(policy)
    lines = {line.split()[0]: line.split() for line in render(policy).splitlines() if line}
    assert lines["camera"][1:4] == ["100", "30", "0"]
    record = json.loads((tmp_path / "robustness.json").read_text())
    camera = next(a for a in record["policies"][0]["axes"] if a["kind"] == "camera")
    assert camera["area"]["value"] == pytest.approx(0.4) and camera["half"]["value"] is not None
    assert np.array(record["policies"][0]["outcomes"]["camera=1"]).sum() == 0


def test_the_legend_names_a_policy_that_was_not_measured_along_the_first_kind() -> None:
    both = outcomes({(): 10, A: 3, B: 0, C: 9})
    policies = {"a": both.axes, "b": outcomes({(): 10, C: 9}).axes}
    assert policies["a"][0].kind == "camera"
    legend = curves_figure(policies, {}).legends[0]
    assert [text.get_text() for text in legend.get_texts()] == ["a", "b"]


def test_a_policy_that_never_succeeds_has_nothing_to_lose(tmp_path) -> None:
    policy = Robustness("none", outcomes({(): 0, A: 0, B: 0}))
    assert "nothing to lose" in verdict(policy)
    assert write_robustness([policy], tmp_path).exists() and "none" in render(policy)
    better = Robustness(
        "none", outcomes({(): 0, B: 5, C: 5, BOTH: 5})
    )  # what is left of nothing is not known
    assert ["camera=1,light=1", "50", "–", "–"] in [line.split() for line in render(better).splitlines()]
    assert write_robustness([better], tmp_path) and "nan" not in (tmp_path / "robustness.html").read_text()
