"""Perturbations in lifelong learning: streams whose tasks are perturbed more and more."""

import hashlib
from dataclasses import asdict
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch

from libero_env.demos import perturbed as rendering
from libero_env.demos.curate import read_episodes
from libero_env.demos.generate import generate
from libero_env.demos.observe import RenderConfig
from libero_env.demos.perturbed import RenderJob, ensure_rendered
from libero_env.perturbations import parse_perturbations, reword_task
from libero_env.tasks import get_suite
from lifelong import experiment
from lifelong.errors import ConfigError
from lifelong.evaluation.restore import restore
from lifelong.language import encoder
from lifelong.results.log import ResultLog
from lifelong.results.records import EvalRecord, RunRecord, from_line, to_line
from lifelong.sequence.learning import TaskSequence
from lifelong.settings import build
from lifelong.streams import StreamSettings
from tests.harness.configs import composed
from tests.harness.demos import wander
from tests.harness.runs import make_run

TASKS = get_suite("libero_object").tasks[:2]
NAMES = {"policy": "tiny", "benchmark": "libero_object", "algo": "sequential", "preset": "smoke"}
TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "algo=sequential", "threads=1"),
    *(
        "data.demos=2",
        "data.image_size=32",
        "train.epochs=1",
        "train.steps_per_epoch=1",
        "train.batch_size=2",
    ),
    *(
        "eval.horizon=3",
        "eval.episodes=2",
        "eval.curve_episodes=1",
        "eval.record_every=0",
        "eval.sim_threads=1",
    ),
    *("policy.encoder.width=4", "policy.head.hidden=8", "progress=false", "augmentation=none"),
)
LOOKS = "instruction=0.6,light=0.8"


class Stop(BaseException):
    """Stands for a killed process."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Record two demonstrations of two tasks without an expert, where `data.folder` finds them."""
    root = tmp_path_factory.mktemp("demos")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("libero_env.demos.record.run_experts", wander)
        for task in TASKS:
            path = root / task.suite / f"{task.name}_demo.hdf5"
            generate(task, 2, path=path, camera_size=(32, 32), workers=1, progress=False)
    return root


@pytest.fixture
def quick(monkeypatch):
    """Embed any text without an encoder, and render in this process."""

    def embeddings(texts, cache_dir):
        seeds = [int(hashlib.sha256(text.encode()).hexdigest()[:8], 16) for text in texts]
        return torch.stack([torch.randn(384, generator=torch.Generator().manual_seed(s)) for s in seeds])

    monkeypatch.setattr(encoder, "_minilm", embeddings)
    monkeypatch.setattr(rendering, "cpu_count", lambda: 1)


def run(folder: Path, home: Path, *overrides: str) -> Path:
    config = composed(*TINY, f"data.folder={folder}", f"runs_dir={home}", *overrides)
    return experiment.run(config, NAMES)


def outcomes(path: Path):
    """Return all records but their times and conditions, by key; a record that was made twice is the same."""
    kept = {}
    for record in ResultLog(path / "results.jsonl").read().records:
        if isinstance(record, RunRecord) or type(record).__name__ in (
            "CostRecord",
            "PhaseRecord",
            "RunEndRecord",
        ):
            continue
        values = {k: v for k, v in asdict(record).items() if k not in ("seconds", "decided_by")}
        key = tuple(values.get(k) for k in ("kind", "phase", "learned", "task", "epoch", "perturb"))
        assert kept.setdefault(key, values) == values
    return kept


@pytest.mark.unit
def test_severity_grows_in_equal_steps():
    stream = StreamSettings(perturb="light=1,camera=0.3", perturb_seed=4)
    found = stream.perturbations((1,) * 4)
    assert found[0] == () and found[3] == parse_perturbations("light=1,camera=0.3", seed=4)
    assert [[one.severity for one in task] for task in found[1:3]] == [[0.1, 0.3333], [0.2, 0.6667]]
    for task in found:
        assert parse_perturbations(",".join(map(str, task))) == task  # the text is exact
    grouped = stream.perturbations((2, 1, 1))
    assert grouped[0] == grouped[1] == () and [one.severity for one in grouped[2]] == [0.15, 0.5]
    assert StreamSettings().perturbations((1, 1)) == ((), ()) and stream.perturbations((3,)) == ((),) * 3


@pytest.mark.unit
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


@pytest.mark.unit
def test_presets_and_mappings():
    kinds = {"shift": "light", "shift_camera": "camera", "shift_instruction": "instruction"}
    for name, kind in kinds.items():
        ((), (last,)) = build(composed(f"stream={name}").stream).perturbations((1, 1))
        assert (last.kind, last.severity) == (kind, 1.0)
    same = StreamSettings(perturb={"camera": 0.5, "light": 1}), StreamSettings(perturb="light=1,camera=0.5")
    assert same[0].perturbations((1, 1, 1)) == same[1].perturbations((1, 1, 1))


@pytest.mark.unit
def test_records_of_before_are_read():
    old = b'{"kind": "run", "algo": "er", "benchmark": "b", "policy": "p", "seed": 1, "preset": "", "tasks": ["t"], '
    old += b'"instructions": ["t"], "config_digest": "", "versions": {}, "commit": null, "cpu_count": 1, "started": ""}'
    record = from_line(old)
    assert record.perturbed == () and from_line(to_line(record)) == record
    with pytest.raises(ValueError, match="has 2 perturbations"):
        from_line(
            to_line(record).replace(b'"perturbed": []', b'"perturbed": ["", ""]').partition(b', "crc32"')[0]
            + b"}"
        )


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
    assert (
        ensure_rendered(jobs, workers=1, progress=False) == [path, own] and path.stat().st_mtime_ns == before
    )

    ensure_rendered([RenderJob(own, task, 2, config)], workers=1, progress=False)  # goes on
    whole = {name: episode.obs["agentview_rgb"] for name, episode in read_episodes(path)}
    (fresh,) = ensure_rendered([RenderJob(source, task, 2, config)], workers=2, progress=False)
    for name, episode in read_episodes(fresh):
        np.testing.assert_array_equal(whole[name], episode.obs["agentview_rgb"])
    with h5py.File(own, "r+") as file:  # recorded again, with other states
        file["data/demo_0/states"][0, 1] += 0.01
    assert not RenderJob(own, task, 2, config).is_complete()
    ensure_rendered([RenderJob(own, task, 2, config)], workers=1, progress=False)
    (_, new), (_, same) = read_episodes(path)
    assert (new.obs["agentview_rgb"][0] != whole["demo_0"][0]).any()
    np.testing.assert_array_equal(same.obs["agentview_rgb"], whole["demo_1"])


@pytest.mark.sim
def test_each_task_is_learned_and_evaluated_under_its_own_perturbations(folder, tmp_path, quick, monkeypatch):
    seen, read = [], []
    make = experiment._make_env
    monkeypatch.setattr(
        experiment, "_make_env", lambda *a, **k: seen.append((a[4], make(*a, **k))) or seen[-1][1]
    )
    opened = experiment.DemoDatasets.__getitem__
    monkeypatch.setattr(
        experiment.DemoDatasets,
        "__getitem__",
        lambda self, k: read.append((k, self.paths[k], self.languages[k])) or opened(self, k),
    )
    path = run(folder, tmp_path, "stream=shift", f"stream.perturb='{LOOKS}'")
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
    assert torch.equal(
        loaded.embed(TASKS[1]), encoder._minilm([TASKS[1].language], None)[0]
    )  # without the shift
    assert (path / "report.html").is_file()

    def stop(self, *args):
        raise Stop

    killed = (folder, tmp_path / "killed", "stream=shift", f"stream.perturb='{LOOKS}'")
    with monkeypatch.context() as patch:
        patch.setattr(TaskSequence, "_evaluate_seen_tasks", stop)
        with pytest.raises(Stop):
            run(*killed)
    assert outcomes(run(*killed)) == outcomes(path)


@pytest.mark.sim
def test_without_perturbations_nothing_changes(folder, tmp_path, quick):
    plain, zero = (run(folder, tmp_path / name, *more) for name, more in
                   (("plain", ()), ("zero", ("stream=shift", "stream.perturb='light=0,camera=0'"))))  # fmt: skip
    assert outcomes(plain) == outcomes(zero)
    assert ResultLog(plain / "results.jsonl").read().run.perturbed == ()
    assert not list(folder.rglob("under-light=0-*")) and not list(folder.rglob("under-camera*"))
    assert [r.phase for r in ResultLog(plain / "results.jsonl").read().of(EvalRecord)].count("matrix") == 3


@pytest.mark.unit
def test_a_run_of_before_is_restored(tmp_path):
    tasks, *_ = make_run(tmp_path / "run", "algo=sequential")
    file = tmp_path / "run" / "config.yaml"
    file.write_text("".join(x for x in file.read_text().splitlines(True) if "perturb" not in x))
    found = restore(tmp_path / "run", device="cpu")
    assert found.perturb == () and found.learned_task(1) == tasks[1]
