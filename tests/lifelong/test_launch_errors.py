"""What is wrong on the command line of a training is told in one line, with what would be right."""

import io
import os
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import libero_env.parallel as parallel
from libero_env import LiberoEnv
from libero_env.errors import LiberoError
from libero_env.tasks import get_task
from lifelong.cli.main import main
from lifelong.errors import ConfigError
from lifelong.settings import build

FIT = {"_target_": "lifelong.training.settings.FitSettings"}


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["libero"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # which is set otherwise for the processes of other tests
    return tmp_path


@pytest.mark.unit
@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("train.epochs=abc", "error: train.epochs is 'abc'; expected a whole number"),
        ("eval.horizon=1.5", "error: eval.horizon is 1.5; expected a whole number"),
        ("train.lr=fast", "error: train.lr is 'fast'; expected a number"),
        ("resume=maybe", "error: resume is 'maybe'; expected true or false"),
        (
            "train.epoch=3",
            "error: unknown key train.epoch of the configuration. Did you mean train.epochs? Valid:",
        ),
        ("trian.epochs=3", "error: unknown key trian of the configuration. Did you mean train?"),
        ("+train.foo=3", "error: train.foo is an unknown key. Valid: epochs,"),
        ("train.epochs", "error: Error parsing override 'train.epochs'"),
        ("data.folder=demoz", "error: data.folder=demoz does not exist. Did you mean demos?"),
    ],
)
def test_a_mistyped_override_is_one_line(word, message, here, capsys):
    (here / "demos").mkdir()
    assert main(["train", "preset=smoke", word]) == 2
    found = capsys.readouterr().err
    assert found.startswith(message) and found.count("\n") == 1
    assert not list(here.rglob("results.jsonl")), "no run has begun"


@pytest.mark.unit
def test_values_fit_the_parameters_of_their_target():
    assert build(OmegaConf.create({**FIT, "lr": 1, "steps_per_epoch": None})).lr == 1
    assert build(OmegaConf.create({"_target_": "builtins.dict", "any": "key"})) == {"any": "key"}
    for changes, message in [
        ({"steps_per_epoch": "x"}, "steps_per_epoch is 'x'; expected a whole number or null"),
        ({"epochs": True}, "epochs is True; expected a whole number"),
        ({"epoch": 3}, "epoch is an unknown key. Did you mean 'epochs'?"),
    ]:
        with pytest.raises(ConfigError) as error:
            build(OmegaConf.create({**FIT, **changes}))
        assert message in str(error.value)


@pytest.mark.unit
def test_missing_commands_print_the_help(capsys):
    for words, shown in (([], "compare"), (["tasks"], "certify"), (["results"], "export")):
        with pytest.raises(SystemExit, match="2"):
            main(words)
        found = capsys.readouterr().err
        assert shown in found and "required" not in found


@pytest.mark.unit
def test_a_reader_that_has_seen_enough_is_no_error(monkeypatch, capfd):
    def write(self, *_):
        raise BrokenPipeError

    with open(os.devnull, "w") as sink:
        monkeypatch.setattr(sys, "stdout", sink)
        monkeypatch.setattr("libero_env.cli.tasks.run_tasks_show", write)
        assert main(["tasks", "show", "libero_goal/0"]) == 141
    assert capfd.readouterr().err == ""


@pytest.mark.unit
def test_a_suite_is_no_task():
    with pytest.raises(
        LiberoError, match="libero_goal is a suite of 10 tasks, not a task; write libero_goal/0 to"
    ):
        get_task("libero_goal")


@pytest.mark.sim
def test_closed_environments_say_so():
    env = LiberoEnv("libero_goal/7", cameras=())
    env.reset(seed=0)
    env.close()
    for use in (env.reset, lambda: env.step(env.action_space.sample()), env.get_state):
        with pytest.raises(LiberoError, match="this environment of libero_goal/7 is closed; make another"):
            use()
    env.close()  # twice is allowed


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.unit
def test_progress_is_lines_where_there_is_no_terminal(monkeypatch):
    monkeypatch.setattr(parallel, "LINE_SECONDS", 0.0)
    for stream, progress, expected in [
        (io.StringIO(), None, "demonstrations: 2 of 2, 00:00 passed, 00:00 left\n"),
        (io.StringIO(), False, ""),
        (Terminal(), None, "demonstrations: 100%"),
        (io.StringIO(), True, "demonstrations: 100%"),
    ]:
        monkeypatch.setattr(sys, "stderr", stream)
        with parallel.progress_bar(total=2, desc="demonstrations", progress=progress, file=stream) as bar:
            bar.update(1)
            bar.update(1)
        assert stream.getvalue().endswith(expected) if "%" not in expected else expected in stream.getvalue()


@pytest.mark.unit
def test_short_work_prints_no_lines(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    assert list(parallel.progress_bar(range(5), file=stream)) == [0, 1, 2, 3, 4]
    assert stream.getvalue() == ""
