"""What a number is called: its protocol with all that was changed, its part of a suite, and its one interval."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml

from libero_cli.main import main
from libero_env.text import json_safe
from libero_eval.evaluation_file import Stopped, known_by
from libero_eval.judging.board import make_board, render_board, write_board
from libero_eval.judging.comparability import Group, check_comparable
from libero_eval.judging.comparison import compare_groups, gate
from libero_eval.judging.evaluation_page import write_evaluation_page
from libero_eval.judging.page import interval_text, render, write_page
from libero_eval.plan import setting
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.naming import protocol_label
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import EvalRequest
from libero_eval.robustness.page import write_robustness
from libero_eval.robustness.results import Outcomes
from libero_eval.robustness.study import read_study
from libero_eval.work.progress import total_rows
from libero_integrations.exports.results import export
from lifelong.errors import ConfigError
from tests.harness.results import drawn_result, result_of, task_result

OPENPI = load_protocol("openpi")
# openpi run for a run's policy where the original's models and states are missing, in six steps
MANY = {
    "world.models": "builtin", "world.init_states": "builtin", "world.fixture_poses": "stored", "world.env_seed": None,
    "world.perturb": "camera=0.5", "episode.horizon": 6, "pixels.render_size": (128, 128),
}  # fmt: skip
CHANGES = {
    "episode.horizon 6 (300)": {"episode.horizon": 6},
    "action.clock latency=120ms (none)": {"action.clock": "latency=120ms"},
    "episode.settle_counted true (false)": {"episode.settle_counted": True},
    "world.models builtin (original), world.init_states builtin (original), world.fixture_poses stored (drawn), "
    "world.perturb camera=0.5 (none), episode.horizon 6 (300), pixels.render_size [128, 128] ([256, 256])": MANY,
}


def surfaces(result, folder) -> dict[str, str]:
    """Return every text in which the success of a result, or of another beside it, stands."""
    other = replace(result, evaluated={"policy": "other:make"})
    groups = [Group(name, (one,), (f"{name}/eval.json",)) for name, one in (("a", result), ("b", other))]
    board, comparison = make_board(groups), compare_groups(groups)
    stored = json_safe(result.protocol)
    (folder / "eval").mkdir(parents=True)
    for condition, perturb in (("none", ""), ("light=0.5", "light=0.5")):
        world = {**stored["world"], "perturb": perturb}
        replace(result, protocol={**stored, "world": world}).write(
            folder / "conditions" / condition / "eval.json"
        )
    exports = {
        form: export(result, folder, form, "org/x", partial=True) for form in ("vla-eval", "eval-results")
    }
    return {
        "page": write_evaluation_page(result, folder / "eval").read_text(),
        "page in the terminal": "\n".join(total_rows(result)),
        "board": write_board(board, groups, folder / "board.html").read_text(),
        "board in the terminal": render_board(board),
        "comparison": write_page(comparison, folder / "compare.html").read_text(),
        "comparison in the terminal": render(comparison),
        "robustness": write_robustness([read_study(folder)], folder).read_text(),
        **{form: path.read_text() for form, (path,) in exports.items()},
        "lerobot": export(result, folder, "lerobot")[0].read_text(),
    }


@pytest.mark.parametrize("text", CHANGES)
def test_a_changed_protocol_is_called_changed_wherever_a_number_stands(text, tmp_path, capsys):
    protocol = OPENPI.changed(CHANGES[text])
    result = drawn_result(0.7, 1, tasks=2, protocol=protocol.resolved())
    for name, content in surfaces(result, tmp_path).items():
        told = text.replace("world.perturb camera=0.5 (none), ", "") if name == "robustness" else text
        assert f"openpi, changed: {told}" in content, name
        assert "libero_goal (2 of 10 tasks)" in content or "comparison" in name or name == "lerobot", name
    assert protocol.title.endswith("pi0.5, changed")
    for key in CHANGES[text]:
        assert protocol.sources[key].startswith("changed; openpi has"), "its source is none of this value"
    assert main(["protocols", "show", str(result.write(tmp_path / "eval.json"))]) == 0
    assert capsys.readouterr().out.startswith("openpi, changed: ")


def test_a_long_name_fits_a_phone(tmp_path, tab):
    result = drawn_result(0.7, 1, tasks=2, protocol=OPENPI.changed(MANY).resolved())
    surfaces(result, tmp_path)
    pages = [*tmp_path.glob("*.html"), *tmp_path.glob("eval/*.html")]
    assert len(pages) == 4 and [tab.faults_on_a_phone(page) for page in pages] == [[]] * 4


def test_a_protocol_that_is_run_as_it_is_has_its_name_alone():
    assert protocol_label(OPENPI.resolved()) == "openpi"
    there = OPENPI.changed({"world.control_freq": 10})
    assert protocol_label(there.changed({"world.control_freq": 20}).resolved()) == "openpi", "and back again"
    again = EvalProtocol.read(json.loads(json.dumps(there.resolved())), "result")
    assert again == there and again.digest == there.digest != OPENPI.digest


def test_whatever_a_file_says_of_itself_it_is_compared_with_the_protocol_of_its_name(tmp_path):
    stated = json_safe(OPENPI.changed({"episode.horizon": 6}).resolved())
    stated |= {"changes": {}, "sources": OPENPI.sources, "title": OPENPI.title}
    assert protocol_label(stated, ["libero_goal"]) == "openpi, changed: episode.horizon 6 (300)"
    own = tmp_path / "openpi.yaml"  # of a user, with the name of the package's
    own.write_text("extends: lerobot\nepisode: {errors: failure}\naction: {replan: 5}")
    assert protocol_label(load_protocol(own).resolved()).startswith(
        "openpi, changed: world.robot libero (robosuite"
    )
    (mine := tmp_path / "mine.yaml").write_text("extends: openpi\nepisode: {horizon: 6}")
    loaded = load_protocol(mine)
    assert loaded.title.endswith(", changed") and loaded.sources["episode.horizon"] == "mine.yaml's own"
    assert protocol_label(loaded.changed({"episode.horizon": 7}).resolved()) == (
        "mine, changed: episode.horizon 7 (6)"
    )
    assert protocol_label({"name": "openpi", "world": [1], "episode": None}) == "openpi", "of a stranger"


def test_one_success_has_one_interval_everywhere(tmp_path):
    result = drawn_result(0.7, 1, tasks=3, protocol=OPENPI.resolved())
    shown = {name: text.replace("−", "-") for name, text in surfaces(result, tmp_path).items()}
    wanted = interval_text(result.success)
    for name in ("page", "board", "comparison"):
        assert wanted in shown[name] and wanted in shown[f"{name} in the terminal"], name
    outcomes = read_study(tmp_path).outcomes
    assert outcomes.success(()) == result.success == result.suites["libero_goal"]
    (notes,) = (one["notes"] for one in yaml.safe_load(shown["eval-results"]))
    assert wanted[1:-1].replace(", ", " to ") in notes


@pytest.mark.parametrize("count", [1, 4, 5])
def test_fewer_than_five_episodes_have_no_interval_and_none_leaves_0_to_100(count, tmp_path):
    result = result_of(task_result("libero_goal/0", [True] * count), protocol=OPENPI.resolved())
    texts = surfaces(result, tmp_path)
    assert "nan" not in "".join(texts[name] for name in texts if name not in ("vla-eval", "lerobot"))
    assert (interval_text(result.success) == "") == (count < 5)
    ends = [read_study(tmp_path).outcomes.axes[0]]
    for e in (ends[0].area, ends[0].kept, *ends[0].success):
        assert np.isnan([e.low, e.high]).all() if count < 5 else 0 <= e.low <= e.value <= e.high <= 1
    (policy,) = json.loads((tmp_path / "robustness.json").read_text())["policies"]
    assert policy["axes"][0]["kept"]["value"] == 1


def test_what_two_perturbations_leave_stays_within_everything():
    """Success that rises under perturbations keeps all, not more."""
    rng = np.random.default_rng(3)
    conditions = ((), (("camera", 0.5),), (("camera", 0.5), ("light", 0.5)), (("light", 0.5),))
    rates = np.array([0.3, 0.6, 0.8, 0.7])[:, None, None]
    outcomes = Outcomes(
        ("libero_goal/0", "libero_goal/1"), tuple(range(10)), conditions, rng.random((4, 2, 10)) < rates
    )
    assert all(0 <= e.low <= e.value <= e.high <= 1 for axis in outcomes.axes for e in (axis.kept, axis.area))
    (pair,) = outcomes.interactions
    assert -1 <= pair.excess.low <= pair.excess.value <= pair.excess.high <= 1 and pair.expected <= 1


def test_a_task_without_a_digest_is_noted_as_not_known_to_be_the_same():
    known, other = (
        Group(name, (result_of(task_result("file/0", [1] * 9, digest=digest), policy=name),))
        for name, digest in (("a", "d1"), ("b", ""))
    )
    note = "digest of file/0: not recorded; taken to be the same task"
    assert note in check_comparable([known, other]) and note in compare_groups([other, known]).notes
    assert note not in check_comparable([known, known])


def test_the_gate_does_not_judge_what_was_stopped():
    a, b = (Group(n, (drawn_result(0.9, k, policy=n),)) for k, n in enumerate("ab"))
    stopped = Group("b", (replace(b.results[0], stopped=Stopped("width=0.2", "known", 900)),))
    assert gate(compare_groups([a, b]), 0.5).verdict == "no regression"
    with pytest.raises(
        ConfigError, match=r"--gate does not judge results that --until stopped \(b\): .*without --until"
    ):
        gate(compare_groups([a, stopped]), 0.5)
    wide, narrow = (compare_groups([a, one]).rates[1].success for one in (stopped, b))
    assert wide.low < narrow.low < narrow.high < wide.high, "always valid, as on its own page"
    (row,) = (row for row in make_board([a, stopped]).rows if row.label == "b")
    assert row.success == stopped.results[0].success == wide


ASKED = [
    {"until": "width=0.05"}, {"event": ("receptacle=1@lifted",), "clock": "latency=120ms"}, {"episodes": 3},
    {"protocol": "openpi"}, {"names": "native"}, {"horizon": 6}, {"perturb": "camera=0.3"}, {"clock": ""}, {"seed": 3},
    {"perturb": "camera=0.3", "perturb_seed": 7}, {"starts": "reporting"}, {"control_freq": 10}, {"size": 64},
    {"robot": "robosuite-1.4.1", "name": "pi0"}, {"backend": "warp"}, {"assets": "original"}, {"perturb": ""},
]  # fmt: skip


def test_each_evaluation_has_a_folder_that_says_what_is_not_the_plain_protocol():
    folders = [setting(EvalRequest(policy="my:make", **asked)) for asked in ASKED]
    named = [one for one in folders if one]
    assert folders[0] == folders[2] == () and len({*named}) == len(named) == len(ASKED) - 2
    assert folders[1] == ("receptacle=1@lifted+latency=120ms",) and folders[7] == ("clock=none",)
    assert folders[13] == ("robot=robosuite-1.4.1",), "--name alone names the policy's own folder"
    long = setting(
        EvalRequest(
            policy="x", event=tuple(f"camera=0.{k}@lifted" for k in range(1, 9)), protocol="/a/../my x.yaml"
        )
    )
    assert len(long[0]) == 80 and long[0].startswith("my_x+camera=0.1@lifted,") and "/" not in long[0]


def test_a_policy_server_with_a_name_may_move():
    there = {"server": "ws://a:1", "announced": {}, "name": "pi0", "seed": 0}
    assert known_by(there) == known_by(there | {"server": "ws://b:2"})
    assert known_by(there | {"name": None}) != known_by(there | {"name": None, "server": "ws://b:2"})


@pytest.mark.parametrize("words", ["--event camera=0@step2", "--perturb camera=0,light=0.5"])
def test_a_perturbation_of_severity_0_is_refused(words, capsys):
    assert main(["eval", "expert", "--suite", "libero_goal/0", *words.split()]) == 2
    assert "severity 0 changes nothing" in capsys.readouterr().err


def test_a_board_of_a_folder_ranks_what_can_be_compared_and_names_the_rest(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    libero = load_protocol("libero")
    for name, protocol in {
        "a": libero, "b": libero, "b/latency=120ms": libero.changed({"action.clock": "latency=120ms"}),
        "b/robustness/conditions/light=0.5": libero.changed({"world.perturb": "light=0.5"}), "c/openpi": OPENPI,
    }.items():  # fmt: skip
        result = drawn_result(0.7, len(name), policy=name, protocol=protocol.resolved())
        result.write(tmp_path / "eval" / name / "eval.json")
    assert main(["board", "eval"]) == 0
    out = capsys.readouterr().out
    assert out.count("left out: ") == 2
    assert "left out: eval/b/latency=120ms/eval.json, whose protocol.action.clock" in out
    assert "eval/c/openpi/eval.json, whose protocol.name is openpi" in out and "conditions" not in out
    assert main(["board", "eval/a", "eval/b/latency=120ms"]) == 2, "what is named is not left out"
    assert "protocol.action.clock" in capsys.readouterr().err
