"""What is wrong on the command line of a training is told in one line, with what would be right."""

import importlib.util
import io
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import libero_env.progress as bars
from libero_cli.main import main
from libero_env.assets.robot import robot_assets
from lifelong import experiment
from lifelong.errors import ConfigError
from lifelong.sweeps import read_sweep, sweep_name


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["libero"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")  # which is set otherwise for the processes of other tests
    return tmp_path


@pytest.fixture
def own(here) -> Path:
    """The folder of a user, with a configuration file in `own`."""
    (here / "own" / "algo").mkdir(parents=True)
    (here / "own" / "algo" / "l2.yaml").write_text("_target_: my_package.L2\nstrength: 10.0\n")
    shadow = here / "shadow" / "tuned" / "gmm_small" / "derpp.yaml"
    shadow.parent.mkdir(parents=True)
    shadow.write_text("alpha: 0.7\n")
    (here / "own" / "policy").mkdir()
    (here / "own" / "policy" / "mine.yaml").write_text("_target_: my_policy.Mine\n")
    return here


@pytest.fixture
def begun(monkeypatch) -> list:
    """Return a list of the configurations of runs, each with its names, which end where they would begin."""
    found = []

    def run(config, names, *_):
        print("Task 1/2: a\n  epoch 0", end="")
        print(": success 0%", flush=True)
        found.append((config, names))
        raise ConfigError("a run begins")

    monkeypatch.setattr(experiment, "run", run)
    return found


@pytest.fixture
def learning(monkeypatch) -> list[int]:
    """Return a list of the numbers of threads of runs that end where their first task begins."""
    found = []

    def learn(*args):
        found.append(torch.get_num_threads())
        raise ConfigError("the first task begins")

    monkeypatch.setattr(experiment, "_run_sequence", learn)
    return found


TINY = ("benchmark.tasks=1", "language=onehot", "device=cpu", "threads=1", "eval.episodes=1")
# a command's words, and what its one line of an error has to name
MISTAKES = {
    "train.epochs=abc": ("train.epochs", "'abc'", "a valid integer"),
    "train.epoch=3": ("train.epoch", "Did you mean 'train.epochs'?"),
    "lr=3e-4": ("unknown key of the configuration 'lr'", "there is train.lr"),
    "temporal.layers=2 policy=bc_rnn_small": ("there is policy.temporal.layers",),
    "policy=act": ("'act'", "lerobot"),
    "policy=mine --config-dir own": ("my_policy.Mine", "neither installed nor in", "No module named 'my_policy'"),
    "policy=mine policy/head=gmm --config-dir own": ("policy/head",),
    "--cfg job benchmark.tasks=[3,99]": ("libero_goal 99",),
    "--cfg job policy.encoder.width=17": ("17 channels",),
    "+train.foo=3": ("train.foo", "unknown key", "Valid: epochs"),
    "train.epochs": ("train.epochs", "KEY=VALUE"),
    "seed=" + "9" * 5000: ("4300 digits", "KEY=VALUE"),
    "benchmark_name=LIBERO_GOAL": ("benchmark_name", "Did you mean 'benchmark'?"),
    "seed.x=1": ("seed.x",),
    "benchmark=LIBERO_OBJECT": ("LIBERO_OBJECT", "Did you mean 'libero_object'?"),
    "benchmark.order=30": ("30", "0 to 20"),
    "algo=er algo.budget=5": ("algo.budget", "algo.memory.budget"),
    "foo/bar=x": ("foo/bar",),
    "algo=er algo/estimator=batch": ("algo/estimator",),
    "compat=libero algo=ewc algo/estimator=sample": ("algo/estimator has no effect with compat=libero", "BatchFisher"),
    "benchmark.horizon=100": ("benchmark.horizon has no effect with preset=smoke", "set eval.horizon"),
    "policy=bc_rnn_small policy.temporal.dropout=0.1": ("dropout=0.1 acts between layers, and there is one",),
    "policy.encoder.width=17": ("17 channels", "a multiple of 8"),
    "train.lr=${nothing}": ("train.lr", "'nothing' not found"),
    "=3": ("cannot be composed",),
    "~train": ("train",),
    "device=meta": ("device", "'meta'"),
    "runs_dir=taken": ("taken is a file",),
    "data.folder=demoz": ("demoz", "Did you mean demos?"),
    "data.image_size=100000": ("of memory, and there are",),
    "--algo ewc": ("--algo", "algo=ewc"),
    "--config_dir": ("--config_dir", "Did you mean '--config-dir'?"),
    "--cfg jobs": ("--cfg", "'jobs'", "'job'"),
    "--config-dir owm": ("owm", "Did you mean 'own'?"),
    "--config-dir shadow": ("shadow/tuned/gmm_small/derpp.yaml would not be read", "derpp_own.yaml"),
    "-m algo=ewc, er": ("error",),
    "-m algo=er,ewc --cfg job": ("cannot be composed", "--multirun", "--cfg"),
    "-m algo=er,ewk": ("ewk", "Did you mean 'ewc'?"),
}  # fmt: skip


@pytest.mark.parametrize("words", MISTAKES, ids=lambda words: words[:60])
def test_a_mistake_is_one_line_and_leaves_nothing_behind(words, own, capsys):
    (own / "demos").mkdir()
    (own / "taken").write_text("")
    assert main(["train", "preset=smoke", *words.split()]) == 2
    line = capsys.readouterr().err
    assert line.startswith("error: ") and line.count("\n") == 1
    assert all(name in line for name in MISTAKES[words]), line
    assert not list(own.rglob("results.jsonl")), "no run has begun"


@pytest.mark.parametrize("words", [
    "-m algo=l2,er seed=7 --config-dir own",
    "algo=l2,er seed=7 -m -cd own",
    "algo=l2,er --config-dir=own --multirun seed=7",
    "--config-dir own algo=l2,er -m seed=7",
])  # fmt: skip
def test_options_of_a_sweep_stand_anywhere(words, own, begun, capsys):
    assert main(["train", *words.split()]) == 2
    assert "usage" not in capsys.readouterr().err
    assert [(names["algo"], config.seed) for config, names in begun] == [("l2", 7), ("er", 7)]
    (folder,) = (own / "runs" / "sweep").iterdir()
    assert folder.name == sweep_name(["algo=l2,er", "seed=7"], ["algo"]), "the same, wherever options stand"


@pytest.mark.parametrize("chosen", ["choice(er,l2)", "glob([l2*,er],exclude=lwf)"])
def test_a_sweep_takes_what_hydra_offers_to_name_files(chosen, own, begun):
    assert main(["train", "-m", f"algo={chosen}", "--config-dir", "own"]) == 2
    assert [names["algo"] for _, names in begun] == ["er", "l2"]
    (folder,) = (own / "runs" / "sweep").iterdir()
    assert read_sweep(folder).planned == 2


def test_classes_of_a_module_in_the_current_folder_are_found(own, monkeypatch, capsys):
    """Beside the command, as `libero eval my_policy:make` finds it; with policies that name no head."""
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if Path(entry).resolve() != own])
    (own / "my_package.py").write_text(
        "from lifelong import Algorithm\n\n\nclass L2(Algorithm):\n"
        "    def __init__(self, *, strength: float):\n        self.strength = strength\n"
    )
    (own / "my_policy.py").write_text(
        "from lifelong.policies import BCMLP\n\n\nclass Mine(BCMLP):\n    pass\n"
    )
    for words in ("algo=l2", "policy=mine"):
        status = main(["train", *words.split(), "--config-dir", "own", "--cfg", "job"])
        assert (status, capsys.readouterr().err) == (0, "")


@pytest.mark.parametrize(
    ("package", "message"), [("wandb", "wandb is not installed"), ("robosuite", "cannot be fetched")]
)
def test_a_package_that_is_not_installed_leaves_no_directory(package, message, here, monkeypatch, capsys):
    find = importlib.util.find_spec
    for place in ("importlib.util.find_spec", "libero_env.errors.find_spec"):
        monkeypatch.setattr(place, lambda name, *more: None if name == package else find(name, *more))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("LIBERO_CACHE", str(here / "cache"))
    robot_assets.cache_clear()
    assert main(["train", "preset=smoke", "tracker=wandb"]) == 2
    assert message in capsys.readouterr().err and not (here / "runs").exists()


def test_lines_of_the_jobs_of_a_sweep_have_their_names(here, begun, capsys):
    assert main(["train", "-m", "algo=er", "seed=3,4"]) == 2
    out, err = capsys.readouterr()
    for name in ("[1/2 seed=3] ", "[2/2 seed=4] "):
        assert f"{name}Task 1/2: a\n{name}  epoch 0: success 0%\n" in out
        assert f"{name}error: a run begins\n" in err


@pytest.mark.parametrize(("word", "again"), [
    ("progress=false", False), ("resume=false", True), ("eval.shift={light:0.5}", True)
])  # fmt: skip
def test_a_sweep_runs_again_what_is_asked_for_again(word, again, here, monkeypatch):
    seen = []

    def run(file, record, learn, report, *, again):
        seen.append(again)
        return replace(record, status="failed", exit_status=2)

    monkeypatch.setattr("lifelong.jobs.run_job", run)
    main(["train", "-m", "seed=1,2", word])
    assert seen == [again] * 2


def test_jobs_of_one_folder_with_other_names_of_their_runs_are_others(here, monkeypatch):
    keys = []

    def run(file, record, learn, report, *, again):
        keys.append(record.key)
        return replace(record, status="failed", exit_status=2)

    monkeypatch.setattr("lifelong.jobs.run_job", run)
    for word in ("run_id=a", "run_id=b", "runs_dir=other"):
        main(["train", "-m", "seed=1,2", "hydra.sweep.dir=sweep", word])
    monkeypatch.setattr(experiment, "default_drawing", lambda pack: "faithful")  # as of other models
    main(["train", "-m", "seed=1,2", "hydra.sweep.dir=sweep", "run_id=a"])
    assert len(set(keys)) == 8


def test_every_job_of_a_sweep_is_checked_for_what_has_no_effect(here, begun, capsys):
    assert main(["train", "-m", "compat=libero", "algo=ewc", "algo/estimator=batch,sample"]) == 2
    assert [config.algo.estimator._target_.rpartition(".")[2] for config, _ in begun] == ["BatchFisher"]
    assert "algo/estimator has no effect with compat=libero" in capsys.readouterr().err


@pytest.mark.parametrize(("words", "noted"), [
    ("policy=bc_rnn_small", True), ("policy=bc_vilt_small", True),
    ("policy=bc_transformer_small policy.readout=instruction", True), ("policy=bc_transformer_small", False),
    ("policy=bc_rnn_small data.seq_len=2", False), ("policy=bc_mlp_small", False)
])  # fmt: skip
def test_a_policy_with_a_history_that_is_given_single_frames_says_so(words, noted, here, learning, capsys):
    assert main(["train", *TINY, *words.split()]) == 2
    policy, found = words.split()[0], capsys.readouterr().err
    note = f"note: {policy} learns and acts on single frames, as data.seq_len=1; data.seq_len=10 gives it"
    assert found.endswith("error: the first task begins\n") and (note in found) == noted


def test_a_run_is_named_by_its_run_id_also_where_that_is_zero(here, learning):
    assert main(["train", *TINY, "run_id=0"]) == 2
    (config,) = here.rglob("config.yaml")
    assert config.parent.name == "bc_transformer_small_seed1_0"


def test_missing_commands_print_the_help(capsys):
    for words, shown in (([], "compare"), (["tasks"], "certify"), (["results"], "export")):
        assert main(words) == 2
        assert shown in capsys.readouterr().err


def test_a_reader_that_has_seen_enough_is_no_error(monkeypatch, capfd):
    def write(task: str):
        raise BrokenPipeError

    with open(os.devnull, "w") as sink:
        monkeypatch.setattr(sys, "stdout", sink)
        monkeypatch.setattr("libero_env.tasks.get_task", write)
        assert main(["tasks", "show", "libero_goal/0"]) == 141
    assert capfd.readouterr().err == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "progress", "quiet", "seconds", "expected"),
    [
        (io.StringIO, None, "", 0.0, "demonstrations: 2 of 2, 00:00 passed, 00:00 left\n"),
        (io.StringIO, None, "", bars.LINE_SECONDS, ""),  # which is longer than the work takes
        (io.StringIO, False, "", 0.0, ""),
        (io.StringIO, True, "", 0.0, "demonstrations: 100%"),
        (Terminal, None, "", 0.0, "demonstrations: 100%"),
        (io.StringIO, None, "1", 0.0, ""),
        (Terminal, True, "1", 0.0, ""),
    ],
)
def test_progress_is_lines_where_there_is_no_terminal(
    stream, progress, quiet, seconds, expected, monkeypatch
):
    monkeypatch.setattr(sys, "stderr", stream := stream())
    monkeypatch.setattr(bars, "LINE_SECONDS", seconds)
    monkeypatch.setenv("LIBERO_QUIET", quiet)
    if quiet:
        bars.tell_progress("recording")
    assert list(bars.progress_bar(range(2), desc="demonstrations", progress=progress, file=stream)) == [0, 1]
    found = stream.getvalue()
    assert (
        expected in found if "%" in expected else found.endswith(expected) and bool(found) == bool(expected)
    )


class Clock:
    now = 0.0

    def time(self) -> float:
        return self.now


def estimates(bar, clock, moments) -> list[tuple[float, str]]:
    """Return the time left that a bar tells, [s] or ?, at each (time, work, pieces done)."""
    told = []
    for now, work, done in moments:
        clock.now = now
        if work is not None:
            bar.add_work(work)
        bar.update(done)
        told.append(str(bar).partition(" passed, ")[2].partition(" left")[0])
    return told


def test_the_time_left_is_right_from_its_first_telling_on(monkeypatch):
    """Told after half a minute, and measured since the first work: what compiles before that does not count."""
    monkeypatch.setattr(sys, "stderr", io.StringIO())

    def bar(total):
        found, clock = bars.progress_bar(total=total, desc="demonstrations", file=sys.stderr), Clock()
        found._time, found.start_t, found.last_print_t = clock.time, 0.0, 0.0
        return found, clock

    # 20 s of compiling, then one each second
    steady = estimates(*bar(100), [(20.0 + k, None, 1) for k in range(31)])
    assert steady[:10] == ["?"] * 10 and steady[10] == "01:29" and steady[30] == "01:09"
    # tens that are simulated together in 5 s and then finished one every half second, after a minute of compiling
    rounds = [
        moment
        for end in (60.0, 70.0, 80.0)
        for moment in [(end, 5.0, 0), *((end + k / 2, 0.5, 1) for k in range(1, 11))]
    ]
    for (now, *_), left in zip(rounds, estimates(*bar(100), rounds), strict=True):
        assert (left == "?") == (now < 65.5)
        if left != "?":
            minutes, seconds = map(int, left.split(":"))
            assert 0.5 <= (now - 55 + 60 * minutes + seconds) / 100 <= 2.0
    # episodes that end when they succeed: nothing is told while it could be wrong by more than a factor of two
    for end in (10, 35, 100):  # steps after which all have ended, of 100 at most, one each second
        rollouts, clock = bar(100)
        for step in range(1, end):
            rollouts.least_total, rollouts.total, clock.now = step, 100, float(step)
            rollouts.update(1)
            left = str(rollouts).partition(" passed, ")[2].partition(" left")[0]
            assert (left == "?") == (step < 30)
            if left != "?":
                minutes, seconds = map(int, left.split(":"))
                assert 0.5 <= (step + 60 * minutes + seconds) / end <= 2.0


def test_a_run_that_fails_ends_its_tracker_and_gives_the_threads_back(here, learning, monkeypatch):
    """In a sweep, else the next job logs into the same run of W&B, with the same number of threads."""
    ended = []
    monkeypatch.setattr("lifelong.tracking.Tracker.finish", lambda tracker: ended.append(tracker))
    tiny = ("preset=smoke", "language=onehot", "device=cpu", "data.image_size=32")
    default = torch.get_num_threads()
    assert main(["train", "-m", *tiny, f"threads={default + 1},0"]) == 2
    assert len(ended) == 2 and learning == [default + 1, default]
