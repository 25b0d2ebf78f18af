"""Steps until a forgotten task is back: the measurement, its records, and what reports say."""

import copy
import os
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from libero_env.tasks import get_task
from libero_eval import relearning
from libero_eval.cli import runs
from libero_eval.relearning import Trial, error_on, failure_share, relearn, steps_until
from libero_eval.requests import DiagnoseRequest, RelearnRequest
from lifelong import pretraining
from lifelong.algorithms import Sequential
from lifelong.checkpoints import load
from lifelong.data.settings import DataSettings
from lifelong.errors import CheckpointError, ConfigError, DataError, LifelongError
from lifelong.evaluation.restore import LoadedRun
from lifelong.evaluation.settings import EvalSettings
from lifelong.report.page import write_report
from lifelong.results.log import ResultLog
from lifelong.results.records import RelearnRecord, from_line, to_line
from lifelong.results.relearning import FILE_NAME, by_measure, read_relearning, savings, savings_table
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from lifelong.types import Batch
from tests.harness.fakes import LinearPolicy, Windows
from tests.harness.policies import small_transformer
from tests.harness.records import run_start
from tests.harness.sequences import SPEC, dataset, run_context, sequence

FIT = FitSettings(epochs=1, batch_size=10, lr=0.05, warmup_steps=5, weight_decay=0.0, precision="fp32")
SETTINGS = RelearnRequest(run=Path(), steps=200, every=5, tolerance=0.05, held_out=1)


def tables(records) -> str:
    return "\n\n".join(str(savings_table(part)) for part in by_measure(records))


class Linear(LinearPolicy):
    statistics = "constants"

    def meet_task(self, dataset, instruction):
        assert (dataset.task_id, instruction) in enumerate("abc")

    def predict(self, batch):
        return self.linear(batch.observation.proprio["x"])


def policy(seed: int = 0) -> Linear:
    torch.manual_seed(seed)
    return Linear()


def learned(found: Linear, task: int, steps: int = 120) -> Linear:
    fit(found, Windows(task), Sequential(), settings=replace(FIT, steps_per_epoch=steps), seed=(task,))
    return found


def held_out(task: int = 0) -> Batch:
    return Windows(task).batch(torch.arange(20))


def again(found: Linear, error: float, settings: RelearnRequest = SETTINGS):
    """Relearn a task that counts as back at an error of at most 1.05 times the given one."""
    goal = Trial(0, Windows(0), partial(error_on, batch=held_out()), 1.05 * error)
    return steps_until(found, goal, request=settings, fit_settings=FIT, seed=(1, 5, 0))


def test_a_task_is_back_at_the_first_measurement_within_the_tolerance() -> None:
    then = error_on(learned(policy(), 0), held_out())
    forgotten = learned(learned(policy(), 0), 1)
    steps, errors = again(forgotten, then)
    assert errors[0] > 1.05 * then, "it was forgotten"
    assert errors[-1] <= 1.05 * then and all(error > 1.05 * then for error in errors[:-1])
    assert steps == list(range(0, steps[-1] + 1, 5)) and 0 < steps[-1] < 200
    assert error_on(forgotten, held_out()) == errors[-1], "training ended there"


def test_what_is_not_forgotten_needs_no_step() -> None:
    kept = learned(policy(), 0)
    before = copy.deepcopy(kept.state_dict())
    assert again(kept, error_on(kept, held_out()))[0] == [0]
    assert all(torch.equal(value, before[name]) for name, value in kept.state_dict().items())


def test_what_does_not_come_back_is_given_up() -> None:
    steps, errors = again(policy(), 0.0, replace(SETTINGS, steps=12))
    assert steps == [0, 5, 10, 15] and errors[-1] > 0


def test_the_same_call_gives_the_same_bits_and_touches_no_generator() -> None:
    assert again(policy(1), 0.3) == again(policy(1), 0.3)
    found, state = policy(1), torch.random.get_rng_state()
    again(found, 0.3)
    assert torch.equal(torch.random.get_rng_state(), state)


def test_the_error_is_the_mean_absolute_one_and_the_mode_stays() -> None:
    found, batch = policy(), Windows(0, size=300).batch(torch.arange(300))
    expected = (found.predict(batch) - batch.actions).abs().mean().item()
    assert error_on(found.train(), batch) == pytest.approx(expected, rel=1e-6)
    assert found.training


# --- records


def record(
    task: int, start: str, errors: tuple[float, ...], then: float = 0.1, rate: float = 1e-3, episodes: int = 0
) -> RelearnRecord:
    counts = {
        "steps": tuple(range(0, 10 * len(errors), 10)),
        "held_out": 5 * (not episodes),
        "episodes": episodes,
    }
    values = {"learned_error": then, "tolerance": 0.05, "rate": rate, "errors": errors, "seconds": 1.0}
    return RelearnRecord(task=task, start=start, **values, **counts)


def test_savings_pair_the_starts_of_each_task() -> None:
    records = [
        record(0, "initial", (0.5, 0.4, 0.3, 0.2, 0.1)),
        record(0, "final", (0.3, 0.1)),
        record(1, "initial", (0.5, 0.1)),
        record(1, "final", (0.3, 0.2, 0.1)),
        record(2, "final", (0.1,)),
        record(2, "initial", (0.5, 0.1), rate=1e-4),  # under other conditions
        record(3, "final", (0.3, 0.2)),
        record(3, "initial", (0.5, 0.1)),
        record(4, "initial", (0.5, 0.1)),
        record(5, "initial", (0.5, 0.4, 0.3)),  # tried for longer than the other
        record(5, "final", (0.3, 0.2)),
    ]
    (records,) = by_measure(records)
    found = savings(records)
    assert [(s.task, s.again, s.first, s.share) for s in found] == [
        (0, 10, 40, 0.75), (1, 20, 10, -1.0), (2, 0, None, None), (3, None, 10, None),
        (5, None, None, None),
    ]  # fmt: skip
    assert savings_table(records).rows[0] == (1, "0.100", "0.300", "10", "40", "75 %", "10 steps")
    assert savings_table(records).rows[2][3:] == ("0", "–", "–", "–"), "the first was not measured"
    assert savings_table(records).rows[3][3:] == ("> 10", "10", "–", "10 steps")
    assert savings_table(records).rows[4][3:] == ("> 10", "> 20", "–", "10 steps")
    assert tables(records).count("\n") == 5
    for odd in ({"learned_error": 0.2}, {"steps": (0, 50)}):  # of other demonstrations, measured less often
        last = replace(record(0, "final", (0.3, 0.1)), **odd)
        assert savings_table([*records, last]).rows[0][4:6] == ("–", "–")


def test_settings_and_initial_weights_do_not_share_a_table() -> None:
    final = record(0, "final", (0.3, 0.1))
    initial = replace(record(0, "initial", (0.5, 0.1)), weights="0123456789abcdef")
    loose = [replace(r, tolerance=1.0, errors=(0.15,), steps=(0,)) for r in (final, initial)]
    other = replace(record(0, "initial", (0.6, 0.5, 0.1)), weights="fedcba9876543210")
    parts = by_measure([final, initial, *loose, other])
    assert [(s.again, s.first) for part in parts for s in savings(part)] == [(10, 10), (10, 20), (0, 0)]
    text = tables([final, initial, *loose, other])
    assert text.count("steps again (tolerance 0.05, 5 held out)") == 2
    assert text.count("steps again (tolerance 1, 5 held out)") == 1
    assert text.count("(weights 01234567)") == 2 and text.count("(weights fedcba98)") == 1


def test_records_are_read_back_and_refuse_what_does_not_fit(tmp_path) -> None:
    found = record(3, "final", (0.3, 0.2))
    assert from_line(to_line(found)) == found and found.needed is None
    assert record(3, "final", (0.3, 0.105)).needed == 10, "within the tolerance"
    with pytest.raises(ValueError, match="2 steps have 1 errors"):
        replace(found, errors=(0.3,))
    assert read_relearning(tmp_path) == []


def test_success_is_back_where_it_falls_short_by_the_tolerance_at_most() -> None:
    def needed(then: float, *errors: float) -> int | None:
        return record(0, "final", errors, then=then, episodes=20).needed

    assert needed(0.1, 1.0, 0.15) == 10, "17 of 20 where it was 18"
    assert needed(0.1, 1.0, 0.2) is None
    assert needed(0.0, 1.0, 0.05) == 10, "a task without failures is back, too"
    found = [record(0, "final", (0.9, 0.1), episodes=20), record(0, "initial", (1.0, 0.5, 0.1), episodes=20)]
    assert savings_table(found).rows == [(1, "90 %", "10 %", "10", "20", "50 %", "10 steps")]
    text = tables([record(0, "final", (0.3, 0.1)), *found])
    assert text.index("error just learned") < text.index("success just learned")
    (part,) = by_measure([record(0, "initial", (0.1,)), found[0]])
    assert [s.first for s in savings(part)] == [None], "measures do not mix"


def test_the_page_of_a_run_shows_them_and_its_records_stay(tmp_path) -> None:
    ResultLog(tmp_path / "results.jsonl").append(run_start(["a", "b"]))
    before = (tmp_path / "results.jsonl").read_bytes()
    assert "Relearning" not in write_report([tmp_path]).read_text(encoding="utf-8")
    log = ResultLog(tmp_path / FILE_NAME)
    log.append(record(0, "final", (0.3, 0.1)))
    log.append(record(0, "initial", (0.5, 0.4, 0.1)))
    log.append(record(0, "final", (0.75, 0.1), episodes=20))
    page = write_report([tmp_path]).read_text(encoding="utf-8")
    assert ">Relearning</h2>" in page and "50 %" in page
    assert "Error at the end" in page and "Success at the end" in page and "25 %" in page
    assert (tmp_path / "results.jsonl").read_bytes() == before


# --- the whole measurement


def test_rollouts_are_those_of_the_run(monkeypatch) -> None:
    called = {}

    def rollout(found, env, states, **settings):
        called.update(settings, policy=found, env=env, states=list(states))
        return SimpleNamespace(rate=0.75, failed={})

    words = {"learned_task": "task {}".format, "embed": "TASK {}".format, "seed": 9, "device": "cpu"}
    run = SimpleNamespace(eval=SimpleNamespace(horizon=70, settle_steps=3, precision="fp32"), **words)
    monkeypatch.setattr(relearning, "rollout", rollout)
    assert failure_share("policy", run, 2, "env", 4) == 0.25
    wanted = {"policy": "policy", "env": "env", "states": [0, 1, 2, 3], "language": "TASK 2"}
    assert called.items() >= (wanted | vars(run.eval)).items()


@pytest.fixture
def finished(tmp_path, monkeypatch):
    """A finished run of three tasks: its folder, and the policies it would be restored with."""
    ends = [learned(policy(), 0)]
    for task in (1, 2):
        ends.append(learned(copy.deepcopy(ends[-1]), task))

    def restore(path: Path, *, after: int | None = None, **_):
        end = ends[-1 if after is None else after]
        return SimpleNamespace(
            path=path,
            tasks=("a", "b", "c"),
            learned=len(ends) - 1,
            stages=((0,), (1,), (2,)),
            acting=lambda task: nullcontext(end),
            device=torch.device("cpu"),
            seed=1,
            data=SimpleNamespace(statistics=None),
            learned_task=lambda task: SimpleNamespace(language="abc"[task]),
        )

    def read_config(*_):
        return SimpleNamespace(build={"train": FIT}.get, values={"train": {}})

    monkeypatch.setattr(relearning, "restore", restore)
    monkeypatch.setattr(relearning, "read_config", read_config)
    monkeypatch.setattr(relearning, "task_windows", lambda run, task, *_: (Windows(task), held_out(task)))
    monkeypatch.setattr(relearning, "stage_windows", lambda *_: {task: Windows(task) for task in range(3)})
    return tmp_path, ends


def outcome(path: Path) -> list[RelearnRecord]:
    return [replace(r, seconds=0.0) for r in read_relearning(path)]


def test_a_killed_measurement_goes_on_and_changes_nothing_else(finished, monkeypatch) -> None:
    folder, ends = finished
    before = copy.deepcopy([end.state_dict() for end in ends])
    for part in ("whole", "killed"):
        (folder / part).mkdir()
    relearn(replace(SETTINGS, run=folder / "whole"), policy())
    assert [(r.task, r.start) for r in outcome(folder / "whole")] == [
        (task, start) for task in (0, 1) for start in ("final", "initial")
    ]
    for kept in (0, 1, 3):
        with monkeypatch.context() as patch:
            left, append = [kept - len(outcome(folder / "killed"))], ResultLog.append

            def guarded(log, found, left=left, append=append) -> None:
                if not left[0]:
                    raise KeyboardInterrupt
                left[0] -= 1
                append(log, found)

            patch.setattr(ResultLog, "append", guarded)
            with pytest.raises(KeyboardInterrupt):
                relearn(replace(SETTINGS, run=folder / "killed"), policy())
    relearn(replace(SETTINGS, run=folder / "killed"), policy())
    assert outcome(folder / "killed") == outcome(folder / "whole")
    relearn(replace(SETTINGS, run=folder / "killed"), policy())
    assert len(outcome(folder / "killed")) == 4, "nothing is measured twice"
    relearn(replace(SETTINGS, run=folder / "killed", tolerance=0.2, tasks=(0,)), policy())
    assert len(outcome(folder / "killed")) == 6, "under other settings it is"
    for end, state in zip(ends, before, strict=True):
        assert all(torch.equal(value, state[name]) for name, value in end.state_dict().items())


def test_the_command_prints_what_it_is_asked_for(finished, monkeypatch) -> None:
    """Other settings, and other initial weights, have been measured before."""
    folder, _ = finished
    monkeypatch.setattr(
        "lifelong.pretraining.initial_policy", lambda run, *, weights, allow: policy(bool(weights))
    )
    monkeypatch.setattr("lifelong.report.page.write_report", lambda runs: runs[0])

    def said(**changes) -> str:
        return runs.relearn(replace(SETTINGS, run=folder, tasks=(0,), steps=10, **changes)).text

    asked = [{}, {"tolerance": 1.0}, {"initial": Path("other")}, {"every": 2}]
    found = [said(**one) for one in asked]
    assert len({*found}) == 4 and len(outcome(folder)) == 7
    assert [said(**one) for one in asked] == found and len(outcome(folder)) == 7, "all of it was recorded"


@pytest.mark.parametrize("kind", ["first", "latest", "seen", "stream"])
def test_initial_weights_are_normalised_as_the_run_was_when_it_met_the_task(
    tmp_path, kind, monkeypatch
) -> None:
    def context():
        made = run_context(tmp_path, "sequential")
        policy = small_transformer(replace(SPEC, measured=True))
        data = replace(made.data, statistics=kind, proprio=("joint_states",))
        few = EvalSettings(
            episodes=1, curve="none", select="last", cells="diagonal", horizon=2, precision="fp32"
        )
        return replace(made, policy=policy, data=data, eval=few, fit=replace(made.fit, epochs=1))

    made = context()
    sequence(made).run()

    def restore(path: Path, *, after: int = 2, **_):
        policy, file = context().policy, made.directory.checkpoints.task_path(after)
        policy.load_state_dict(load(file)["policy"])
        return LoadedRun(
            tmp_path, file, tuple(made.tasks), after, policy, made.algorithm, made.eval, 1, made.device,
            SimpleNamespace(embed=lambda texts: made.languages), made.instructions, made.data,
        )  # fmt: skip

    files = list(map(Path, "abc"))

    def windows(paths, counts, spec, languages, *_):
        assert (paths, list(counts), spec.measured) == (files, [2, 2, 2], True)
        assert torch.equal(languages, made.languages)
        return {task: dataset(task) for task in range(3)}

    started, config = {}, SimpleNamespace(build={"train": made.fit, "data": made.data}.get, values={})

    def steps(policy, trial, **_):
        started.setdefault(trial.task, []).append(policy.proprio.scaling.centre_x.clone())
        return [0], [0.0]

    monkeypatch.setattr(relearning, "restore", restore)
    monkeypatch.setattr(relearning, "read_config", lambda *_: config)
    monkeypatch.setattr(relearning, "find_demos", lambda *_, **__: files)
    monkeypatch.setattr(relearning, "DemoDatasets", windows)
    held = partial(Batch.rows, rows=slice(0, 2))
    monkeypatch.setattr(
        relearning,
        "task_windows",
        lambda run, task, *_: (dataset(task), held(dataset(task).batch(torch.arange(8)))),
    )
    monkeypatch.setattr(relearning, "steps_until", steps)
    initial = context().policy
    relearn(replace(SETTINGS, run=tmp_path, tasks=(0, 1)), initial)
    for task, (_, begun) in started.items():
        then = restore(tmp_path, after=task).policy.proprio.scaling.centre_x
        assert torch.equal(begun, then) and begun.any()
    assert list(started) == [0, 1] and not initial.proprio.scaling.taken


def test_runs_tasks_and_settings_that_cannot_be_measured_are_refused(finished, monkeypatch) -> None:
    folder, _ = finished
    with pytest.raises(LifelongError, match="has tasks 0 to 2; there is no task 7"):
        relearn(replace(SETTINGS, run=folder, tasks=(7,)), policy())
    for change in ({"every": 0}, {"steps": 0}, {"tolerance": -0.1}, {"held_out": 0}, {"episodes": 51}):
        with pytest.raises(ConfigError, match=f"relearn.{next(iter(change))} is"):
            RelearnRequest(run=folder, **change)
    (folder / "task_2.safetensors").touch()
    for request in (RelearnRequest, DiagnoseRequest):
        with pytest.raises(ConfigError, match=r"task_2.safetensors is a file; give the directory of the run"):
            request(run=folder / "task_2.safetensors")
    with pytest.raises(ConfigError, match="--held-out is of the error, and --episodes measures success"):
        RelearnRequest(run=folder, held_out=10, episodes=5)
    asked = (RelearnRequest(run=folder, episodes=n).demos_held_out for n in (0, 5))
    assert tuple(asked) == (5, 0)
    unfinished = SimpleNamespace(learned=0, tasks=("a", "b"))
    monkeypatch.setattr(relearning, "restore", lambda *_, **__: unfinished)
    with pytest.raises(LifelongError, match="is not finished: 1 of 2 tasks are learned"):
        relearn(replace(SETTINGS, run=folder), policy())


def test_demonstrations_are_asked_for_with_all_tasks_as_files_of_all_may_be_named(monkeypatch) -> None:
    class Asked(Exception):
        pass

    def find_demos(tasks, counts, data, progress, **_):
        raise Asked(list(tasks), list(counts))

    settings = DataSettings(demos=4, image_size=16, seq_len=1, views=("agentview_rgb",), proprio=())
    monkeypatch.setattr(relearning, "find_demos", find_demos)
    run = SimpleNamespace(tasks=("a", "b", "c"), group_sizes=(), data=settings)
    config = SimpleNamespace(values={})
    with pytest.raises(Asked) as asked:
        relearning.task_windows(run, 1, 2, config)
    assert asked.value.args == (["a", "b", "c"], [4, 6, 4])

    def few(*_, **__):
        raise DataError("a.hdf5 has 4 demonstrations and 6 are required")

    monkeypatch.setattr(relearning, "find_demos", few)
    with pytest.raises(DataError, match="6 are required.*; --held-out reads 2 demonstrations more than"):
        relearning.task_windows(run, 1, 2, config)


@pytest.fixture
def foreign(tmp_path) -> dict[str, Path]:
    """What a saved configuration may name in place of a file."""
    names = {kind: tmp_path / kind for kind in ("nothing", "folder", "pipe", "text", "link")}
    names["folder"].mkdir()
    os.mkfifo(names["pipe"])
    names["text"].write_text("text")
    names["link"].symlink_to(names["nothing"])
    return names | {"device": Path("/dev/zero")}


def test_whatever_is_wrong_with_demonstrations_that_a_run_names_the_option_for_others_is_named(
    foreign,
) -> None:
    wrong = [{"files": (str(path),)} for path in foreign.values()]
    wrong += [{"folder": str(path)} for kind, path in foreign.items()]
    for data in wrong:
        settings = DataSettings(
            demos=1, image_size=16, seq_len=1, views=("agentview_rgb",), proprio=(), **data
        )
        run = SimpleNamespace(tasks=(get_task("libero_goal/0"),), group_sizes=(), data=settings)
        with pytest.raises(DataError, match="--demos DIR"):
            relearning.task_windows(run, 0, 0, SimpleNamespace(values={}))


def test_whatever_is_wrong_with_the_weights_that_a_run_began_with_the_option_for_others_is_named(
    foreign, monkeypatch
) -> None:
    loaded = SimpleNamespace(policy=SimpleNamespace(spec=None), seed=1)
    monkeypatch.setattr(pretraining, "restore", lambda *_, **__: loaded)
    parts = {"pretrain": SimpleNamespace(sequence=lambda: ()), "policy": policy()}
    for path in foreign.values():
        config = SimpleNamespace(build=lambda name, **_: parts[name], values={"init_from": str(path)})
        monkeypatch.setattr(pretraining, "read_config", lambda *_, config=config: config)
        with pytest.raises(CheckpointError, match="by --initial"):
            pretraining.initial_policy(Path())
        with pytest.raises(CheckpointError, match="(?<!by --initial)$"):
            pretraining.initial_policy(Path(), weights=path)
