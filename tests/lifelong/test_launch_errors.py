"""What is wrong on the command line of a training is told in one line, with what would be right."""

import io
import os
import sys
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import libero_env.parallel as parallel
from libero_env import LiberoEnv
from libero_env.cli.main import main
from libero_env.errors import LiberoError
from libero_env.tasks import get_task
from lifelong import experiment
from lifelong.errors import ConfigError
from lifelong.settings import build
from lifelong.sweeps import read_sweep, sweep_name

KEYS = (
    "of the configuration. Did you mean {}? Valid: the groups algo, benchmark, stream, pretrain, data, policy, "
    "augmentation, train, eval, language, wandb, compat, preset; the settings seed, device, "
)
FIT = {"_target_": "lifelong.training.settings.FitSettings"}


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
    return here


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
        ("train.epochs", "error: train.epochs is no override: write train.epochs=VALUE"),
        ("ewc", "error: ewc is no override: write algo=ewc"),
        ("libero_90", "error: libero_90 is no override: write benchmark=libero_90 or pretrain=libero_90"),
        ("nothing", "error: nothing is no override: an override is KEY=VALUE, such as algo=ewc or seed=2"),
        ("alg=ewc", f"error: unknown key alg {KEYS.format('algo')}"),
        ("algorithm=ewc", f"error: unknown key algorithm {KEYS.format('algo')}"),
        ("lifelong=er", f"error: unknown key lifelong {KEYS.format('algo')}"),
        ("lifelong.n_memories=9", f"error: unknown key lifelong {KEYS.format('algo')}"),
        ("benchmark_name=LIBERO_GOAL", f"error: unknown key benchmark_name {KEYS.format('benchmark')}"),
        ("presets=paper", f"error: unknown key presets {KEYS.format('preset')}"),
        ("seed.x=1", "error: unknown key seed.x of the configuration: seed has no keys; write seed=VALUE"),
        (
            "benchmark=LIBERO_OBJECT",
            "error: unknown benchmark 'LIBERO_OBJECT'. Did you mean 'libero_object'?",
        ),
        ("benchmark.order=30", "error: unknown task order of libero_goal 30. Valid: 0 to 20"),
        (
            "algo.strength=3",
            "error: unknown key algo.strength of the configuration: algo=sequential, the default, has no keys; "
            "algo.strength is a key of ewc, ",
        ),
        (
            "algo.nothing=3",
            "error: unknown key algo.nothing of the configuration: algo=sequential, the default",
        ),
        ("foo/bar=x", "error: unknown group 'foo/bar'. Valid: algo, algo/estimator, "),
        ("--algo", "error: --algo is no option: an override has no dashes, write algo=VALUE"),
        ("--run-id=x", "error: --run-id is no option: an override has no dashes, write run_id=x"),
        ("--config_dir", "error: unknown option --config_dir. Did you mean --config-dir? Valid: -m, "),
        ("--cfg=jobs", "error: argument --cfg/-c: invalid choice: 'jobs'"),
        ("--config-dir=demoz", "error: --config-dir: the folder demoz does not exist. Did you mean demos?"),
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
@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--algo ewc", "--algo is no option: an override has no dashes, write algo=ewc"),
        ("seed=1 --train.lr 1e-3", "--train.lr is no option: an override has no dashes, write train.lr=1e-3"),
        (
            "-m algo=ewc, er",
            "algo=ewc, is a part of a list: values are listed without spaces; write algo=ewc,er",
        ),
        ("-m seed=1 ,2", ",2 is a part of a list: values are listed without spaces; write seed=1,2"),
        ("-m algo=er,ewc --cfg job", "-m and --cfg exclude each other: --cfg is about one job; leave out -m"),
        ("algo=er algo/estimator=batch", "algo=er has no group estimator; leave out algo/estimator, or "),
        (
            "-m algo=ewc,er algo/estimator=batch",
            "algo=er has no group estimator; leave out algo/estimator, or ",
        ),
        ("algo/estimator=batch", "algo=sequential has no group estimator; leave out algo/estimator, or "),
        (
            "--config-dir own algo=l2 algo.strenght=3",
            "unknown key algo.strenght of the configuration. Did you mean algo.strength? Valid: algo.strength; +",
        ),
        (
            "-m algo=l2,sequential algo.strength=3 --config-dir=own",
            "unknown key algo.strength of the configuration: algo=sequential has no keys; algo.strength is a key of",
        ),
        ("-m algo=choice(er,ewk)", "unknown algo 'ewk'. Did you mean 'ewc'?"),
        ("-m algo=glob(x*)", "unknown algo 'glob(x*)'. Valid: agem,"),
        ("--config-dir owm algo=l2", "--config-dir: the folder owm does not exist. Did you mean own?"),
        (
            "--config-dir own/algo/l2.yaml",
            "--config-dir: own/algo/l2.yaml is a file; give a folder with files",
        ),
    ],
)
def test_what_is_wrong_with_several_words_is_one_line(words, message, own, capsys):
    assert main(["train", *words.split()]) == 2
    found = capsys.readouterr().err
    assert found.startswith(f"error: {message}") and found.count("\n") == 1


@pytest.mark.unit
@pytest.mark.parametrize(
    "words",
    [
        "-m algo=l2,er seed=7 --config-dir own",
        "algo=l2,er seed=7 -m -cd own",
        "algo=l2,er --config-dir=own --multirun seed=7",
        "--config-dir own algo=l2,er -m seed=7",
    ],
)
def test_options_of_a_sweep_stand_anywhere(words, own, monkeypatch, capsys):
    ran = []

    def run(config, names, ranks):
        ran.append((names["algo"], config.seed))
        raise ConfigError("a run begins")

    monkeypatch.setattr(experiment, "run", run)
    assert main(["train", *words.split()]) == 2
    assert "usage" not in capsys.readouterr().err and ran == [("l2", 7), ("er", 7)]
    (folder,) = (own / "runs" / "sweep").iterdir()
    assert folder.name == sweep_name(["algo=l2,er", "seed=7"], ["algo"]), "the same, wherever options stand"


@pytest.mark.unit
@pytest.mark.parametrize("chosen", ["choice(er,l2)", "glob([l2*,er],exclude=lwf)"])
def test_a_sweep_takes_what_hydra_offers_to_name_files(chosen, own, monkeypatch, capsys):
    ran = []

    def run(config, names, ranks):
        ran.append(names["algo"])
        raise ConfigError("a run begins")

    monkeypatch.setattr(experiment, "run", run)
    assert main(["train", "-m", f"algo={chosen}", "--config-dir", "own"]) == 2
    assert ran == ["er", "l2"]
    (folder,) = (own / "runs" / "sweep").iterdir()
    assert read_sweep(folder).planned == 2


@pytest.mark.unit
def test_a_single_run_takes_options_anywhere(own, capsys):
    for words in ("algo=l2 --config-dir own seed=7 --cfg job", "--cfg job algo=l2 -cd own seed=7"):
        assert main(["train", *words.split(), "algo.strength=3"]) == 0
        shown = OmegaConf.create(capsys.readouterr().out)
        assert (shown.algo.strength, shown.seed) == (3, 7)


@pytest.mark.unit
@pytest.mark.parametrize(
    ("words", "noted"),
    [
        ("policy=bc_rnn_small", True),
        ("policy=bc_vilt_small", True),
        ("policy=bc_transformer_small", True),
        ("policy=bc_rnn_small data.seq_len=2", False),
        ("policy=bc_mlp_small", False),
    ],
)
def test_a_policy_with_a_history_that_is_given_single_frames_says_so(words, noted, here, monkeypatch, capsys):
    def learn(*args):
        raise ConfigError("the first task begins")

    monkeypatch.setattr(experiment, "_run_sequence", learn)
    tiny = ("benchmark.tasks=1", "language=onehot", "device=cpu", "threads=1", "eval.episodes=1")
    assert main(["train", *tiny, *words.split()]) == 2
    policy, found = words.split()[0], capsys.readouterr().err
    note = f"note: {policy} learns and acts on single frames, as data.seq_len=1; data.seq_len=10 gives it"
    assert found.endswith("error: the first task begins\n") and (note in found) == noted


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
        assert main(words) == 2
        assert shown in capsys.readouterr().err


@pytest.mark.unit
def test_a_reader_that_has_seen_enough_is_no_error(monkeypatch, capfd):
    def write(task: str):
        raise BrokenPipeError

    with open(os.devnull, "w") as sink:
        monkeypatch.setattr(sys, "stdout", sink)
        monkeypatch.setattr("libero_env.tasks.get_task", write)
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
