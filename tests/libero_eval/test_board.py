"""A leaderboard of evaluations, and the page of one."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from libero_cli.main import main
from libero_eval.evaluation_file import Stopped
from libero_eval.judging.board import make_board, render_board, write_board
from libero_eval.judging.comparability import Group, check_comparable
from libero_eval.judging.evaluation_page import write_evaluation_page
from lifelong.errors import ComparisonError
from lifelong.stats.intervals import wilson_interval
from tests.harness.results import PROTOCOL, drawn_result, result_of, task_result


def entry(label: str, result) -> Group:
    return Group(label, (result,), (f"{label}/eval.json",))


def won(label: str, successes, task: str = "libero_goal/0", digest: str = "", **changes) -> Group:
    row = task_result(task, successes, digest=digest)
    return entry(label, result_of(row, policy=f"{label}:make", **changes))


def first(count: int, of: int = 100) -> np.ndarray:
    return np.arange(of) < count


def test_tiers_are_what_paired_tests_tell_apart():
    """97 against 100 of the same starts is no evidence; the same rates of 80 and 100 are."""
    board = make_board([won("b", first(97)), won("d", first(50)), won("a", first(100)), won("c", first(80))])
    assert [(row.label, row.tier) for row in board.rows] == [("a", 1), ("b", 1), ("c", 2), ("d", 3)]
    low, high = map(float, wilson_interval(97, 100))
    assert (board.rows[1].success.low, board.rows[1].success.high) == (low, high)
    smallest = min(board.pairs, key=lambda pair: pair.difference.p_value)
    assert len(board.pairs) == 6 and smallest.adjusted == pytest.approx(6 * smallest.difference.p_value)


def test_the_order_of_the_files_changes_nothing():
    entries = [won("a", first(60)), won("b", first(60)), won("c", first(20))]
    assert make_board(entries).rows == make_board(entries[::-1]).rows


def test_results_of_one_policy_on_other_suites_are_a_row():
    parts = [
        won("a", first(50), "libero_goal/0"),
        entry("a2", result_of(task_result("libero_object/0", first(100)), policy="a:make")),
        entry("b", drawn_result(0.5, 1, suites=("libero_goal", "libero_object"), tasks=1, policy="b:make")),
    ]
    board = make_board(parts, ["starts", "tasks"])
    (row,) = [row for row in board.rows if row.label == "a"]
    assert row.episodes == 200 and row.paths == ("a/eval.json", "a2/eval.json")
    assert {name: e.value for name, e in row.suites.items()} == {"libero_goal": 0.5, "libero_object": 1.0}
    assert board.shared == 100 and row.success.value == pytest.approx(1.0), "the first 50 starts of each"


@pytest.mark.parametrize("order", [1, -1])
def test_a_copy_of_a_result_or_of_a_part_is_no_row_of_its_own(order):
    """Each further row is tested against all others, so that fewer differences remain."""
    both = drawn_result(0.5, 1, suites=("libero_goal", "libero_object"), tasks=1, policy="a:make")
    part = replace(both, tasks=both.tasks[1:])
    entries = [
        entry("a", both),
        entry("again", both),
        entry("part", part),
        won("b", first(50), "libero_goal/0"),
    ]
    board = make_board(entries[::order], ["starts", "tasks"])
    assert len(board.rows) == 2 and len(board.pairs) == 1
    assert {len(row.paths) for row in board.rows} == {1, 3}


@pytest.mark.parametrize("order", [1, -1])
def test_parts_of_which_one_was_stopped_have_intervals_that_are_always_valid(order):
    stopped = Stopped("width=0.2", "known", 100)
    parts = [
        won("a", first(50), "libero_goal/0"),
        entry("a2", result_of(task_result("libero_object/0", first(50)), policy="a:make", stopped=stopped)),
    ]
    (row,) = make_board(parts[::order], ["starts", "tasks"]).rows
    own = parts[1].results[0].success
    assert row.suites == {"libero_goal": own, "libero_object": own}


def test_a_suite_that_not_all_ran_is_left_empty(tmp_path):
    both = (task_result(f"{suite}/0", first(50)) for suite in ("libero_goal", "libero_object"))
    entries = [won("a", first(50)), entry("b", result_of(*both, policy="b:make"))]
    board = make_board(entries, ["starts"])
    text = write_board(board, entries, tmp_path / "board.html").read_text()
    assert '<td class="num" data-name="libero_object">–</td>' in text
    assert render_board(board).splitlines()[1].split()[-2:] == ["–", "100"]


def test_every_result_that_differs_is_noted():
    entries = [won("a", first(5))]
    entries += [
        won(name, first(5), protocol=PROTOCOL | {"settle_steps": n}) for name, n in (("b", 5), ("c", 7))
    ]
    assert check_comparable(entries, ["protocol"])[:2] == [
        f"protocol.settle_steps: 10 in a, {text}; allowed" for text in ("5 in b", "7 in c")
    ]
    with pytest.raises(ComparisonError, match=r"5 in b\n.*7 in c\n.* with --allow protocol.settle_steps$"):
        check_comparable(entries)


def test_instructions_of_a_task_that_the_first_lacks_and_other_task_files_are_compared():
    one = [task_result("libero_goal/0", first(50))]
    ours, theirs = (
        [*one, task_result("libero_goal/1", first(50), instruction=text)] for text in ("do it", "do that")
    )
    with pytest.raises(ComparisonError, match=r"tasks.libero_goal/1.instruction: do it in b, do that in c"):
        check_comparable(
            [entry(n, result_of(*tasks)) for n, tasks in zip("abc", (one, ours, theirs), strict=True)]
        )
    files = [won(label, first(50), "file/0", digest=label) for label in "ab"]
    with pytest.raises(ComparisonError, match=r"tasks.file/0.digest: a in a, b in b"):
        check_comparable(files)


def test_the_board_says_what_was_stopped_and_what_ended_with_errors():
    stopped = won("a", first(50), stopped=Stopped("width=0.2", "known", 100))
    failed = entry("b", result_of(task_result("libero_goal/0", first(50), errors=("E: x", *[None] * 99))))
    notes = make_board([stopped, failed], ["starts"]).notes
    assert [n for n in notes if "a: stopped after 100 of 100" in n]
    assert [n for n in notes if n.startswith("b, libero_goal/0: ")] or not failed.results[0].tasks[
        0
    ].error_note


def test_other_episodes_are_refused_by_name():
    a, fewer = won("a", first(50)), won("b", first(9, 50))
    with pytest.raises(
        ComparisonError, match="libero_goal/0, starts 0–99 in a, .*starts 0–49 in b\\n.*--allow starts"
    ):
        make_board([a, fewer])
    board = make_board([a, fewer], ["starts"])
    assert board.shared == 50 and board.rows[0].success.value == 1.0 and "; allowed" in board.notes[-1]
    assert "success is that in the 50 episodes that all ran" in render_board(board)
    assert "episodes that all ran" not in render_board(make_board([a]))
    with pytest.raises(ComparisonError, match="no episode is common to a, b"):
        make_board([a, won("b", first(9), "libero_goal/1")], ["starts"])


def test_a_start_that_a_simulation_error_ended_is_left_out_for_all():
    lost = ((0, "the solver diverged"),)
    whole, part = (
        won("a", first(2, 4)),
        task_result("libero_goal/0", [1, 0, 0], starts=(1, 2, 3), simulation_errors=lost),
    )
    board = make_board([whole, entry("b", result_of(part, policy="b:make"))])
    assert board.shared == 3 and {row.episodes for row in board.rows} == {3, 4}


def test_the_page_shows_rows_intervals_and_commands(tmp_path, monkeypatch, tab):
    monkeypatch.chdir(tmp_path)
    entries = [won("a", first(100)), won("<b>", first(20))]
    page = write_board(make_board(entries), entries, tmp_path / "new")
    assert page == tmp_path / "new" / "board.html" and tab.faults_on_a_phone(page) == []
    text = page.read_text()
    assert "libero eval a/eval.json --allow a<" in text and "&lt;b&gt;" in text and "<b></td>" not in text
    assert "[96.3, 100.0]" in text and 'class="next"' in text and "http" not in text
    assert "prefers-color-scheme: dark" in text and 'data-name="libero_goal (1 of 10 tasks)"' in text


@pytest.fixture
def there(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    won("good", first(90)).results[0].write("eval/good/eval.json")
    won("bad", first(40)).results[0].write("eval/bad/eval.json")
    return tmp_path


def test_the_command(there, capsys, monkeypatch):
    shown = []
    monkeypatch.setattr("webbrowser.open", lambda address: shown.append(address) or True)
    assert main(["board", "eval", "--open"]) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[1].split()[:3] == ["1", "good", "90.0"] and out[2].split()[:3] == ["2", "bad", "40.0"]
    assert out[-1] == "board.html" and shown == [(there / "board.html").as_uri()]
    assert main(["board", "first=eval/bad", "eval/good/eval.json", "--json", "--out", "x.html"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [(row["label"], row["tier"]) for row in rows] == [("good", 1), ("first", 2)]
    assert Path("x.html").is_file()


def test_a_result_below_another_one_is_left_out_where_it_was_made_differently(there, capsys):
    (good,) = won("good", first(90)).results
    other = replace(good, protocol={**good.protocol, "name": "another"})
    other.write("eval/good/another/eval.json")
    assert main(["board", "eval/good", "eval/bad"]) == 0
    assert "eval/good/another" in capsys.readouterr().out


def test_without_a_browser_a_note_says_where_the_page_is(there, capsys, monkeypatch):
    monkeypatch.setattr("webbrowser.open", lambda address: False)
    assert main(["board", "eval", "--open"]) == 0
    assert capsys.readouterr().err == "note: no browser could be started; the page is board.html\n"


def test_bad_input_is_one_line_and_writes_nothing(there, capsys):
    Path("empty").mkdir()
    Path("eval/cut").mkdir()
    Path("eval/cut/eval.json").write_text(Path("eval/bad/eval.json").read_text()[:500])
    for words, message in (
        (["board", "empty"], "empty holds no evaluation: there is no eval.json in it"),
        (["board", "eval"], "eval/cut/eval.json"),
        (["board", "nowhere"], "nowhere does not exist"),
        (["board", "eval/bad", "eval/good", "--out", "/dev/full/page.html"], "the page cannot be written"),
    ):
        assert main(words) == 2
        said = capsys.readouterr()
        assert message in said.err and said.err.count("\n") == 1 and not said.out
    assert sorted(path.name for path in there.iterdir()) == ["empty", "eval"]


def test_the_page_of_an_evaluation_shows_its_failures(tmp_path, tab):
    videos = tmp_path / "videos"
    videos.mkdir()
    for name in ("libero_goal_00_start_01_failure", "libero_goal_00_start_00_success"):
        (videos / f"{name}.webp").write_bytes(name.encode())
    errors = (None, "ServerError: closed <here>", None)
    tasks = task_result("libero_goal/0", [1, 0, 1], errors=errors), task_result("libero_object/0", [0, 0, 0])
    page = write_evaluation_page(result_of(*tasks), tmp_path)
    text = page.read_text()
    assert tab.faults_on_a_phone(page) == []
    assert text.count("<img") == 1 and "start 01 failure" in text and "start 00 success" not in text
    assert "do what libero_goal/0 asks" in text and "[9.7, 70.0]" in text and "2 of 3" in text
    assert "1 ended with an error, such as: ServerError: closed &lt;here&gt;" in text
    assert ">libero_object (1 of 10 tasks)</td>" in text and "mean over tasks" in text and "2 of 6" in text
    assert "--allow mine" in text and "http" not in text
