"""Whatever single file of a run is damaged or lost, the resumed run ends with the same records and weights."""

import shutil
from functools import cache
from pathlib import Path
from typing import ClassVar

import pytest

from lifelong import Algorithm, checkpoints
from lifelong.checkpoints import Weights
from lifelong.errors import CheckpointError
from lifelong.results.records import EvalRecord, LossRecord, from_line
from lifelong.results.run_directory import RunDirectory
from lifelong.sequence import TaskSequence, is_measured
from tests.harness import sequences
from tests.harness.sequences import ALGORITHMS, Killed, Killer, assert_same, outcome, run_context, sequence

# Writes of checkpoints and records after which the second of three tasks is being learned, or evaluated.
LEARNING, EVALUATING = 25, 30


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Records and last weights of an uninterrupted run of an algorithm."""

    @cache
    def run(algo: str):
        path = tmp_path_factory.mktemp(algo)
        context = run_context(path, algo)
        sequence(context).run()
        return outcome(path, context.directory.log)

    return run


def killed_run(path: Path, algo: str, monkeypatch, writes: int) -> RunDirectory:
    """A run that was killed at its given write of a checkpoint or a record."""
    with monkeypatch.context() as patch:
        context = run_context(path, algo)
        killer = Killer(patch, writes)
        patch.setattr(context.directory.log, "append", killer.guard(context.directory.log.append))
        with pytest.raises(Killed):
            sequence(context).run()
    return RunDirectory(path)


def assert_resumes(path: Path, algo: str, whole) -> None:
    context = run_context(path, algo)
    sequence(context).run()
    records, state = outcome(path, context.directory.log)
    assert records == whole(algo)[0]
    assert_same(state, whole(algo)[1])


def flip(file: Path) -> None:
    """Flip a bit in the middle of the tensors."""
    content = bytearray(file.read_bytes())
    content[len(content) * 2 // 3] ^= 4
    file.write_bytes(content)


def checkpoint_files(path: Path) -> list[str]:
    return sorted(f.name for f in (path / "checkpoints").iterdir())


@pytest.mark.parametrize(
    ("algo", "writes"), [("packnet", 30), ("packnet", 38), ("er", LEARNING), ("er", EVALUATING)]
)
def test_any_damaged_checkpoint_costs_time_never_bits(tmp_path, algo, writes, whole, monkeypatch, capsys):
    killed = tmp_path / "killed"
    killed_run(killed, algo, monkeypatch, writes)
    names = checkpoint_files(killed)
    assert {"task_0.safetensors", "progress.safetensors", "best.safetensors"} <= set(names)
    for name in names:
        path = tmp_path / name
        shutil.copytree(killed, path)
        flip(path / "checkpoints" / name)
        assert_resumes(path, algo, whole)
        printed = capsys.readouterr().out
        if (path / "checkpoints" / f"{name}.broken").exists():
            assert f"it is kept as {name}.broken" in printed
        shutil.rmtree(path)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_without_anything_intact_the_run_starts_again(tmp_path, algo, whole, monkeypatch):
    run = killed_run(tmp_path, algo, monkeypatch, LEARNING)
    for name in checkpoint_files(tmp_path):
        (run.checkpoints.path / name).write_bytes(b"\0" * 100)
    assert_resumes(tmp_path, algo, whole)
    assert (run.checkpoints.path / "progress.safetensors.broken").exists()


def test_a_broken_last_checkpoint_is_rebuilt_from_the_one_before(tmp_path, whole, capsys):
    sequence(run_context(tmp_path, "ewc")).run()
    folder = RunDirectory(tmp_path).checkpoints
    flip(folder.task_path(2))
    folder.progress_path.unlink()
    assert_resumes(tmp_path, "ewc", whole)
    assert "task_2.safetensors.broken" in capsys.readouterr().out


@pytest.mark.parametrize("algo", ["sequential", "packnet"])
def test_lost_lines_are_measured_again(tmp_path, algo, whole, monkeypatch):
    """A missing point of a curve is measured by learning its task again; a missing cell from its checkpoint."""
    killed_run(tmp_path / "killed", algo, monkeypatch, EVALUATING)
    lines = (tmp_path / "killed" / "results.jsonl").read_bytes().splitlines(keepends=True)
    kinds = [(i, from_line(line)) for i, line in enumerate(lines)]
    curve = [i for i, r in kinds if isinstance(r, EvalRecord) and r.phase == "curve"]
    matrix = [i for i, r in kinds if isinstance(r, EvalRecord) and r.phase == "matrix"]
    for lost in ({curve[1]}, {curve[-1]}, {matrix[0]}, set(range(len(lines)))):
        path = tmp_path / f"lost{len(lost)}_{min(lost)}"
        shutil.copytree(tmp_path / "killed", path)
        kept = [line for i, line in enumerate(lines) if i not in lost]
        (path / "results.jsonl").write_bytes(b"".join(kept))
        context = run_context(path, algo)
        sequence(context).run()
        records, state = outcome(path, context.directory.log)
        assert_same(state, whole(algo)[1])
        measured = {k: v for k, v in whole(algo)[0].items() if k[0] in ("eval", "task_end")}
        assert {k: v for k, v in records.items() if k[0] in ("eval", "task_end")} == measured


def test_a_lost_loss_costs_that_loss(tmp_path, whole):
    context = run_context(tmp_path, "sequential")
    sequence(context).run()
    lines = context.directory.log.path.read_bytes().splitlines(keepends=True)
    losses = [i for i, line in enumerate(lines) if isinstance(from_line(line), LossRecord)]
    context.directory.log.path.write_bytes(b"".join(line for i, line in enumerate(lines) if i != losses[0]))
    again = run_context(tmp_path, "sequential")
    sequence(again).run()
    assert len(again.directory.log.read().of(LossRecord)) == len(losses) - 1


def test_a_run_that_is_finished_but_lost_a_line_is_measured_again(tmp_path, whole):
    context = run_context(tmp_path, "sequential")
    sequence(context).run()
    assert is_measured(context, context.directory.log.read())
    content = context.directory.log.path.read_bytes()
    curve = next(line for line in content.splitlines() if b'"curve", "learned": 1, "epoch": 1' in line)
    context.directory.log.path.write_bytes(content.replace(curve, curve.replace(b"1", b"2")))
    again = run_context(tmp_path, "sequential")
    found = again.directory.log.read()
    assert not is_measured(again, found) and len(found.problems) == 1
    assert_resumes(tmp_path, "sequential", whole)
    assert is_measured(again, again.directory.log.read())


@pytest.mark.parametrize("damaged", [(), ("progress",), ("progress", "progress.previous")])
def test_what_comes_before_the_first_task_is_prepared_when_it_is_learned_from_its_start(
    tmp_path, damaged, monkeypatch
):
    """Such as pretraining: without it, a first task that is learned again would begin elsewhere."""
    folder = killed_run(tmp_path, "sequential", monkeypatch, 8).checkpoints
    for name in damaged:
        flip(folder.path / f"{name}.safetensors")
    prepared = []
    context = run_context(tmp_path, "sequential")
    data = {task: sequences.dataset(task) for task in range(3)}
    TaskSequence(context, data, prepare=lambda: prepared.append(1)).run()
    assert len(prepared) == (len(damaged) == 2)


def test_exchanged_checkpoints_are_named(tmp_path, monkeypatch):
    folder = killed_run(tmp_path, "sequential", monkeypatch, 40).checkpoints
    first, second = folder.task_path(0).read_bytes(), folder.task_path(1).read_bytes()
    folder.task_path(0).write_bytes(second)
    folder.task_path(1).write_bytes(first)
    for path in (folder.progress_path, folder.previous_path):
        path.unlink(missing_ok=True)
    with pytest.raises(CheckpointError, match=r"task_1\.safetensors was written after task 0"):
        sequence(run_context(tmp_path, "sequential")).run()


def test_checkpoints_of_another_run_are_named(tmp_path, monkeypatch):
    for seed in (1, 2):
        with RunDirectory(tmp_path / f"run{seed}").opened({"seed": seed, "runs_dir": "x"}, resume=True):
            killed_run(tmp_path / f"run{seed}", "sequential", monkeypatch, LEARNING)
    ours, theirs = (RunDirectory(tmp_path / name).checkpoints for name in ("run1", "run2"))
    shutil.copy(theirs.progress_path, ours.progress_path)
    with pytest.raises(CheckpointError, match=r"progress\.safetensors belongs to a run of another config"):
        sequence(run_context(tmp_path / "run1", "sequential")).run()


@pytest.mark.parametrize("other", ["er", "ewc", "packnet"])
def test_the_state_of_another_algorithm_is_named(tmp_path, other):
    sequence(run_context(tmp_path, other, tasks=1)).run()
    for algo in sorted({"sequential", "er", "ewc", "packnet"} - {other}):
        with pytest.raises(CheckpointError, match=r"task_0\.safetensors: the state of the .* does not fit"):
            sequence(run_context(tmp_path, algo, tasks=1)).run()


def test_equal_runs_write_equal_checkpoints(tmp_path):
    for name in ("a", "b"):
        sequence(run_context(tmp_path / name, "ewc", tasks=1)).run()
    assert len(checkpoint_files(tmp_path / "a")) > 2
    for name in checkpoint_files(tmp_path / "a"):
        files = [tmp_path / run / "checkpoints" / name for run in "ab"]
        assert files[0].read_bytes() == files[1].read_bytes(), name


def test_what_killed_writers_left_is_removed(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    for name in (".task_0.safetensors.1234abcd.part", "task_0.safetensors", "progress.part"):
        (folder / name).touch()
    with RunDirectory(tmp_path).opened({"seed": 1}, resume=True):
        assert checkpoint_files(tmp_path) == ["progress.part", "task_0.safetensors"]


def test_the_optimiser_of_another_policy_is_named(tmp_path, monkeypatch):
    folder = killed_run(tmp_path, "sequential", monkeypatch, 8).checkpoints
    state = checkpoints.load(folder.progress_path)
    assert state["fit"] is not None
    for odd in ({"state": {}, "param_groups": []}, {"state": {0: {}}, "param_groups": 1}, {}):
        checkpoints.save(folder.progress_path, state | {"fit": state["fit"] | {"optimizer": odd}})
        with pytest.raises(CheckpointError, match="optimi"):
            sequence(run_context(tmp_path, "sequential")).run()


class Forgetful(Algorithm):
    """Keeps what no checkpoint holds."""

    def __init__(self):
        self.anchor, self.seen, self._derived = None, [], None

    def end_task(self, task_index, dataset, policy, generator):
        self.anchor, self._derived = policy.state_dict(), object()
        self.seen.append(task_index)


class Anchored(Forgetful):
    state_form: ClassVar = {"anchor": Weights()}


class Careful(Forgetful):
    def state_dict(self):
        return {"weights": self.anchor or {}, "seen": self.seen}

    def load_state_dict(self, state, datasets):
        self.anchor, self.seen = state["weights"], state["seen"]


@pytest.mark.parametrize(
    ("algorithm", "lost"), [(Forgetful, "anchor, seen"), (Anchored, "seen"), (Careful, None)]
)
def test_what_no_checkpoint_holds_is_said_once(algorithm, lost, tmp_path, capsys):
    sequence(run_context(tmp_path, algorithm, tasks=2)).run()
    printed = capsys.readouterr().out
    assert printed.count("which no checkpoint holds") == (lost is not None)
    assert lost is None or f"warning: {algorithm.__name__} changes {lost}, which" in printed
