"""Runs and evaluations of others: what commands write in them stays in them, and what they name is only read."""

import shutil
import sys
from pathlib import Path

import pytest
import yaml

from libero_cli.main import main
from lifelong import checkpoints
from lifelong.results.provenance import config_digest

pytestmark = [pytest.mark.sim, pytest.mark.slow]

TINY = (
    *("preset=smoke", "benchmark=libero_object", "benchmark.tasks=2", "threads=1", "data.demos=2"),
    *("data.seq_len=2", "device=cpu", "train.epochs=1", "train.steps_per_epoch=4", "train.batch_size=4"),
    *("eval.horizon=4", "eval.episodes=1", "eval.curve_episodes=1", "policy.encoder.width=4"),
    *("algo=sequential", "data.image_size=32", "train.warmup_steps=0"),
)
EXPORT = ("results", "export", "RESULT", "--as")
SHORT = ("--episodes", "1", "--horizon", "4", "--suite", "libero_object/0")
# every command that writes into a folder which it is given; RUN is a run and RESULT an evaluation
WRITERS = {
    "report": ("report", "RUN"),
    "saliency": ("saliency", "RUN", "--moments", "1", "--stride", "64", "--horizon", "2"),
    "diagnose": ("diagnose", "RUN", "--held-out", "1"),
    "relearn": ("relearn", "RUN", "--steps", "2", "--every", "2", "--held-out", "1"),
    "eval": ("eval", "RUN", *SHORT, "--videos", "1"),
    "named": ("eval", "RUN", *SHORT, "--name", "mine"),
    "checkpoint": ("eval", "RUN/checkpoints/task_0.safetensors", *SHORT),
    "robustness": ("robustness", "RUN", *SHORT, "--kinds", "light", "--severities", "1", "--pairs"),
    "again": ("eval", "RESULT"),
    "eval-results": (*EXPORT, "eval-results", "--partial", "--dataset", "org/name"),
    "lerobot": (*EXPORT, "lerobot"),
    "vla-eval": (*EXPORT, "vla-eval"),
    "check": ("check", "RUN"),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory, demos) -> Path:
    """A folder with a finished run and an evaluation of the expert."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LIBERO_DEMOS", str(demos))
        patch.setattr(sys, "argv", ["libero"])
        assert main(("train", *TINY, f"runs_dir={folder / 'runs'}")) == 0
        assert main(("eval", "expert", *SHORT, "--out", str(folder / "result"))) == 0
    return folder


@pytest.fixture
def here(made, tmp_path, demos, monkeypatch) -> Path:
    """A copy of it, the working folder."""
    shutil.copytree(made, tmp_path / "theirs", symlinks=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIBERO_DEMOS", str(demos))
    monkeypatch.setattr(sys, "argv", ["libero"])
    return tmp_path / "theirs"


def call(command: str, theirs: Path) -> int:
    (config,) = (theirs / "runs").rglob("config.yaml")
    names = {"RUN": str(config.parent), "RESULT": str(theirs / "result")}
    parts = (word.partition("/") for word in WRITERS[command])
    return main(tuple(names.get(first, first) + slash + rest for first, slash, rest in parts))


def content(folder: Path) -> dict[str, tuple[int, bytes]]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): (p.stat().st_mtime_ns, p.read_bytes()) for p in files}


@pytest.mark.parametrize("command", WRITERS)
def test_no_command_writes_where_a_folder_in_it_leads(command, made, here, tmp_path, capsys):
    before = content(here)
    call(command, here)
    after = content(here)
    (run,) = (here / "runs").rglob("config.yaml")
    roots = (run.parent, here / "result")
    written = {name for name, data in after.items() if before.get(name) != data}
    folders = {
        parent
        for name in written
        for parent in (here / name).parents
        if any(root in parent.parents for root in roots)
    }
    assert written or command == "check"
    for number, folder in enumerate(sorted(folders)):
        theirs, mine = tmp_path / f"theirs{number}", tmp_path / f"mine{number}"
        shutil.copytree(made, theirs)
        link = theirs / folder.relative_to(here)
        precious = shutil.copytree(folder, mine)
        for file in (p for p in precious.rglob("*") if p.is_file()):
            file.write_text("precious")
        shutil.rmtree(link, ignore_errors=True)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(mine)
        held = content(mine)
        assert call(command, theirs) != 0, f"{link} is a link"
        assert content(mine) == held, f"written through {link}"
        assert "is a link" in capsys.readouterr().err


def edited(theirs: Path, **data: object) -> Path:
    (config,) = (theirs / "runs").rglob("config.yaml")
    values = yaml.safe_load(config.read_text())
    values["data"] |= data
    config.write_text(yaml.safe_dump(values))
    for file in (config.parent / "checkpoints").glob("task_*.safetensors"):  # which say whose they are
        checkpoints.save(file, checkpoints.load(file) | {"run": config_digest(values)})
    return config.parent


@pytest.mark.parametrize("command", ["diagnose", "relearn"])
@pytest.mark.parametrize("named", ["folder", "files", "demos", "perturb", "root"])
def test_what_a_run_names_is_only_read(command, named, here, demos, tmp_path, capsys):
    mine = tmp_path / "mine"
    kept = shutil.ignore_patterns(".*.lock")
    shutil.copytree(demos, mine, ignore=kept) if named in ("files", "perturb") else mine.mkdir()
    files = [str(path) for path in mine.rglob("*.hdf5")]
    data = {
        "folder": {"folder": str(mine)},
        "files": {"files": files, "demos": 50},
        "demos": {"demos": 100_000},
        "perturb": {"files": files, "perturb": "camera=0.5"},
        "root": {"folder": "/"},
    }[named]
    edited(here, **data)
    before = content(mine), content(demos)
    assert call(command, here) == 2
    said = capsys.readouterr().err
    assert "--demos DIR" in said and "Traceback" not in said
    assert (content(mine), content(demos)) == before
    assert not [path for path in mine.rglob("*") if path.name.startswith(".")], "no lock, no part"


@pytest.mark.parametrize("command", ["diagnose", "relearn"])
def test_the_folder_that_the_user_names_takes_its_place(command, here, demos, tmp_path, monkeypatch):
    mine = shutil.copytree(demos, tmp_path / "mine")
    run = edited(here, folder=str(tmp_path / "gone"))
    monkeypatch.setenv("LIBERO_DEMOS", str(tmp_path / "none"))
    words = [word.replace("RUN", str(run)) for word in WRITERS[command]]
    assert main((*words, "--demos", str(mine))) == 0
    assert not (tmp_path / "none").exists() and not (tmp_path / "gone").exists()
