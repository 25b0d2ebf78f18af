"""`eval.json`: written and read to the same values; other formats, broken files and edited ones are refused."""

import json
from dataclasses import replace

import pytest

from libero_eval.evaluation_file import FORMAT, EvaluationResult
from lifelong.errors import EvaluationFileError, ResultsError
from tests.harness.results import result_of, task_result

ROWS = {
    "lengths": (40, 300, 52),
    "atoms": ("(Open drawer)",),
    "errors": (None, "ServerError: closed", None),
    "atoms_ever": ((True,), (False,), (True,)),
    "atoms_at_end": ((True,), (False,), (True,)),
}


def result(**changes) -> EvaluationResult:
    """Return a result whose first task has other values."""
    first = task_result("libero_goal/0", [1, 0, 1], **(ROWS | changes))
    return result_of(first, task_result("libero_spatial/4", [1, 0, 1], **ROWS), unit_starts=10)


def test_what_is_written_is_read(tmp_path):
    path = result().write(tmp_path / "eval.json")
    assert EvaluationResult.read(path) == EvaluationResult.read(tmp_path) == result()
    values = json.loads(path.read_text())
    assert values["format"] == FORMAT
    assert set(values["suites"]) == {"libero_goal", "libero_spatial"}
    assert values["success"]["value"] == pytest.approx(2 / 3) and values["tasks"][0]["mean_steps"] == 46


def test_the_digest_is_that_of_the_outcomes():
    first = result()
    assert replace(first, times={}, environment={"models": "x"}, versions={}).outcomes == first.outcomes
    assert replace(first, tasks=first.tasks[::-1]).outcomes == first.outcomes
    assert result(lengths=(40, 300, 53)).outcomes != first.outcomes


def test_the_digest_of_actions_tells_bits_apart_that_outcomes_do_not_show():
    first, second = (result(actions=("01", "02", last)) for last in ("03", "04"))
    first, second = (replace(one, tasks=one.tasks[:1]) for one in (first, second))
    assert first.outcomes == second.outcomes and first.actions != second.actions
    assert result().actions is None, "they were not recorded"


def edited(**changes) -> str:
    return json.dumps(result().to_plain() | changes)


def with_task(**changes) -> str:
    values = result().to_plain()
    values["tasks"][0] |= changes
    return json.dumps(values)


@pytest.mark.parametrize(("text", "message"), [
    (edited(format="libero-evaluation/2", versions={"libero-lifelong": "0.7.1"}),
     "libero-evaluation/2, and this program reads libero-evaluation/1: read it with libero-lifelong 0.7.1, which"),
    (edited(format="libero-evaluation/0", versions={}), "read it with the version of libero-lifelong that wrote it"),
    (edited(format="lerobot/1"), "has the format 'lerobot/1'; expected libero-evaluation/1"),
    (json.dumps({"results": []}), "has no format"),
    (edited()[:300], "broken or incomplete"),
    (edited(tasks=[]), "no tasks"),
    (edited(protocol={"world": [1]}), r"protocol\.world is \[1\]; expected keys with values"),
    (json.dumps({"format": FORMAT}), "evaluated is missing; protocol is missing"),
    (with_task(successes=[True]), "tasks.0: libero_goal/0: successes has 1 entries, init_states has 3"),
    (with_task(successes=[1, 0, 1]), "tasks.0.successes.0 is 1; expected a valid boolean"),
    (with_task(simulation_errors=[[2, "it has diverged"]]), "counted twice"),
    (with_task(atoms_ever=[[True], [False], []]), "a column for each"),
    (with_task(task="libero_spatial/4"), "tasks are counted twice: libero_spatial/4"),
    (with_task(successes=[True, True, True]), "the file was edited"),
])  # fmt: skip
def test_other_files_are_refused_by_name(tmp_path, text, message):
    (tmp_path / "eval.json").write_text(text)
    with pytest.raises(EvaluationFileError, match=r"eval\.json.*" + message):
        EvaluationResult.read(tmp_path)


def test_a_missing_file_and_one_that_cannot_be_written(tmp_path):
    with pytest.raises(EvaluationFileError, match="does not exist"):
        EvaluationResult.read(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        result().write(tmp_path / "file" / "eval.json")
