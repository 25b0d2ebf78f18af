"""Published success of checkpoints: the file's values, and what contradicts them."""

import itertools
import json

import pytest
import scipy.stats

from libero_cli.main import main
from libero_env.errors import UnknownNameError
from libero_env.tasks import get_suite
from libero_eval.evaluation_file import Stopped
from libero_eval.judging.published import PLANNED, agreement, protocol_file, published
from libero_eval.protocols.files import load_protocol
from libero_eval.stats.episodes import agreeing_successes, fisher_exact
from lifelong.errors import ComparisonError
from tests.harness.results import result_of, task_result

# as printed where `sources` says: spatial, object, goal, 10
PRINTED = {
    "pi05": (98.8, 98.2, 98.0, 92.4),
    "pi0": (96.8, 98.8, 95.8, 85.2),
    "pi0-fast": (96.4, 96.8, 88.6, 60.2),
    "openvla-oft": (97.7, 98.0, 96.1, 95.3),
    "x-vla": (98.2, 98.6, 97.8, 97.6),
    "groot-n1.6": (97.5, 98.5, 97.5, 94.5),
    "smolvla": (90, 96, 92, 71),
    "pi05-lerobot": (97.0, 99.0, 98.0, 96.0),
    "molmoact2": (98.4, 100.0, 98.0, 96.6),
    "starvla-oft": (97.8, 98.6, 96.2, 93.8),
}
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")


def won(suite: str, count: int, trials: int = 50, tasks: int = 10):
    """A result with so many successes in a suite."""
    outcomes = [k < count for k in range(tasks * trials)]
    protocol = load_protocol("openpi").resolved()
    rows = [task_result(f"{suite}/{k}", outcomes[k * trials : (k + 1) * trials]) for k in range(tasks)]
    return result_of(*rows, protocol=protocol, versions={"mujoco": "3.2.3"})


def test_counts_are_those_of_the_printed_percentages():
    assert {
        name: tuple(round(100 * one.successes[suite] / one.episodes, 1) for suite in SUITES)
        for name, one in published().items()
    } == PRINTED


@pytest.mark.parametrize("name", PRINTED)
def test_each_row_has_its_sources_and_a_protocol_that_can_be_run(name, tmp_path):
    one = published()[name]
    assert any(what.startswith("successes") for what in one.sources)
    assert any("episodes" in what for what in one.sources) or name == "x-vla"
    load_protocol(one.conditions)
    (tmp_path / f"{name}.yaml").write_text(protocol_file(one) or "extends: " + one.protocol["extends"])
    load_protocol(tmp_path / f"{name}.yaml")
    assert all(len(get_suite(suite).tasks) * 50 == PLANNED for suite in one.successes)


@pytest.mark.parametrize(("won", "of", "others"), [(7, 10, 20), (20, 20, 12), (0, 9, 30), (15, 40, 40)])
def test_what_agrees_is_what_the_exact_test_does_not_reject(won, of, others):
    low, high = agreeing_successes(won, of, others)
    kept = [s for s in range(others + 1) if fisher_exact(won, of, s, others) > 0.05]
    assert kept == list(range(low, high + 1))
    assert low <= others * won / of <= high


def test_a_true_reproduction_is_rarely_contradicted():
    """With equal chances of success the test rejects at most in 5 %: summed over all outcomes, not simulated."""
    for chance in (0.6, 0.9, 0.98):
        rejected = sum(
            scipy.stats.binom.pmf(a, 40, chance) * scipy.stats.binom.pmf(b, 60, chance)
            for a, b in itertools.product(range(41), range(61))
            if fisher_exact(a, 40, b, 60) <= 0.05
        )
        assert rejected <= 0.05


def test_the_command_says_whether_a_result_contradicts(tmp_path, capsys):
    low, high = published()["pi05"].agreeing("libero_goal")
    for count, status in ((low - 1, 1), (low, 0), (high, 0), (high + 1, 1)):
        file = won("libero_goal", count).write(tmp_path / f"{count}.json")
        assert main(["compare", str(file), "--published", "pi05"]) == status
        said = capsys.readouterr().out
        assert ("contradicts what is published in libero_goal" in said) == bool(status)
        assert f"{100 * count / 500:.1f}" in said and "98.0" in said
        assert "in brackets there" not in said, "the conditions are openpi's"
    assert main(["compare", str(file), "--published", "pi05", "--json"]) == 1
    (row,) = json.loads(capsys.readouterr().out)["suites"]
    assert row["episodes"] == 500 and row["found"] == (high + 1) / 500 and row["p_value"] < 0.05


def test_conditions_that_differ_are_named():
    result = won("libero_10", 461)
    world = {**result.protocol["world"], "models": "builtin"}
    changed = result_of(*result.tasks, protocol={**result.protocol, "world": world})
    assert agreement(changed, "pi05")[1] == ["world.models builtin (original)", "MuJoCo 4.0.0 (3.2.3)"]
    _, notes = agreement(result, "pi05-lerobot")
    assert "episode.errors failure (stop)" in notes and "MuJoCo 3.2.3 (not stated)" in notes


def test_what_nothing_is_published_of_is_refused(capsys, tmp_path):
    with pytest.raises(UnknownNameError, match="pi05"):
        agreement(won("libero_goal", 9), "pi5")
    with pytest.raises(ComparisonError, match="libero_90: 10 tasks"):
        agreement(won("libero_90", 9), "pi05")
    with pytest.raises(ComparisonError, match="3 tasks"):
        agreement(won("libero_goal", 9, tasks=3), "pi05")
    stopped = Stopped("width=0.1", "known", 999)
    with pytest.raises(ComparisonError, match="fixed before"):
        agreement(result_of(*won("libero_goal", 9).tasks, stopped=stopped), "pi05")
    file = str(won("libero_goal", 490).write(tmp_path / "eval.json"))
    for words in ([file, file], [], [file, "--gate", "0.1"], [file, "--tasks"], [file, "--allow", "tasks"]):
        assert main(["compare", *words, "--published", "pi05"]) == 2
        assert "--published is of one result" in capsys.readouterr().err
