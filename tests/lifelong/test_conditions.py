"""What decides the bits of a run is recorded; a resume under other conditions takes the old ones over or says so."""

from dataclasses import replace

import pytest
import torch

from lifelong import experiment
from lifelong.report.runs import load_run
from lifelong.results import provenance
from lifelong.results.log import ResultLog
from lifelong.results.provenance import (
    changed_conditions,
    present_conditions,
    recorded_threads,
    resume_notes,
    source_digest,
)
from lifelong.results.records import DemonstrationsRecord, from_line, to_line
from lifelong.settings import BenchmarkSettings, RunSettings
from tests.harness.records import run_start

START = run_start(["a"], conditions=present_conditions(torch.device("cpu"), renderer="llvmpipe"))
NAMED = {"seed": 1, "device": "cpu", "threads": 0, "runs_dir": "runs", "resume": True, "deterministic": False}
SETTINGS = RunSettings(**NAMED, run_id=None, progress=None, init_from=None)


def test_paths_of_the_configuration_may_begin_in_the_home_folder(monkeypatch):
    monkeypatch.setenv("HOME", "/home/a")
    settings = replace(SETTINGS, runs_dir="~/runs", init_from="~/runs/base")
    assert (settings.runs_dir, settings.init_from) == ("/home/a/runs", "/home/a/runs/base")
    benchmark = BenchmarkSettings(suite="own", files=["~/a.yaml", "b~.yaml"])
    assert list(benchmark.files) == ["/home/a/a.yaml", "b~.yaml"]


def changed(**conditions: str):
    return replace(START, conditions={**START.conditions, **conditions}, started="2026-01-02T03:04:05+00:00")


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield before
    torch.set_num_threads(before)


def write(folder, *starts):
    log = ResultLog(folder / "results.jsonl")
    for start in starts:
        log.append(start)
    return log


def test_the_conditions_name_what_decides_sums():
    found = START.conditions
    assert found["threads"] == str(torch.get_num_threads()) and found["device"] == "cpu"
    assert found["instruction_set"] == torch.backends.cpu.get_cpu_capability()
    assert found["processor"] and found["blas"] and found["renderer"] == "llvmpipe"
    assert from_line(to_line(START).rstrip()) == START


def test_a_resume_under_other_conditions_is_told(tmp_path):
    newer = changed(threads="64", source="0" * 12)  # and a task file that was edited meanwhile
    newer = replace(newer, versions={**START.versions, "torch": "9.9"}, instructions=("other words",))
    found = changed_conditions(START, newer)
    assert found == [
        f"instruction {START.instructions[0]!r} -> 'other words'",
        f"threads {START.conditions['threads']} -> 64",
        f"source {START.conditions['source']} -> {'0' * 12}",
        f"torch {START.versions['torch']} -> 9.9",
    ]
    (note,) = resume_notes(write(tmp_path, START, START, newer).read())
    assert note.startswith("Resumed 2026-01-02 03:04:05 UTC under other conditions (instruction")
    assert "bits differ" in note and note in load_run(tmp_path).notes, "the report shows it"


def test_a_resume_with_other_demonstrations_is_told(tmp_path):
    first = DemonstrationsRecord(counts=(50,), generators=("expert-1",), digests=("aa",))
    for other in (replace(first, digests=("bb",)), replace(first, counts=(10,))):
        folder = tmp_path / f"{other.counts}"
        log = write(folder, START, first, START, first, START, other, START, first)
        assert log.read().problems == ResultLog(log.path).read().problems == (), (
            "a record may be as an earlier one"
        )
        assert log.read().demonstrations == first
        notes = resume_notes(log.read())
        assert len(notes) == 2 and notes[0].startswith("Resumed with other demonstrations than before of a: ")
        assert notes[0] in load_run(folder).notes, "the report shows it"


def test_a_resumed_run_takes_over_the_threads_that_it_was_started_with(tmp_path, threads, capsys):
    run = write(tmp_path, changed(threads=str(threads + 1))).path.parent
    with experiment._threads(SETTINGS, run):
        assert torch.get_num_threads() == threads + 1
    assert torch.get_num_threads() == threads
    assert f"threads={threads + 1}, as when this run was started" in capsys.readouterr().out


@pytest.mark.parametrize("settings", [{"threads": 3}, {"resume": False}])
def test_threads_that_are_named_and_new_runs_take_nothing_over(settings, tmp_path, threads):
    run = write(tmp_path, changed(threads="7")).path.parent
    with experiment._threads(replace(SETTINGS, **settings), run):
        assert torch.get_num_threads() == settings.get("threads", threads)


@pytest.mark.parametrize("recorded", ["", "0", "-1", "two", "99999999999"])
def test_nonsense_in_a_record_is_no_number_of_threads(recorded, tmp_path):
    assert recorded_threads(write(tmp_path, changed(threads=recorded)).read()) is None


def test_the_digest_of_the_source_changes_with_any_constant(tmp_path, monkeypatch):
    for package in ("libero_env", "lifelong"):
        (tmp_path / package).mkdir()
    constant = tmp_path / "libero_env" / "timing.py"
    digests = set()
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    for text in ("TIMESTEP = 0.002\n", "TIMESTEP = 0.004\n"):
        constant.write_text(text)
        source_digest.cache_clear()
        digests.add(source_digest())
    source_digest.cache_clear()
    assert len(digests) == 2
