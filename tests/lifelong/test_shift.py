"""Perturbations in lifelong learning: streams whose tasks are perturbed more and more."""

import hashlib
import json
import threading
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from libero_cli.main import main
from libero_env.curating import rendering
from libero_env.curating.rendering import RenderJob, ensure_rendered
from libero_env.demos import generate as recording
from libero_env.demos.config import RenderConfig
from libero_env.demos.read import read_episodes
from libero_env.perturbations import parse_perturbations, reword_task
from libero_env.tasks import get_suite
from libero_eval import relearning
from libero_eval.requests import RelearnRequest
from lifelong import experiment
from lifelong.data import demonstrations
from lifelong.data.demonstrations import DemoDatasets
from lifelong.errors import ConfigError, DataError
from lifelong.evaluation.environments import held_out_shift
from lifelong.evaluation.restore import read_config, restore
from lifelong.language import LanguageEncoder, encoder
from lifelong.results.log import ResultLog
from lifelong.results.records import DemonstrationsRecord, from_line, signed_line, to_line
from lifelong.results.results import Results
from lifelong.results.shifts import shift_scores
from lifelong.sequence.learning import TaskSequence
from lifelong.settings import build
from lifelong.streams import StreamSettings
from tests.harness.configs import composed
from tests.harness.demos import record_wander
from tests.harness.records import evaluation, run_start
from tests.harness.runs import make_run

pytestmark = pytest.mark.usefixtures("uncounted")
TASKS = get_suite("libero_object").tasks[:2]
NAMES = {"policy": "tiny", "benchmark": "libero_object", "algo": "sequential", "preset": "smoke"}
TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "algo=sequential", "threads=1"),
    *("data.demos=2",
    "data.seq_len=2", "data.image_size=32", "train.epochs=1", "train.steps_per_epoch=1", "train.batch_size=2"),
    *("eval.horizon=3", "eval.episodes=2", "eval.curve_episodes=1", "eval.record_every=0", "eval.sim_threads=1"),
    *("policy.encoder.width=4", "policy.head.hidden=8", "train.warmup_steps=0", "progress=false", "augmentation=none"),
)  # fmt: skip
LOOKS = "instruction=0.6,light=0.8"


class Stop(BaseException):
    """Stands for a killed process."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Record two demonstrations of two tasks without an expert, where `data.folder` finds them."""
    root = tmp_path_factory.mktemp("demos")
    for task in TASKS:
        record_wander(root / task.suite / f"{task.name}_demo.hdf5", task, (32, 32))
    return root


@pytest.fixture
def quick(monkeypatch):
    """Embed any text without an encoder, and render in this process."""

    def embeddings(texts, cache_dir):
        seeds = [int(hashlib.sha256(text.encode()).hexdigest()[:8], 16) for text in texts]
        return torch.stack([torch.randn(384, generator=torch.Generator().manual_seed(s)) for s in seeds])

    monkeypatch.setattr(encoder, "_minilm", embeddings)
    monkeypatch.setattr(recording, "cpu_count", lambda: 1)


def run(folder: Path, home: Path, *overrides: str) -> Path:
    config = composed(*TINY, f"data.folder={folder}", f"runs_dir={home}", *overrides)
    return experiment.run(config, NAMES)


def outcomes(path: Path):
    """Return all records but their times and conditions, by key; a record that was made twice is the same."""
    kept = {}
    for record in ResultLog(path / "results.jsonl").read().records:
        if record.kind in ("run", "cost", "phase", "run_end"):
            continue
        values = {k: v for k, v in asdict(record).items() if k not in ("seconds", "decided_by")}
        key = tuple(values.get(k) for k in ("kind", "phase", "learned", "task", "epoch", "shift"))
        assert kept.setdefault(key, values) == values
    return kept


def test_severity_grows_in_equal_steps():
    stream = StreamSettings(perturb="light=1,camera=0.3", perturb_seed=4)
    found = stream.perturbations((1,) * 4)
    assert found[0] == () and found[3] == parse_perturbations("light=1,camera=0.3", seed=4)
    assert [[one.severity for one in task] for task in found[1:3]] == [[0.1, 0.3333], [0.2, 0.6667]]
    for task in found:
        assert parse_perturbations(",".join(map(str, task))) == task  # the text is exact
    grouped = stream.perturbations((2, 1, 1))
    assert grouped[0] == grouped[1] == () and [one.severity for one in grouped[2]] == [0.15, 0.5]
    assert StreamSettings().perturbations((1, 1)) == ((), ())


@pytest.mark.parametrize("dim", [None, 20])
def test_a_held_out_shift_does_not_reword_what_is_known_by_position(dim):
    embed, said = LanguageEncoder("onehot", dim=dim).embed, [task.language for task in TASKS]
    asked = (parse_perturbations("instruction=1"), TASKS, ((),) * len(TASKS), embed(said), None)
    with pytest.raises(ConfigError, match="eval.shift=instruction=1.*by their position"):
        held_out_shift(*asked, lambda words: embed([*said, *words])[len(said) :])


@pytest.mark.parametrize(
    ("text", "said"),
    [("robot=0.5", "changes what happens"), ("lihgt=1", "light"), ("light=2", "from 0 to 1")],
)
def test_what_cannot_be_a_shift_is_refused_in_one_line(text, said):
    with pytest.raises(ConfigError, match=f"stream.perturb is '{text}'.*{said}") as caught:
        StreamSettings(perturb=text)
    assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match="stream.perturb"):
        build(composed("stream=shift", f"stream.perturb='{text}'").stream)


def test_presets_and_mappings():
    kinds = {"shift": "light", "shift_camera": "camera", "shift_instruction": "instruction"}
    for name, kind in kinds.items():
        ((), (last,)) = build(composed(f"stream={name}").stream).perturbations((1, 1))
        assert (last.kind, last.severity) == (kind, 1.0)
    same = StreamSettings(perturb={"camera": 0.5, "light": 1}), StreamSettings(perturb="light=1,camera=0.5")
    assert same[0].perturbations((1, 1, 1)) == same[1].perturbations((1, 1, 1))


def test_a_run_has_perturbations_of_every_task_or_none():
    values = {key: value for key, value in asdict(run_start("t")).items() if key != "perturbed"}
    record = from_line(signed_line(values))
    assert record.perturbed == () and from_line(to_line(record)) == record
    with pytest.raises(ValueError, match="has 2 perturbations"):
        from_line(signed_line(values | {"perturbed": ["", ""]}))


@pytest.mark.sim
def test_rendered_demonstrations_are_made_once_and_again_when_they_are_outdated(
    folder, tmp_path, monkeypatch
):
    task, perturb = TASKS[0], parse_perturbations("light=0.5")
    source = folder / task.suite / f"{task.name}_demo.hdf5"
    own = tmp_path / source.name
    own.write_bytes(source.read_bytes())
    config = RenderConfig(size=(32, 32), perturb=perturb)
    first = RenderJob(own, task, 1, config)
    (path,) = ensure_rendered([first], workers=1, progress=False)
    assert path.parent.name == "under-light=0.5-32x32-fast" and path.parent.parent == own.parent
    assert len(list(read_episodes(path))) == 1
    before = path.stat().st_mtime_ns
    jobs = [RenderJob(own, task, 1, config), RenderJob(own, task, 1, RenderConfig(size=(32, 32)))]
    assert ensure_rendered(jobs, workers=1, progress=False) == [path, own]
    assert path.stat().st_mtime_ns == before

    ensure_rendered([RenderJob(own, task, 2, config)], workers=1, progress=False)  # goes on
    whole = {episode.name: episode.obs["agentview_rgb"] for episode in read_episodes(path)}
    (fresh,) = ensure_rendered([RenderJob(source, task, 2, config)], workers=2, progress=False)
    for episode in read_episodes(fresh):
        np.testing.assert_array_equal(whole[episode.name], episode.obs["agentview_rgb"])
    with h5py.File(own, "r+") as file:  # recorded again, with other states
        file["data/demo_0/states"][0, 1] += 0.01
    assert not RenderJob(own, task, 2, config).is_complete(2)
    ensure_rendered([RenderJob(own, task, 2, config)], workers=1, progress=False)
    new, same = read_episodes(path)
    assert (new.obs["agentview_rgb"][0] != whole["demo_0"][0]).any()
    np.testing.assert_array_equal(same.obs["agentview_rgb"], whole["demo_1"])
    for change in ("removed", "relabelled"):
        with h5py.File(own, "r+") as file:
            if change == "removed":
                del file["data/demo_1"]
            else:
                file["data/demo_0/expert_actions"][...] = 0.25
        assert not RenderJob(own, task, 1, config).is_complete(1), change
        ensure_rendered([RenderJob(own, task, 1, config)], workers=1, progress=False)
        (left,), (now,) = read_episodes(path), read_episodes(own)
        np.testing.assert_array_equal(left.labels, now.labels)


@pytest.mark.sim
def test_who_needs_a_file_that_is_being_rendered_waits_for_it(folder, monkeypatch):
    task, calls, render = TASKS[0], [], rendering.rerender
    config = RenderConfig(size=(32, 32), perturb="blur=0.5")
    job = RenderJob(folder / task.suite / f"{task.name}_demo.hdf5", task, 1, config)

    def slow(*args, **kwargs):
        calls.append(args)
        second.start()
        second.join(0.5)  # it does not get in
        assert second.is_alive()
        return render(*args, **kwargs)

    monkeypatch.setattr(rendering, "rerender", slow)
    found: list[Path] = []
    second = threading.Thread(target=lambda: found.extend(ensure_rendered([job], workers=1, progress=False)))
    assert ensure_rendered([job], workers=1, progress=False) == [job.path]
    second.join(60)
    assert len(calls) == 1 and found == [job.path]


def made_environments(monkeypatch) -> list:
    """Return a list that gets the key and the environment of each that a run makes."""
    seen, pool = [], experiment.EnvPool
    noted = lambda make: lambda key: seen.append((key, make(key))) or seen[-1][1]  # noqa: E731
    monkeypatch.setattr(experiment, "EnvPool", lambda make, size: pool(noted(make), size))
    return seen


@pytest.mark.sim
def test_each_task_is_learned_and_evaluated_under_its_own_perturbations(folder, tmp_path, quick, monkeypatch):
    seen, read = made_environments(monkeypatch), []
    opened = DemoDatasets.__getitem__
    watched = lambda self, k: read.append((k, self.paths[k], self.languages[k])) or opened(self, k)  # noqa: E731
    monkeypatch.setattr(DemoDatasets, "__getitem__", watched)
    stream = ("stream=shift", f"stream.perturb='{LOOKS}'", "stream.demos_later=1")
    path = run(folder, tmp_path, *stream)
    largest = parse_perturbations(LOOKS)
    words = [TASKS[0].language, reword_task(TASKS[1], largest).language]
    assert words[1] != TASKS[1].language
    for (task, _), env in seen:
        assert env.config.perturb == (largest if task else ()) and env.task.language == words[task]
    assert {task for (task, _), _ in seen} == {0, 1}
    embedded = encoder._minilm(words, None)
    for task, file, language in read:
        assert ("under-instruction=0.6,light=0.8" in str(file)) == bool(task)
        assert torch.equal(language, embedded[task])
    record = ResultLog(path / "results.jsonl").read().run
    assert record.instructions == tuple(words) and record.perturbed == ("", LOOKS)

    loaded = restore(path, device="cpu")
    assert loaded.tasks == TASKS and loaded.perturbations(1) == largest
    assert torch.equal(loaded.embed(loaded.learned_task(1)), embedded[1])
    plain = encoder._minilm([TASKS[1].language], None)[0]  # without the shift
    assert torch.equal(loaded.embed(TASKS[1]), plain)
    assert (path / "report.html").is_file()

    settings, config = RelearnRequest(run=path, held_out=1), read_config(path / "config.yaml", ())
    training, held_out = relearning.task_windows(loaded, 1, settings.held_out, config, folder)
    shifted = next(folder.rglob(f"under-instruction=0.6*/{TASKS[1].name}_demo.hdf5"))
    first, other = read_episodes(shifted)  # learned from, and held out
    assert len(training) == len(first) and len(held_out) == len(other)
    np.testing.assert_array_equal(held_out.observation.images[0, 0, 0], other.obs["agentview_rgb"][0])
    assert torch.equal(held_out.observation.language[0], embedded[1])

    def stop(self, *args):
        raise Stop

    killed = (folder, tmp_path / "killed", *stream)
    with monkeypatch.context() as patch:
        patch.setattr(TaskSequence, "_evaluate_seen_tasks", stop)
        with pytest.raises(Stop):
            run(*killed)
    assert outcomes(run(*killed)) == outcomes(path)


@pytest.mark.sim
def test_held_out_shifts_are_measured_besides(folder, tmp_path, quick, monkeypatch, capsys):
    """Also when a finished run is asked for them, to the same bits."""
    seen = made_environments(monkeypatch)
    stream, shift = ("stream=shift", f"stream.perturb='{LOOKS}'"), "eval.shift={robot:0.3,light:0.4}"
    plain = run(folder, tmp_path, *stream)
    before = outcomes(plain)
    assert not any(len(key) > 2 for key, _ in seen) and not any(key[1] == "shift" for key in before)
    numbers = json.loads((plain / "results.json").read_text())
    assert "shifts" not in numbers and ">Under " not in (plain / "report.html").read_text()
    assert run(folder, tmp_path, *stream, shift) == plain
    after = outcomes(plain)
    added = {key: r for key, r in after.items() if key not in before}
    assert {(r["phase"], r["learned"], r["task"]) for r in added.values()} == {
        ("shift", 0, 0), ("shift", 1, 0), ("shift", 1, 1)
    }  # fmt: skip
    assert {key: after[key] for key in before} == before
    text, matrix = "light=0.4,robot=0.3", [r for r in after.values() if r.get("phase") == "matrix"]
    for record in added.values():
        assert record["shift"] == text and record["init_states"] == matrix[0]["init_states"]
    words = reword_task(TASKS[1], parse_perturbations(LOOKS)).language
    under = {task: env for (task, *more), env in seen if more[1:]}
    assert under[0].config.perturb == parse_perturbations(text)
    assert under[1].config.perturb == parse_perturbations(f"{text},instruction=0.6")
    assert (under[0].task.language, under[1].task.language) == (TASKS[0].language, words)
    with_shifts = json.loads((plain / "results.json").read_text())
    assert [one["shift"] for one in with_shifts["shifts"]] == [text]
    for key in ("metrics", "success_matrix", "evaluations", "curves"):
        assert with_shifts[key] == numbers[key]
    assert f">Under {text}</h2>" in (plain / "report.html").read_text()
    capsys.readouterr()
    assert main(["report", str(plain)]) == 0 and f"under {text}: " in capsys.readouterr().out
    assert outcomes(run(folder, tmp_path / "both", *stream, shift)) == after
    with pytest.raises(ConfigError, match="know.* by their position"):
        run(folder, tmp_path / "onehot", "language=onehot", "eval.shift={instruction:0.5}")


def test_forgetting_under_shift_is_just_learned_minus_final():
    first = run_start(["a", "b"])
    matrix = [evaluation("matrix", *key) for key in ((0, 1, 0, 4), (1, 1, 0, 3), (1, 1, 1, 4))]
    keys = ((0, 1, 0, 3), (1, 1, 0, 0), (1, 1, 1, 2))
    shifted = [evaluation("shift", *key, shift="light=0.5") for key in keys]
    results = Results((first, *matrix, *shifted))
    assert Results((first, *matrix)).success_matrix()[0].tolist()[1] == [0.75, 1.0]
    np.testing.assert_array_equal(results.success_matrix()[0], Results((first, *matrix)).success_matrix()[0])
    assert results.evaluations() == matrix and shift_scores(Results((first, *matrix))) == []
    (score,) = shift_scores(results)
    names = ("learned", "learned_shifted", "final", "final_shifted")
    assert [score.success(name).value for name in names] == [1.0, 0.625, 0.875, 0.25]
    assert score.forgetting(shifted=False).value == 0.25 and score.forgetting(shifted=True).value == 0.75
    assert np.isnan(score.forgetting(shifted=True).low), "of four starts"
    assert 0 < score.success("final").low < 0.875 < score.success("final").high < 1
    (part,) = shift_scores(Results((first, *matrix, shifted[0])))
    assert np.isnan(part.success("final_shifted").value) and np.isnan(part.forgetting(shifted=True).value)
    line = to_line(shifted[0])
    assert from_line(line) == shifted[0]
    with pytest.raises(ValueError, match="has the shift"):
        evaluation("matrix", 0, 1, 0, 1, shift="light=0.5")


def test_a_run_of_before_is_restored(tmp_path):
    tasks, *_ = make_run(tmp_path / "run", "algo=sequential")
    file = tmp_path / "run" / "config.yaml"
    file.write_text("".join(x for x in file.read_text().splitlines(True) if "perturb" not in x))
    found = restore(tmp_path / "run", device="cpu")
    assert found.perturb == () and found.learned_task(1) == tasks[1]


@pytest.mark.sim
def test_copies_are_further_windows_of_the_same_actions(folder, tmp_path, quick):
    text = ("data.perturb={camera:0.5,light:0.5}", "data.perturb_copies=2")
    config = build(composed(*TINY, f"data.folder={folder}", *text).data)
    tasks, counts, none = TASKS[:1], [2], [()]
    paths = demonstrations.find_demos(tasks, counts, config, False)
    copies = demonstrations.demo_copies(paths, tasks, counts, none, config, False)
    assert [path.parent.name for path in copies[0]] == [
        "under-camera=0.5,light=0.5-32x32-fast", "under-camera=0.5@1,light=0.5@1-32x32-fast"
    ]  # fmt: skip
    read = (paths, counts, config.spec(384), torch.zeros(1, 384), config, torch.device("cpu"))
    plain, joined = DemoDatasets(*read)[0], DemoDatasets(*read, copies)[0]
    n = len(plain)
    assert len(joined) == 3 * n and joined.task_id == 0
    mixed = torch.tensor([2 * n + 5, 5, n + 5])
    batch, own = joined.batch(mixed), plain.batch(torch.tensor([5, 5, 5]))
    assert torch.equal(batch.actions, own.actions) and batch.window_ids.tolist() == mixed.tolist()
    for name, reading in batch.observation.proprio.items():
        assert torch.equal(reading, own.observation.proprio[name])
    images = batch.observation.images.float()
    assert torch.equal(images[1], own.observation.images[1].float())
    for i, k in ((0, 1), (0, 2), (1, 2)):
        assert (images[i] - images[k]).abs().mean() > 1
    path = run(folder, tmp_path, *text)  # replay, training and evaluation take them
    assert ResultLog(path / "results.jsonl").read().finished
    assert ResultLog(path / "results.jsonl").read().run.perturbed == ()
    learned, log = restore(path), ResultLog(path / "results.jsonl")
    windows = partial(relearning.task_windows, learned, 0, 0, read_config(path / "config.yaml", ()))
    training, _ = windows()
    assert len(training) == 3 * n, "relearning is on the copies, too"
    (before,) = log.read().of(DemonstrationsRecord)
    log.append(replace(before, digests=("another", *before.digests[1:])))
    with pytest.raises(DataError, match="has other demonstrations than .* learned 'pick_up"):
        windows()


def test_settings_of_copies():
    assert build(composed().data).copies == 0 and build(composed("data.perturb={light:1}").data).copies == 1
    for wrong, said in (
        ("={instruction:1}", "instruction"),
        ("={light:0}", "severities above 0"),
        ("={}", "severities above 0"),
        ("_copies=0", "perturb_copies is 0; expected greater than or equal to 1"),
    ):
        with pytest.raises(ConfigError, match=said):
            build(composed(f"data.perturb{wrong}").data)
