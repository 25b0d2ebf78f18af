"""`libero check`: nothing that is damaged, exchanged or lost in a run directory stays unnoticed."""

import json
import shutil

import pytest
import yaml

from libero_cli.main import main
from libero_eval.check import examine
from lifelong.results.cells import measured_tasks
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord, LossRecord, RunEndRecord, TaskEndRecord, from_line
from lifelong.results.run_directory import RunDirectory
from lifelong.results.summary import write_summary
from tests.harness.records import evaluation, run_start
from tests.harness.sequences import run_context, sequence


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run of two tasks, with everything that an experiment writes."""
    path = tmp_path_factory.mktemp("runs") / "run"
    directory = RunDirectory(path)
    with directory.opened({"seed": 1, "algo": {"_target_": "EWC"}}, resume=True):
        context = run_context(path, "ewc", tasks=2)
        names = [task.name for task in context.tasks]
        context.directory.log.append(run_start(names, algo="ewc"))
        sequence(context).run()
        context.directory.log.append(RunEndRecord(seconds=1.0, finished="2026-01-01T00:00:00+00:00"))
        write_summary(path / "results.json", context.directory.log.read(), {})
    return path


@pytest.fixture
def run(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "run")


def faults(run, level="fault"):
    return [finding.text for finding in examine(run).findings if finding.level == level]


def notes(run):
    return faults(run, "note")


def flip(file):
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def test_an_intact_run_is_sound(finished, capsys):
    assert main(["check", str(finished)]) == 0
    assert "sound" in capsys.readouterr().out and not faults(finished) and not notes(finished)
    assert main(["check", "--json", str(finished.parent)]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["sound"] and row["checkpoints"] == 4 and row["findings"] == []


@pytest.mark.parametrize("name", ["task_0", "task_1", "progress", "best"])
def test_a_flipped_bit_of_a_checkpoint_is_found(run, name, capsys):
    file = run / "checkpoints" / f"{name}.safetensors"
    flip(file)
    fault, *others = faults(run)
    assert f"{name}.safetensors is broken" in fault
    assert len(others) == (name == "task_0")  # of which task_1 has what is unchanged
    assert all("or that of task_0.safetensors" in other for other in others)
    assert main(["check", str(run)]) == 1 and "fault: " in capsys.readouterr().out


def test_checkpoints_of_other_tasks_and_runs_are_found(run):
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(yaml.safe_dump(yaml.safe_load(text) | {"seed": 2}))
    assert all("of another configuration" in text for text in faults(run)) and len(faults(run)) == 4
    (run / "config.yaml").write_text(text)
    for task, other in ((0, 1), (1, 0)):
        shutil.copy(run / "checkpoints" / f"task_{task}.safetensors", run / f"{other}")
    for task in (0, 1):
        shutil.move(run / f"{task}", run / "checkpoints" / f"task_{task}.safetensors")
    first, second = faults(run)  # what the first refers to is elsewhere now
    assert "task_0.safetensors is broken" in first and "was written after task 0" in second


def test_every_lost_or_changed_line_is_found(run):
    path = run / "results.jsonl"
    lines = path.read_bytes().splitlines(keepends=True)
    for i, line in enumerate(lines):
        record = from_line(line)
        path.write_bytes(b"".join(lines[:i] + lines[i + 1 :]))
        found = faults(run)
        if isinstance(record, EvalRecord | LossRecord):
            assert any("lacks" in text for text in found), record
        path.write_bytes(b"".join([*lines[:i], line.replace(b"1", b"2"), *lines[i + 1 :]]))
        if line.replace(b"1", b"2") != line:
            assert f"results.jsonl:{i + 1}: " in faults(run)[0]


def test_a_changed_summary_is_found(run):
    file = run / "results.json"
    values = json.loads(file.read_text())
    values["metrics"]["final_success"]["value"] += 0.1
    file.write_text(json.dumps(values))
    assert "is not what results.jsonl gives (metrics)" in faults(run)[0]
    for text in ("{", "[]", "null", "[" * 100_000):
        file.write_text(text)
        assert "results.json is broken" in faults(run)[0]
    file.unlink()
    assert "results.json is missing" in faults(run)[0]


@pytest.mark.parametrize("content", [b"", b"\x00\xff", b"- a\n", b"a: ["])
def test_a_broken_configuration_is_found(run, content):
    (run / "config.yaml").write_bytes(content)
    assert any("config.yaml" in text for text in faults(run))


def test_what_is_left_over_is_noted(run):
    folder = run / "checkpoints"
    for name in (".x.1234.part", "task_0.safetensors.broken"):
        (folder / name).touch()
    assert not faults(run) and len(notes(run)) == 2
    (folder / "task_0.safetensors").unlink()
    assert "task_1" in faults(run)[0] and "it needs task_0.safetensors beside it" in faults(run)[0]
    (folder / "task_1.safetensors").unlink()
    assert "no checkpoints after tasks 0, 1" in faults(run)[0]
    (run / "eval").mkdir()
    (run / "eval" / "eval.json").write_text("{}")
    assert any("eval.json" in text for text in faults(run))


def test_a_folder_without_runs_is_named(tmp_path, capsys):
    assert main(["check", str(tmp_path)]) == 2
    assert "no run directory" in capsys.readouterr().err
    (tmp_path / "results.jsonl").touch()
    assert faults(tmp_path)


def test_cells_that_a_sample_leaves_out_are_not_missed(tmp_path):
    log = ResultLog(tmp_path / "results.jsonl")
    log.append(run_start("abcd", cells="sampled", cells_share=0.4))
    for row in range(4):
        for task in measured_tasks("sampled", [row], 4, 0.4):
            log.append(evaluation("matrix", row, 0, task, 2))
        log.append(TaskEndRecord(task=row, best_epoch=0, seconds=1.0))
    assert not [text for text in faults(tmp_path) if "lacks evaluations" in text]
