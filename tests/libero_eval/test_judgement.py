"""Comparison of evaluated policies: what may be compared, what is counted, texts, pages, exports and commands."""

import errno
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from libero_cli.main import main
from libero_env.errors import UnknownNameError
from libero_eval.evaluation_file import Stopped
from libero_eval.judging.comparability import Group, check_comparable, match
from libero_eval.judging.comparison import Comparison, compare_groups, gate, write_comparison
from libero_eval.judging.group_scores import group_scores
from libero_eval.judging.page import forest_figure, gate_text, render
from libero_eval.stats.power import Question, paired_power, shown_difference
from libero_integrations.exports.results import export_eval_results, export_lerobot, export_vla_eval
from lifelong.errors import ComparisonError, ConfigError, ResultsError
from tests.harness.evaluations import evaluate
from tests.harness.results import ENVIRONMENT, PROTOCOL, drawn_result, result_of, task_result


def side(label: str, *results) -> Group:
    return Group(label, results, tuple(f"{label}{i}" for i in range(len(results))))


@pytest.fixture(scope="module")
def found() -> Comparison:
    """Two policies on two suites, and the first again with another seed."""
    suites = ("libero_goal", "libero_object")
    return compare_groups(
        [
            side("good", drawn_result(0.9, 1, suites=suites)),
            side("bad", drawn_result(0.75, 2, suites=suites, policy="other:make")),
            side("good again", drawn_result(0.9, 3, suites=suites, seed=1)),
        ]
    )


def test_differences_are_those_of_the_same_starts(found):
    first = found.comparisons[0]
    total = first.total.difference
    assert (first.first, first.second, total.pairs) == ("good", "bad", 1000)
    assert total.value == pytest.approx(total.first - total.second)
    assert total.value == pytest.approx((total.counts.only_first - total.counts.only_second) / 1000)
    assert total.score.low < total.value < total.score.high and first.total.adjusted < 0.001
    assert [p.name for p in first.suites] == ["libero_goal", "libero_object"] and len(first.tasks) == 20
    assert np.mean([p.difference.value for p in first.tasks]) == pytest.approx(total.value)
    assert sum(p.difference.counts.discordant for p in first.tasks) == total.counts.discordant


@pytest.mark.parametrize("wins", [(6, 1), (3, 0), (10, 10)])
@pytest.mark.parametrize("turned", [False, True])
def test_policies_that_never_win_the_same_start_are_compared(wins, turned):
    """And those that never lose the same one: as many starts differ as the rates allow."""
    a, b = wins[0] * [True] + (20 - wins[0]) * [False], (20 - wins[1]) * [False] + wins[1] * [True]
    rows = [np.array(a) ^ turned, np.array(b) ^ turned]
    sides = [
        side(name, result_of(task_result("libero_goal/0", row), policy=f"{name}:make"))
        for name, row in zip("ab", rows, strict=True)
    ]
    total = compare_groups(sides).comparisons[0].total.difference
    assert total.value == pytest.approx(rows[0].mean() - rows[1].mean())


def test_what_would_have_been_shown_is_of_the_discordance_that_was_seen(tmp_path, capsys):
    rows = [[1] * 40 + [1] * 12 + [0] * 8, [1] * 40 + [0] * 12 + [1] * 8]
    results = [result_of(task_result("libero_goal/0", row), policy=f"p{n}") for n, row in enumerate(rows)]
    shown = compare_groups([side(f"p{n}", one) for n, one in enumerate(results)]).comparisons[0].shown
    base = 52 / 60
    assert shown == shown_difference(Question(base, -0.1), 60, discordance=20 / 60)
    assert paired_power(Question(base, -shown, 20 / 60), 60) >= 0.8
    files = [str(one.write(tmp_path / f"{n}.json")) for n, one in enumerate(results)]
    assert main(["power", *files, "--episodes", "60"]) == 0
    assert f"worse by {100 * shown:.1f} points" in capsys.readouterr().out


def test_one_policy_twice_is_the_control_arm(found):
    assert [(c.first, c.second) for c in found.controls] == [("good", "good again")]
    assert [(c.first, c.second) for c in found.comparisons] == [("good", "bad"), ("bad", "good again")]
    control = found.controls[0].total
    assert control.adjusted is None and control.difference.by_chance > 0
    assert not any("no control arm" in note for note in found.notes)


def test_holm_is_over_comparisons_suites_and_tasks(found):
    totals = [c.total for c in found.comparisons]
    assert all(t.adjusted >= t.difference.p_value for t in totals)
    suites = [p for c in found.comparisons for p in c.suites]
    smallest = min(suites, key=lambda p: p.difference.p_value)
    assert smallest.adjusted == pytest.approx(min(1, 4 * smallest.difference.p_value))
    tasks = found.comparisons[0].tasks
    smallest = min(tasks, key=lambda p: p.difference.p_value)
    assert smallest.adjusted == pytest.approx(min(1, 20 * smallest.difference.p_value))


def test_differences_that_are_significant_at_the_level_that_was_asked_for_are_filled(found):
    for alpha in (0.05, 1e-9):
        (axes,) = forest_figure(found.comparisons[0], alpha).axes
        rows = (found.comparisons[0].total, *found.comparisons[0].suites, *found.comparisons[0].tasks)
        filled = [line for line in axes.lines if line.get_marker() in "so" and line.get_mfc() != "white"]
        assert len(filled) == sum(row.adjusted <= alpha for row in rows) and (alpha < 0.05 or filled)


def test_the_order_of_the_policies_turns_the_sign_only():
    sides = [side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.8, 2, policy="b:b"))]
    one, other = (compare_groups(order).comparisons[0].total.difference for order in (sides, sides[::-1]))
    assert (one.value, one.score.low) == pytest.approx((-other.value, -other.score.high))
    assert one.p_value == other.p_value


def test_texts_name_what_is_shown_and_what_is_not(found):
    text = render(found)
    assert "good is better than bad in these starts: +" in text
    assert "Stopped at any time: decided for good" in text
    assert "control arm: good − good again, one policy twice" in text
    assert "tasks that differ most (of 20)" in text and len(render(found, tasks=True)) > len(text)
    equal = compare_groups([side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.9, 2, policy="b:b"))])
    text = render(equal)
    assert "No difference is shown: a − b" in text and "in four of five cases" in text
    assert "not decided after 500 pairs" in text and "note: no control arm" in text
    three = [
        side(name, drawn_result(rate, 1, policy=name)) for name, rate in (("a", 0.9), ("b", 0.8), ("c", 0.7))
    ]
    pair, *_ = compare_groups(three).comparisons
    assert pair.shown > compare_groups(three[:2]).comparisons[0].shown, "of three tests"
    assert "after Holm" not in text and "after Holm, McNemar, exact)" in render(compare_groups(three))


@pytest.mark.parametrize(("changes", "field", "values"), [
    ({"protocol": PROTOCOL | {"settle_steps": 5}}, "protocol.settle_steps", "10 in a, 5 in b"),
    ({"environment": ENVIRONMENT | {"robot": "robosuite-1.4.1"}}, "environment.robot", "libero in a, robosuite"),
    ({"protocol": {**PROTOCOL, "horizon": {"libero_goal": 600}}}, "protocol.horizon.libero_goal", "300 in a, 600"),
])  # fmt: skip
def test_results_made_differently_are_refused(changes, field, values):
    sides = [side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.9, 2, policy="b:b", **changes))]
    with pytest.raises(ComparisonError, match="cannot be compared") as error:
        compare_groups(sides)
    assert f"{field}: {values}" in str(error.value) and f"--allow {field}" in str(error.value)
    allowed = [field, *([] if "horizon" not in field else ["protocol.horizon"])]
    notes = compare_groups(sides, allow=allowed).notes
    assert any(note.startswith(f"{field}: {values}") and note.endswith("; allowed") for note in notes)
    assert check_comparable(sides, allow=[field.partition(".")[0]])
    with pytest.raises(UnknownNameError, match="setting to allow"):
        compare_groups(sides, allow=[*allowed, field[:-1]])


def test_versions_and_renderers_are_told_but_not_refused():
    other = {"versions": {"mujoco": "3.3.2"}, "environment": ENVIRONMENT | {"renderer": "osmesa"}}
    notes = compare_groups(
        [side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.9, 2, policy="b:b", **other))]
    ).notes
    assert "versions.mujoco: 4.0.0 in a, 3.3.2 in b" in notes
    assert "environment.renderer: egl in a, osmesa in b" in notes


def test_what_older_files_do_not_record_is_told():
    notes = check_comparable(
        [side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.9, 2, environment={}))]
    )
    assert "environment.robot: libero in a, not recorded in b; taken to be the same" in notes


def test_episodes_without_a_partner_are_dropped_and_counted():
    sides = [
        side("a", result_of(task_result("s/0", [1, 1, 0, 0]), task_result("s/1", [1, 1]))),
        side("b", result_of(task_result("s/0", [1, 0, 0], starts=(2, 3, 9)), policy="b:b")),
    ]
    matched = match(*sides)
    assert matched.dropped == (4, 1) and matched.tasks == ("s/0",)
    assert matched.pairs.starts.tolist() == [2, 3] and matched.pairs.second[:, 0].tolist() == [True, False]
    notes = "\n".join(compare_groups(sides).notes)
    assert "2 pairs; without a partner and not counted: 4 episodes of a, 1 of b" in notes


def test_no_common_start_is_refused():
    sides = [
        side("a", result_of(task_result("s/0", [1, 1]))),
        side("b", result_of(task_result("s/0", [1, 0, 0], starts=(7, 8, 40)), policy="b:b")),
    ]
    with pytest.raises(ComparisonError, match="s/0, starts 0–1 against 1 tasks from s/0, starts 7–8, 40"):
        compare_groups(sides)


def test_a_single_task_with_one_start_is_judged():
    sides = [
        side("a", result_of(task_result("s/0", [1]))),
        side("b", result_of(task_result("s/0", [0]), policy="b:b")),
    ]
    only = compare_groups(sides).comparisons[0]
    assert only.total.adjusted == 1.0 and only.suites == () and only.total.difference.over_tasks is None
    interval = only.total.difference.interval
    assert interval.value == 1 and np.isnan([interval.low, interval.high]).all(), "one start has no interval"
    with pytest.raises(ConfigError, match="--gate needs 5 starts that both have, and there are 1"):
        gate(compare_groups(sides), 0.1)


def test_equal_outcomes_of_a_control_arm_are_told():
    twins = [side("a", drawn_result(0.9, 1)), side("a2", drawn_result(0.9, 1, seed=1))]
    judged = compare_groups([], control=(twins[0], twins[1]))
    assert judged.comparisons == () and any("equal to the bit" in note for note in judged.notes)
    wrong = compare_groups([], control=(twins[0], side("b", drawn_result(0.9, 1, policy="b:b"))))
    assert any("not results of one policy" in note for note in wrong.notes)


def test_one_policy_under_two_protocols_is_no_control_arm():
    sides = [side("a", drawn_result(0.9, 1)), side("b", drawn_result(0.9, 2, protocol={"name": "libero"}))]
    judged = compare_groups(sides, allow=["protocol"])
    assert len(judged.comparisons) == 1 and not judged.controls


def test_weights_identify_a_policy():
    of_one = [{"run": path, "weights": "abc", "seed": s} for s, path in enumerate(("runs/a", "/x/runs/a"))]
    sides = [side(f"{k}", drawn_result(0.9, k, evaluated=one)) for k, one in enumerate(of_one)]
    assert len(compare_groups(sides).controls) == 1


def test_equal_names_are_refused():
    with pytest.raises(ConfigError, match="two policies are called a"):
        compare_groups([side("a", drawn_result(0.9, 1)), side("a", drawn_result(0.8, 2, policy="b:b"))])


def test_a_run_counts_once_in_its_group():
    """A copy of a result, as of a copied run, would make the intervals over runs narrower."""
    one, other = (drawn_result(0.9, d, evaluated={"run": f"er{d}", "weights": f"{d}"}) for d in (1, 2))
    copied = replace(one, evaluated={"run": "copy", "weights": "1"})
    assert compare_groups([side("er", one, other), side("ewc", drawn_result(0.7, 3))])
    with pytest.raises(ConfigError, match="results 1 and 3 of er are one run"):
        compare_groups([side("er", one, other, copied), side("ewc", drawn_result(0.7, 3))])


def test_runs_of_methods_are_aggregated_by_rliable():
    metrics = pytest.importorskip("rliable.metrics")
    groups = [
        [drawn_result(rate, d, evaluated={"weights": f"{rate}{d}"}) for d in range(3)] for rate in (0.9, 0.7)
    ]
    state = np.random.get_state()[1].copy()  # noqa: NPY002
    judged = compare_groups([side("good", *groups[0]), side("bad", *groups[1])])
    assert (np.random.get_state()[1] == state).all()  # noqa: NPY002
    found = judged.groups
    scores = np.array([[np.mean(t.successes) for t in r.tasks] for r in groups[0]])
    assert found.iqm["good"].value == pytest.approx(metrics.aggregate_iqm(scores))
    assert found.iqm["good"].low <= found.iqm["good"].value <= found.iqm["good"].high
    assert found.improvement["good", "bad"].value > 0.8 and found.runs == {"good": 3, "bad": 3}
    only = judged.comparisons[0]
    assert only.sequential is None and only.total.difference.counts is None and only.total.adjusted < 0.01
    assert "a run of good beats one of bad" in render(judged)
    other = np.array([[np.mean(t.successes) for t in r.tasks] for r in groups[1]])
    expected = metrics.probability_of_improvement(scores, other)
    assert found.improvement["good", "bad"].value == pytest.approx(expected)
    assert group_scores({"good": scores, "bad": other}).iqm["good"] == found.iqm["good"], "drawn again"


def test_aggregates_over_runs_are_of_the_starts_that_all_have():
    pytest.importorskip("rliable")

    def runs(name, numbers, counts):
        rows = [
            [task_result(f"libero_goal/{n}", [1] * 10 + [0] * (count - 10)) for n in numbers]
            for count in counts
        ]
        return side(name, *(result_of(*tasks, policy=f"{name}{i}:m") for i, tasks in enumerate(rows)))

    groups = [runs("a", (0, 1), (10, 10)), runs("b", (1, 2), (10, 40)), runs("c", (0, 2), (10, 10))]
    assert compare_groups(groups[:2]).groups.mean["b"].value == 1.0, "the thirty failures have no partner"
    judged = compare_groups(groups)
    assert judged.groups is None and "there are no aggregates over runs" in judged.notes[-1]
    assert "nan" not in render(judged)


def test_the_file_holds_everything(found, tmp_path):
    values = json.loads(write_comparison(found, tmp_path / "c.json").read_text())
    assert values["format"] == "libero-comparison/1" and len(values["comparisons"][0]["tasks"]) == 20
    assert len(values["comparisons"][0]["sequential"]["log_e"]) == 1000
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        write_comparison(found, tmp_path / "file" / "c.json")


def test_the_page_needs_no_other_file_and_reads_on_a_phone(found, tmp_path, tab):
    pytest.importorskip("matplotlib")
    from libero_eval.judging.page import write_page

    page = write_page(found, tmp_path / "new" / "compare.html")
    assert tab.faults_on_a_phone(page) == []
    text = page.read_text()
    assert text.count("<svg") == 3 and "http" not in text.replace("http://www.w3.org", "")
    assert "<h2>good − bad</h2>" in text and "Control arm" in text and "libero_object/9" in text


def test_exports_to_vla_eval(tmp_path):
    errors = (None, "ServerError: closed", None)
    result = result_of(
        task_result("libero_goal/3", [1, 0, 1], errors=errors), task_result("libero_object/0", [0, 0, 0])
    )
    paths = export_vla_eval(result, tmp_path)
    assert [p.name for p in paths] == ["libero_goal_aggregate.json", "libero_object_aggregate.json"]
    values = json.loads(paths[0].read_text())
    assert (values["mean_success"], values["num_errors"]) == (0.6667, 1)
    assert values["metric_keys"] == {"success": "mean"}
    collector = pytest.importorskip("vla_eval.results.collector", reason="vla-eval is not installed here")
    expected = collector.ResultCollector("libero_goal", metric_keys={"success": "mean"})
    for episode in values["tasks"][0]["episodes"]:
        expected.record(values["tasks"][0]["task"], dict(episode))
    theirs = expected.get_benchmark_result(values["config"])
    assert values["tasks"] == theirs["tasks"] and theirs.keys() - {"created_at"} <= values.keys()


def test_tasks_of_one_instruction_keep_rows_of_their_own_in_vla_eval(tmp_path):
    tasks = [task_result(f"libero_90/{n}", [1], instruction="turn on the stove") for n in (0, 7)]
    (path,) = export_vla_eval(result_of(*tasks), tmp_path)
    names = [row["task"] for row in json.loads(path.read_text())["tasks"]]
    assert names == ["turn on the stove (libero_90/0)", "turn on the stove (libero_90/7)"]


def test_exports_to_lerobot(tmp_path):
    result = result_of(task_result("libero_goal/3", [1, 0, 1]), task_result("libero_object/0", [0, 0, 0]))
    values = json.loads(export_lerobot(result, tmp_path)[0].read_text())
    assert (tmp_path / "eval_info.json").is_file()
    tasks = [(t["task_group"], t["task_id"]) for t in values["per_task"]]
    assert tasks == [("libero_goal", 3), ("libero_object", 0)]
    assert values["per_task"][0]["metrics"]["successes"] == [True, False, True]
    assert values["per_group"]["libero_goal"]["pc_success"] == pytest.approx(200 / 3)
    assert values["overall"]["pc_success"] == pytest.approx(100 / 3) and values["overall"]["eval_ep_s"] == 10
    of_an_evaluation = json.loads(export_lerobot(evaluate(tmp_path), tmp_path)[0].read_text())
    assert of_an_evaluation["overall"]["eval_s"] >= 0


def test_exports_to_model_cards_are_entries_as_the_hub_documents_them(tmp_path):
    result = result_of(
        task_result("libero_goal/3", [1, 0, 1, 0, 1, 1]),
        task_result("libero_object/0", [1, 1, 1, 1]),
        environment=ENVIRONMENT | {"models_digest": "fa0e"},
    )
    with pytest.raises(ConfigError, match=r"the suite: libero_goal \(1 of 10 tasks\); with --partial"):
        export_eval_results(result, tmp_path, "org/libero")
    paths = export_eval_results(result, tmp_path, "org/libero", "https://example.org/eval.json", partial=True)
    assert [str(p.relative_to(tmp_path)) for p in paths] == [
        ".eval_results/libero_goal.yaml", ".eval_results/libero_object.yaml"
    ]  # fmt: skip
    (entry,) = yaml.safe_load(paths[0].read_text())
    notes = entry.pop("notes")
    assert entry == {
        "dataset": {"id": "org/libero", "task_id": "libero_goal"},
        "value": 66.67,
        "date": "2026-01-01T00:00:00+00:00",
        "source": {"url": "https://example.org/eval.json", "name": "libero-lifelong"},
        "evaluation_framework": "libero-lifelong",
    }
    assert notes.startswith(
        "PARTIAL: libero_goal (1 of 10 tasks), success in percent over 6 episodes of 1 task, 95 % "
    )
    assert "protocol openpi, models builtin fa0e" in notes
    assert "95 %" not in yaml.safe_load(paths[1].read_text())[0]["notes"].replace("in percent", ""), (
        "4 episodes"
    )
    changed = replace(
        result,
        protocol={"name": "libero", "world": {"perturb": "gain=0.5"}, "action": {"clock": "latency=100ms"}},
        stopped=Stopped("width=0.9", "known", 20),
    )
    path, _ = export_eval_results(changed, tmp_path, "org/libero", partial=True)
    (entry, *_) = yaml.safe_load(path.read_text())
    notes = entry["notes"]
    assert "perturbed by gain=0.5, clock latency=100ms, stopped after 10 of 20; width=0.9: known" in notes
    end = replace(changed, tasks=changed.tasks[:1]).success  # wider, as that of a stopped evaluation is
    assert f"95 % interval {100 * end.low:.1f} to {100 * end.high:.1f}" in notes and end.low < 0.2
    bare = export_eval_results(replace(result, times={}), tmp_path, "org/libero", partial=True)
    assert not {"date", "source"} & yaml.safe_load(bare[1].read_text())[0].keys()


def written(folder: Path, **results) -> None:
    for name, result in results.items():
        result.write(folder / name / "eval.json")


def test_commands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(
        tmp_path, a=drawn_result(0.9, 1), b=drawn_result(0.8, 2, policy="b:b"), c=drawn_result(0.9, 3, seed=1)
    )
    assert main(["compare", "pi0=a", "b/eval.json", "--control", "a", "c", "--out", "report"]) == 0
    out = capsys.readouterr().out
    assert "pi0 is better than b" in out and "control arm: a − c" in out
    assert sorted(p.name for p in Path("report").iterdir()) == ["compare.html", "compare.json"]
    assert main(["power", "a", "b"]) == 0 and "observed in 500 pairs" in capsys.readouterr().out
    written(tmp_path, short=drawn_result(0.8, 2, policy="b:b", protocol=PROTOCOL | {"settle_steps": 5}))
    assert main(["power", "a", "short"]) == 0
    assert "note: protocol.settle_steps: 10 in a, 5 in short; allowed" in capsys.readouterr().out
    assert main(["power", "--difference", "0.03", "--correlation", "0.3", "--tests", "4"]) == 0
    assert "over 4 comparisons" in capsys.readouterr().out
    assert main(["power", "--base", "0.9", "--episodes", "114", "--correlation", "0.5"]) == 0
    said = capsys.readouterr().out
    assert "worse by 10.0 points" in said, "of which --difference=-0.1 --correlation 0.5 asks for 114"
    assert main(["power", "--base", "0.99"]) == main(["power", "--base", "0.99", "--episodes", "100"]) == 0
    assert "--difference 0.03" not in capsys.readouterr().err
    assert main(["results", "export", "a", "--as", "lerobot", "--out", "x"]) == 0
    assert capsys.readouterr().out.strip() == "x/eval_info.json"
    assert main(["results", "export", "a", "--as", "eval-results", "--dataset", "org/libero"]) == 0
    assert capsys.readouterr().out.strip() == "a/.eval_results/libero_goal.yaml"


def lost(count: int, episodes: int = 100):
    """A result with so many failures, and one that never fails in the same starts."""
    wins = np.arange(episodes) >= count
    return result_of(task_result("libero_goal/0", wins), policy="other:make"), result_of(
        task_result("libero_goal/0", np.ones(episodes, bool))
    )


@pytest.mark.parametrize(("failures", "margin", "verdict", "status"), [
    (20, 0.05, "regression", 1),
    (0, 0.05, "no regression", 0),
    (5, 0.05, "undecided", 3),  # more episodes do not help
    (8, 0.05, "undecided", 3),
])  # fmt: skip
def test_a_gate_says_what_it_decided_and_why(
    failures, margin, verdict, status, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    new, old = lost(failures)
    written(tmp_path, old=old, new=new)
    assert main(["compare", "old", "new", "--gate", str(margin)]) == status
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith(f"{verdict}: new loses +{failures}.0 [") and "in 100 starts" in line
    assert main(["compare", "old", "new", "--gate", str(margin), "--json", "--out", "page"]) == status
    said = json.loads(capsys.readouterr().out)["gate"]
    assert json.loads(Path("page/compare.json").read_text())["gate"] == said
    assert said["verdict"] == verdict and said["loss"]["value"] == pytest.approx(failures / 100)
    assert ("would decide" in line) == (failures == 8)
    assert main(["compare", "new", "old", "--gate", str(margin), "--quiet"]) == 0


def test_a_gate_decides_with_as_many_pairs_as_it_asks_for():
    def judged(count: int, episodes: int):
        new, old = lost(count, episodes)
        return gate(compare_groups([side("old", old), side("new", new)]), 0.05)

    asked = judged(8, 100).enough
    assert judged(round(0.08 * asked * 1.1), round(asked * 1.1)).verdict == "regression"
    assert judged(round(0.08 * asked / 2), asked // 2).verdict == "undecided"


def test_a_gate_judges_a_policy_against_its_own_earlier_result():
    """As after a change of the code: one policy twice is otherwise a control arm."""
    twins = [side("then", drawn_result(0.9, 1)), side("now", drawn_result(0.9, 1))]
    comparison = compare_groups(twins)
    assert not comparison.comparisons and gate(comparison, 0.01).verdict == "no regression"
    assert "+0.0 [−0.8, 0.8] points" in gate_text(gate(comparison, 0.01), comparison)
    three = compare_groups([*twins, side("b", drawn_result(0.9, 2, policy="b:b"))])
    with pytest.raises(ConfigError, match="--gate judges two results"):
        gate(three, 0.01)


@pytest.mark.parametrize(("words", "message"), [
    (["compare", "a"], "needs two results"),
    (["compare", "a", "b", "--open"], "--open shows a page, and none was written"),
    (["compare", "--group", "a"], "--group NAME RESULT"),
    (["power", "--base", "0.9", "--difference", "0.2"], "above 1"),
    (["power", "a"], "takes two results, not 1"),
    (["compare", "a", "folder"], "folder/eval.json: it is a folder, a pipe or a device"),
    (["results", "export", "a", "--as", "eval-results"], "data set of the benchmark is ''; expected ORG/NAME"),
    (["results", "export", "a", "--as", "lerobot", "--dataset", "a/b"], "are of --as eval-results, not of --as ler"),
    (["results", "export", "a", "--as", "eval-results", "--dataset", "a/b", "--source", "x"], "the source is 'x'"),
    (["results", "export", "a", "--as", "vla-eval", "--out", "/dev/full"], "_aggregate.json: the result"),
    (["power", "--difference", "0.05", "--discordance", "0.01"], "is impossible"),
    (["power", "--difference", "0.05", "--episodes", "100"], "leave --difference out"),
    (["power", "--discordance", "0.1"], "of one case; name it"),
])  # fmt: skip
def test_bad_input_is_one_line(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, a=drawn_result(0.9, 1), b=drawn_result(0.8, 2, policy="b:b"))
    Path("folder/eval.json").mkdir(parents=True)
    assert main(words) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1


@pytest.mark.parametrize("words", [
    "results export a --as vla-eval",
    "results export a --as lerobot",
    "results export a --as eval-results --dataset org/libero",
    "compare a b --out a",
    "board a b --out a",
])  # fmt: skip
def test_on_a_full_disk_nothing_is_lost(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, a=drawn_result(0.9, 1), b=drawn_result(0.8, 2, policy="b:b"))
    assert main(words.split()) == 0
    capsys.readouterr()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert len(before) > 2

    def full(path: Path, *rest, **options):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(Path, "write_text", full)
    assert main(words.split()) == 2
    said = capsys.readouterr()
    assert "No space left on device" in said.err and said.err.count("\n") == 1 and not said.out
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
