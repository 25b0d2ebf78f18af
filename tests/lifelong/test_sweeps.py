"""What is kept of the jobs of a sweep, and how it goes on."""

import json
import os
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from filelock import FileLock
from hydra.errors import MissingConfigException

from libero_cli.main import main
from libero_env.errors import MissingPackageError
from lifelong import sweeps
from lifelong.composition import config_folder, explained
from lifelong.errors import ConfigError, ResultsError, RunLockedError
from lifelong.sweeps import (
    JobRecord,
    begin_sweep,
    find_sweeps,
    job_suffix,
    read_job,
    read_sweep,
    run_job,
    status_lines,
    sweep_name,
)


def job(number: int = 0, key: str = "k", **changes) -> JobRecord:
    return replace(JobRecord(number, key, ("algo=er", f"seed={number}"), "running"), **changes)


def learned(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text("{}")
    return folder


def told(error: BaseException) -> tuple[int, str]:
    return 2, str(error)


def file_of(folder: Path, number: int = 0) -> Path:
    return folder / "jobs" / str(number) / "job.json"


def done(folder: Path, number: int, run: Path) -> JobRecord:
    """Run a job that learns at once."""
    return run_job(file_of(folder, number), job(number), lambda: learned(run), told)


def test_a_job_that_is_done_is_not_run_again(tmp_path) -> None:
    ran = []

    def learn() -> Path:
        ran.append(1)
        return learned(tmp_path / "run")

    file = file_of(tmp_path)
    record = run_job(file, job(), learn, told)
    assert record == read_job(file) and record.is_finished
    assert record.run == str(tmp_path / "run")
    assert run_job(file, job(), learn, told) == record and len(ran) == 1
    run_job(file, job(key="other configuration"), learn, told)
    assert len(ran) == 2, "another configuration is another job"
    run_job(file_of(tmp_path, 1), job(1), learn, told)
    run_job(file_of(tmp_path, 1), job(1), learn, told, again=True)
    assert len(ran) == 4, "other processes are not left alone"
    del ran[2:]
    (tmp_path / "run" / "results.json").unlink()
    run_job(file, job(key="other configuration"), learn, told)
    assert len(ran) == 3, "a run that is gone is made again"


def test_an_error_is_kept_with_its_status_and_the_job_is_tried_again(tmp_path) -> None:
    def fail() -> Path:
        raise ConfigError("train.lr is -1")

    failed = run_job(file_of(tmp_path), job(), fail, told)
    assert (failed.status, failed.exit_status, failed.error) == ("failed", 2, "train.lr is -1")
    begin_sweep(tmp_path, ["algo=er"], 1)
    assert read_sweep(tmp_path).exit_status == 2
    done(tmp_path, 0, tmp_path / "run")
    assert read_sweep(tmp_path).exit_status == 0


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit])
def test_an_interruption_is_kept_and_goes_on_up(tmp_path, kind) -> None:
    def interrupted() -> Path:
        assert read_job(file_of(tmp_path)).status == "running", "it is known while it runs"
        raise kind

    with pytest.raises(kind):
        run_job(file_of(tmp_path), job(), interrupted, told)
    assert read_job(file_of(tmp_path)).status == "interrupted"


def test_a_run_that_another_process_writes_is_waited_for(tmp_path, monkeypatch, capsys) -> None:
    tries = []
    monkeypatch.setattr(sweeps, "_POLL", 0.0)

    def learn() -> Path:
        tries.append(1)
        if len(tries) < 3:
            raise RunLockedError("another process is writing to runs/x")
        return learned(tmp_path / "run")

    assert run_job(file_of(tmp_path), job(), learn, told).status == "done"
    assert capsys.readouterr().out.count("waiting for it") == 1


def test_a_sweep_is_done_when_all_that_was_asked_for_is(tmp_path) -> None:
    begin_sweep(tmp_path, ["algo=er", "seed=1,2,3"], 3)
    done(tmp_path, 2, tmp_path / "other")
    for _ in range(2):  # another command in the same folder, and the same again
        begin_sweep(tmp_path, ["algo=er", "seed=0,1,2"], 3)
    for number in (0, 1):
        done(tmp_path, number, tmp_path / f"r{number}")
    sweep = read_sweep(tmp_path)
    assert (sweep.missing, sweep.exit_status, len(sweep.runs)) == (1, 1, 2)
    done(tmp_path, 2, tmp_path / "r2")
    begin_sweep(tmp_path, ["algo=er", "seed=0,1,2"], 3)
    sweep = read_sweep(tmp_path)
    assert (sweep.missing, sweep.exit_status, [j.number for j in sweep.jobs]) == (0, 0, [0, 1, 2])
    begin_sweep(tmp_path, ["hydra/sweeper=optuna"], None)
    done(tmp_path, 7, tmp_path / "r7")
    assert len(read_sweep(tmp_path).jobs) == 1, "a sweeper that chooses as it goes has no plan"


def test_the_status_names_what_runs_failed_was_lost_and_is_left(tmp_path, capsys) -> None:
    begin_sweep(tmp_path / "sweep" / "algo-1", ["algo=er"], 6)
    folder = tmp_path / "sweep" / "algo-1"
    done(folder, 0, tmp_path / "r0")
    sweeps._write(file_of(folder, 1), job(1))
    sweeps._write(file_of(folder, 2), job(2, process="node7:3"))  # whose lock nobody has
    sweeps._write(file_of(folder, 3), job(3, status="failed", error="no memory", exit_status=2))
    old = {"host": "node7", "pid": 3, "metrics": {"auc": 0.5}}  # of an earlier version
    file_of(folder, 4).parent.mkdir()
    file_of(folder, 4).write_text(json.dumps(asdict(job(4, status="interrupted")) | old))
    with FileLock(file_of(folder, 1).with_suffix(".lock")):
        lines = list(status_lines(read_sweep(folder)))
        assert main(["sweep", "status", str(tmp_path)]) == 0
    assert lines[0].endswith("1 done, 1 running, 1 failed, 1 interrupted, 1 lost, 1 not begun of 6 jobs")
    text = "\n".join(lines)
    assert "no memory" in text and f":{os.getpid()})" in text and "(node7:3)" in text
    assert capsys.readouterr().out.strip() == text
    assert find_sweeps(folder) == find_sweeps(tmp_path / "sweep") == find_sweeps(tmp_path) == [folder]
    assert main(["sweep", "status", str(tmp_path / "r0")]) == 2
    assert "holds no sweep" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "{", "[]", '{"number": 0}', '{"number": "x", "status": "odd"}'])
def test_a_broken_record_is_named(tmp_path, text) -> None:
    begin_sweep(tmp_path, [], 1)
    file = file_of(tmp_path)
    file.parent.mkdir(parents=True)
    file.write_text(text)
    with pytest.raises(ResultsError, match="job.json"):
        read_sweep(tmp_path)


def test_the_same_command_has_the_same_folder() -> None:
    words = ["algo=er,ewc", "seed=1,2"]
    assert sweep_name(words, ["algo", "seed"]) == sweep_name(list(words), ["algo", "seed"])
    assert sweep_name(words, ["algo", "seed"]).startswith("algo_seed-")
    assert sweep_name([*words, "train.lr=1"], ["algo", "seed"]) != sweep_name(words, ["algo", "seed"])
    assert "/" not in sweep_name(["policy/head=gmm,mse"], ["policy/head"])


@pytest.mark.parametrize(("own", "suffix"), [
    ({"seed": "1", "algo": "er", "policy": "bc_mlp", "benchmark": "libero_goal"}, ""),
    ({"train.lr": "0.001", "seed": "1"}, "lr0.001"),
    ({"train.epochs": "20", "algo/estimator": "batch"}, "estimator-batch_epochs20"),
    ({"a.x": "1", "b.x": "2"}, "a.x1_b.x2"),
    ({"benchmark.tasks": "[0,4,7]", "hydra.launcher.n_jobs": "2"}, "tasks-0-4-7"),
    ({"+algo.note": "a/b\\c d"}, "note-a-b-c-d"),
    ({"eval.shift": "{light:0.5}", "train.lr": "0.001"}, "lr0.001"),
])  # fmt: skip
def test_runs_of_a_sweep_are_named_by_what_tells_them_apart(own, suffix) -> None:
    assert job_suffix(own) == suffix


def test_the_names_of_long_values_differ() -> None:
    names = [job_suffix({"init_from": "runs/" + "x" * 80 + end}) for end in ("1", "2")]
    assert len(set(names)) == 2 and max(map(len, names)) <= 60


def test_a_launcher_whose_plug_in_is_missing_is_named(monkeypatch) -> None:
    launchers = {file.stem for file in (config_folder() / "hydra" / "launcher").glob("*.yaml")}
    assert launchers == {"workstation", "cluster", "ray_cluster"}
    monkeypatch.setattr("libero_env.errors.find_spec", lambda name: None)
    for launcher, extra in (("joblib", "joblib"), ("submitit_slurm", "submitit"), ("ray", "ray")):
        refusal = MissingConfigException("not found", f"hydra/launcher/{launcher}")
        with pytest.raises(MissingPackageError, match=rf"libero-lifelong\[{extra}\]"):
            explained(refusal, [], [config_folder()])
