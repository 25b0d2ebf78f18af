"""`libero demos`: options take effect, and every tool runs on a recorded file."""

import json
from pathlib import Path

import h5py
import pytest

from libero_cli import main as cli
from libero_cli.recording import resolved
from libero_env.cli import recording as cli_demos
from libero_env.cli.options import Size, parse
from libero_env.demos.read import read_demos
from libero_env.demos.record import RecordingReport
from tests.harness.demos import wander

pytestmark = pytest.mark.sim
GENERATE = ["generate", "--task", "libero_goal/3", "--n", "1"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("libero_env.demos.record.run_experts", wander)
        argv = [
            "demos", "generate", "--task", "libero_goal/3", "--n", "2", "--size", "16x24", "--depth", "--workers",
            "1"
        ]  # fmt: skip
        assert cli.main([*argv, "--folder", str(root), "--cameras", "agentview", "--variation", "none"]) == 0
    return root


@pytest.fixture
def file(folder):
    (file,) = folder.rglob("*.hdf5")
    return file


def test_options_are_recorded(file):
    with h5py.File(file) as handle:
        attrs, demo = handle["data"].attrs, handle["data/demo_0"]
        assert attrs["camera_size"].tolist() == [16, 24] and not attrs["disturbed"]
        assert '"style": false' in attrs["variation"] and "expert_actions" not in demo
        assert demo["obs/agentview_depth"].shape[1:] == (16, 24) and "eye_in_hand_rgb" not in demo["obs"]


@pytest.mark.parametrize(
    ("words", "given", "recorded"),
    [
        ((), {}, {"camera_size": (64, 64)}),
        ((), {"size": (32, 48)}, {"camera_size": (32, 48)}),
        (("data.seed=7",), {}, {"seed": 7}),
        (("data.seed=7",), {"seed": 0}, {"seed": 0}),
        (("data.robot=robosuite-1.4.1",), {}, {"robot": "robosuite-1.4.1"}),
        (("data.robot=robosuite-1.4.1",), {"robot": "libero"}, {"robot": "libero"}),
    ],
)
def test_what_is_not_given_is_as_a_run_reads_it(words, given, recorded):
    request = cli_demos.RecordingRequest(task="libero_goal/3", training=("preset=laptop", *words), **given)
    (config,) = cli_demos.demo_configs(resolved(request))
    assert {name: getattr(config, name) for name in recorded} == recorded


def test_every_tool_runs(file, tmp_path, capsys):
    def ran(*argv, status=0):
        assert cli.main(["demos", *map(str, argv)]) == status
        return capsys.readouterr().out

    assert "2 demonstrations, 24 steps, 16x24 pixels" in ran("info", file)
    assert "12-12 steps (mean 12), 2 of 2 successful" in ran("check", file)
    output = ran("replay", file, "--demo", 1, "--video", tmp_path / "replay.gif", "--size", 32, status=1)
    assert "demo_1: no success after 12 steps, largest drift: objects 0.00 mm" in output
    assert (tmp_path / "replay.gif").stat().st_size > 1000
    (row,) = json.loads(ran("replay", file, "--demo", 1, "--json", status=1))
    assert row["demonstration"] == "demo_1" and not row["success"] and row["drift"] < 1e-5
    (row,) = json.loads(ran("check", file, "--json"))
    assert row["demonstrations"] == 2 and not row["faults"]
    assert "16x16 pixels" in ran("rerender", file, tmp_path / "new.hdf5", "--size", 16)
    assert set(read_demos(tmp_path / "new.hdf5")[0].obs) >= {"agentview_rgb", "eye_in_hand_rgb"}
    assert "12-12 steps" in ran("filter", file, tmp_path / "kept.hdf5", "--success", "--no-ops")
    pytest.importorskip("av")
    pytest.importorskip("pyarrow")
    assert "2 episodes, 24 frames" in ran("export", file, "--out", tmp_path / "set")
    assert "2 episodes" in ran("export", file, "--out", tmp_path / "joints", "--actions", "joint")
    assert "0 of 1 successful" in ran("replay", file, "--demo", 0, "--actions", "absolute", status=1)


def test_failures_are_counted_by_kind():
    report = RecordingReport(recorded=2, attempts=8)
    reasons = {"in phase reach after 250 steps": 2, "in phase reach after 91 steps": 3, "mug_1 tipped": 1}
    report.failure_reasons.update(reasons)
    first, *lines = cli_demos.report_lines(report)
    assert first == "2 of 8 attempts successful (25 %)"
    assert lines == ["5 x in phase reach after N steps", "1 x mug_1 tipped"]
    report.error = "it gave up"
    assert cli_demos.report_lines(report)[-1] == "ERROR it gave up"
    told = "1 of 2 tasks complete, 25.0 % of 8 attempts successful"
    assert cli_demos.summary({Path("a"): RecordingReport(3), Path("b"): report}, 3) == told


def _size(*, size: Size = (1, 1)) -> tuple[int, int]:
    return size


def test_sizes_are_one_number_or_two():
    assert [parse(_size, ["--size", text], "x")() for text in ("64", "48x64")] == [(64, 64), (48, 64)]
    for wrong in ("0", "1x2x3", "4x"):
        with pytest.raises(SystemExit):
            parse(_size, ["--size", wrong], "x")


@pytest.mark.parametrize(("argv", "hint"), [
    (["generate", "--task", "libero_goal/99", "--n", "1"], "index of libero_goal"),
    ([*GENERATE, "--cameras", "agentveiw"], "Did you mean 'agentview'?"),
    (["generate", "--bddl", "nowhere.bddl", "--n", "1"], "nowhere.bddl"),
    ([*GENERATE, "--variation", "style", "--noise", "0"], "--noise cannot be used without"),
    ([*GENERATE, "--variation", "none", "style"], "none stands alone"),
    ([*GENERATE, "--no-images", "--cameras", "birdview", "--size", "64", "--depth", "--drawing", "fast"],
     "--cameras, --size, --drawing, --depth cannot be used with --no-images"),
    (["replay", "nowhere.hdf5"], "nowhere.hdf5"),
    (["replay", "a.hdf5", "--cameras", "top", "--size", "64"], "--cameras, --size cannot be used without --video"),
    (["rerender", "a.hdf5", "b.hdf5", "--perturb-seed", "0"], "--perturb-seed cannot be used without --perturb"),
    (["export", "a.hdf5", "--out", "set", "--as", "rlsd"], "Did you mean 'rlds'?"),
    (["export", "a.hdf5", "--out", "set", "--settle", "3"], "--settle cannot be used with --as lerobot"),
    (["export", "a.hdf5", "--out", "set", "--as", "lerobot/libero", "--actions", "joint"], "--actions cannot"),
])  # fmt: skip
def test_invalid_input_gives_one_line_and_a_status(argv, hint, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path))
    assert cli.main(["demos", *argv]) == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("error:")]
    assert len(lines) == 1 and hint in lines[0]


def test_cameras_have_names(capsys):
    with pytest.raises(SystemExit):
        cli.main(["demos", "rerender", "a", "b", "--cameras"])
    assert "cameras are missing" in capsys.readouterr().err


def test_images_can_be_left_out_and_rendered_later(tmp_path, monkeypatch):
    monkeypatch.setattr("libero_env.demos.record.run_experts", wander)
    argv = ["demos", "generate", "--task", "libero_goal/3", "--n", "1", "--no-images", "--workers", "1"]
    assert cli.main([*argv, "--folder", str(tmp_path)]) == 0
    (file,) = tmp_path.rglob("*.hdf5")
    assert not [key for key in h5py.File(file)["data/demo_0/obs"] if key.endswith("rgb")]
    drawn = tmp_path / "drawn.hdf5"
    assert cli.main(["demos", "rerender", str(file), str(drawn), "--size", "16"]) == 0
    (demo,) = read_demos(drawn, ["agentview_rgb", "joint_states"])
    assert demo.obs["agentview_rgb"].shape[1:] == (16, 16, 3)
    dark = tmp_path / "dark.hdf5"
    assert cli.main(["demos", "rerender", str(file), str(dark), "--perturb", "light=0.5"]) == 0
    assert {"agentview_rgb", "eye_in_hand_rgb"} <= set(h5py.File(dark)["data/demo_0/obs"])
