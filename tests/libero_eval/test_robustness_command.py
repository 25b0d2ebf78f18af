"""`libero robustness` and the scripted expert as a policy."""

import json
import pickle

import pytest

from libero_cli.main import main
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.requests import SEVERITIES, RobustnessRequest
from libero_eval.robustness.study import conditions_of
from tests.harness.evaluations import write_policy

pytestmark = pytest.mark.sim

LATE = "{extends: libero, name: late, title: late, action: {clock: 'latency=50ms,wait=hold'}}"
WORDS = [
    "still_policy:make", "--suite", "libero_goal/1", "--episodes", "2", "--horizon", "2", "--threads", "1"
]  # fmt: skip
TWO = ["--kinds", "noise", "robot", "--severities", "1", "0.5", "--pairs", "noise=0.5,robot=0.5"]


@pytest.fixture
def still(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = "cameras, camera_size, observations = ('agentview',), (16, 16), ('rgb',)"
    write_policy(tmp_path / "still_policy.py", "np.zeros((len(observations['agentview_rgb']), 7))", own)
    (tmp_path / "late.yaml").write_text(LATE)
    (tmp_path / "dim.yaml").write_text("{extends: libero, world: {perturb: light=0.5}}")
    return tmp_path


def test_all_conditions_are_run_once_and_the_page_is_written(still, capsys) -> None:
    assert main(["robustness", *WORDS, *TWO, "--out", "found"]) == 0
    said = capsys.readouterr().out
    assert "nan" not in said
    page = (still / "found" / "robustness.html").read_text()
    assert ", inf]" not in page and str(still) not in page and "robot" in page
    assert page.count("<svg") == 1, "no radar of two kinds"
    folders = sorted(path.parent.name for path in still.glob("found/conditions/*/eval.json"))
    assert folders == ["noise=0.5", "noise=1", "none", "robot=0.5", "robot=0.5,noise=0.5", "robot=1"]
    assert "6/6" in said and "nothing to lose" in said
    record = json.loads((still / "found" / "robustness.json").read_text())["policies"][0]
    assert record["label"] == "still_policy:make" and len(record["axes"]) == 2
    assert [pair["condition"] for pair in record["interactions"]] == ["robot=0.5,noise=0.5"]
    for folder, perturb in (("none", ""), ("robot=1", "robot=1")):
        result = EvaluationResult.read(still / "found" / "conditions" / folder)
        assert result.protocol["world"]["perturb"] == perturb and len(result.tasks[0].successes) == 2

    before = {path: path.stat().st_mtime_ns for path in still.glob("found/conditions/*/units/*")}
    assert main(["robustness", *WORDS, *TWO, "--out", "found"]) == 0, "what is done is not run again"
    assert before == {path: path.stat().st_mtime_ns for path in still.glob("found/conditions/*/units/*")}

    assert main(["robustness", "--report", "first=found", "second=found", "--out", "both"]) == 0
    assert "first" in (still / "both" / "robustness.html").read_text()
    labels = [p["label"] for p in json.loads((still / "both" / "robustness.json").read_text())["policies"]]
    assert labels == ["first", "second"]
    assert main(["robustness", "--report", "found", "found", "--out", "both"]) == 2
    assert "two policies are named found" in capsys.readouterr().err
    (still / "a=b").symlink_to(still / "found")
    assert main(["robustness", "--report", "a=b", "c=a=b", "--out", "both"]) == 0
    labels = [p["label"] for p in json.loads((still / "both" / "robustness.json").read_text())["policies"]]
    assert labels == ["a=b", "c"]

    others = ["--kinds", "noise", "--severities", "1", "--pairs", "--perturb-seed", "3", "--out", "found"]
    assert main(["robustness", *WORDS, *others]) == 0
    record = json.loads((still / "found" / "robustness.json").read_text())["policies"][0]
    assert [*record["outcomes"]] == ["without perturbations", "noise=1"], "only what is asked for"
    assert main(["robustness", "--report", "found"]) == 2
    assert "holds noise=1 twice, noise=1 and noise=1@3" in capsys.readouterr().err


def test_a_report_has_no_other_options(capsys) -> None:
    assert main(["robustness", "expert", "--report", "a=b", "--kinds", "camera", "--horizon", "9"]) == 2
    assert "leave out policy, --horizon, --kinds" in capsys.readouterr().err


def test_latency_is_a_kind_whose_severity_is_in_seconds(still, capsys) -> None:
    latencies = ["--kinds", "clock", "--severities", "0", "0.05", "0.2", "--pairs"]
    assert main(["robustness", *WORDS, *latencies, "--clock", "wait=hold", "--out", "found"]) == 0
    assert "3/3" in capsys.readouterr().out
    for folder, ms in (("none", 0), ("clock=0.05", 50), ("clock=0.2", 200)):
        protocol = EvaluationResult.read(still / "found" / "conditions" / folder).protocol
        assert protocol["action"]["clock"] == f"latency={ms}ms,wait=hold"
    (axis,) = json.loads((still / "found" / "robustness.json").read_text())["policies"][0]["axes"]
    assert axis["kind"] == "clock" and axis["severities"] == [0, 0.05, 0.2]
    words = ["--kinds", "noise", "--severities", "1", "--pairs", "--clock", "latency=50ms", "--out", "both"]
    assert main(["robustness", *WORDS, *words]) == 0
    late = EvaluationResult.read(still / "both" / "conditions" / "noise=1").protocol
    assert (late["action"]["clock"], late["world"]["perturb"]) == ("latency=50ms", "noise=1")


def test_events_are_conditions_and_the_page_says_what_each_takes(still, capsys) -> None:
    words = ["--kinds", "camera@step1", "light@touched", "--severities", "1", "--pairs", "--out", "found"]
    assert main(["robustness", *WORDS, *words]) == 0
    said = capsys.readouterr().out
    assert "camera=1@step1" in said and "2 of 2" in said and "0 of 2" in said
    record = json.loads((still / "found" / "robustness.json").read_text())["policies"][0]
    rows = {row["name"]: (row["episodes"], row["began"], row["solved"]) for row in record["events"]}
    assert rows == {"camera=1@step1": (2, 2, 0), "light=1@touched": (2, 0, 0)}
    assert {(row["p_value"], row["difference"]["value"]) for row in record["events"]} == {(1.0, None)}
    assert "<h2>Events</h2>" in (still / "found" / "robustness.html").read_text()
    conditions = conditions_of(RobustnessRequest(events=True))
    assert len(conditions) == 19 and {"object=0.6@step20", "camera=1@lifted"} <= {*conditions}
    named = conditions_of(RobustnessRequest(events=True, severities=SEVERITIES))
    assert "camera=0.2@lifted" in named and len(named) == 31, "what is named is not replaced"


@pytest.mark.parametrize(("words", "told"), [
    (["--kinds", "object@lifted"], "the robot touches the object then"),
    (["--kinds", "goal@touched"], "goal=0.2@touched: still_policy:make cannot be told another instruction"),
    (["--kinds", "clock", "--clock", "latency=50ms", "--pairs"], "latency is named twice"),
    (["--severities", "2"], "--severities"),
    (["--kinds", "noise", "--severities", "1", "--pairs", "noise=1,robot=1"], "must also be run alone"),
    (["--kinds", "noise", "object", "--severities", "1", "--pairs", "noise=1@7,object=1"], "give it no other seed"),
    (["--pairs", "noise=1"], "expected two perturbations"),
    (["--kinds", "noise", "noise@3"], "differ in their seeds alone"),
    (["--kinds"], "name no condition"),
    (["--kinds", "clock", "--pairs", "--protocol", "late.yaml"], "has the clock latency=50ms,wait=hold"),
    (["--kinds", "noise", "--protocol", "dim.yaml"], "protocol dim.yaml has the perturbations light=0.5"),
    (["--beside", "other=nowhere"], "nowhere holds no finished conditions"),
])  # fmt: skip
def test_mistakes_take_one_line_before_anything_is_run(still, words, told, capsys) -> None:
    try:
        status = main(["robustness", *WORDS, *words, "--out", "found"])
    except SystemExit as ended:  # as argparse does
        status = ended.code
    assert status == 2
    error = capsys.readouterr().err
    assert told in error and len(error.strip().splitlines()[-1:]) == 1 and not (still / "found").exists()


def test_notes_are_said_once(still, capsys) -> None:
    words = ["--kinds", "noise", "--severities", "1", "--pairs", "--protocol", "openpi", "--names", "native"]
    assert main(["robustness", *WORDS, *words]) == 0
    assert capsys.readouterr().err.count("note: models: builtin") == 1


@pytest.mark.parametrize("link", ["robustness", "robustness/conditions", "robustness/conditions/none"])
def test_nothing_is_removed_where_a_link_leads(still, link, capsys) -> None:
    (still / "mine" / "units").mkdir(parents=True)
    path = still / "eval" / "still_policy" / "horizon=2" / link
    path.parent.mkdir(parents=True)
    path.symlink_to(still / "mine")
    assert main(["robustness", *WORDS, *TWO, "--again"]) == 2
    assert "is a link, or is not a folder" in capsys.readouterr().err and (still / "mine" / "units").is_dir()


def test_worker_processes_find_the_same_conditions() -> None:
    """Requests are pickled on their way to them; the default pairs of kinds that are not run are left out."""
    request = RobustnessRequest(kinds=("noise",), severities=(0.4,))
    conditions = conditions_of(request)
    assert conditions == ["", "noise=0.4"] == conditions_of(pickle.loads(pickle.dumps(request)))
