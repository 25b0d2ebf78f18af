"""A key that another one switches off is refused by name, whatever has chosen the other."""

import re

import pytest
import yaml
from omegaconf import OmegaConf

from libero_cli.main import main
from libero_env.tasks import get_suite
from lifelong.composition import compose_first, compose_run, config_folders
from lifelong.errors import ConfigError
from lifelong.settings import Configuration, plain_data
from lifelong.settings.obeyed import SWITCHED_OFF, require_obeyed
from lifelong.streams import plan_tasks
from lifelong.training.fit import check_warmup
from tests.harness.configs import composed

# conditions -> words under which they hold, words under which the keys exist and are read
WAYS = {
    "benchmark.tasks=1": ("benchmark.tasks=1", "benchmark.tasks=2"),
    "data.proprio=[]": ("data.proprio=[]", ""),
    "data.seq_len=1": ("policy=bc_rnn_small data.seq_len=1", "policy=bc_rnn_small data.seq_len=2"),
    "policy.head._target_=lifelong.nn.DeterministicHead": ("policy/head=deterministic_small", ""),
    "policy.stochastic=true": ("policy.stochastic=true", "policy.stochastic=false"),
    "policy.stochastic=false": ("", "policy.stochastic=true"),
    "policy.encoder.readout=flat": ("", "policy.encoder.readout=keypoints"),
    "policy.temporal.layers=0": ("policy.temporal.layers=0", ""),
    "language.model=onehot": ("language=onehot", "language=bert"),
    "language.model=minilm": ("language=minilm", "language=bert"),
    "train.steps_per_epoch!=null": ("preset=laptop", "preset=paper"),
    "train.epochs=1 train.lr_every=epoch": ("train.epochs=1 train.lr_every=epoch", "train.epochs=2"),
    "policy.encoder.norm!=batch": ("", "policy.encoder.norm=batch"),
    "eval.curve=none": ("eval.curve=none", ""),
    "eval.select!=last eval.curve_episodes=1": (
        "eval.select=best eval.curve_episodes=1",
        "eval.curve_episodes=1",
    ),
    "eval.backend!=mujoco": ("eval.backend=warp", ""),
    "augmentation.augmentations=[]": ("algo={} augmentation=none", "algo={}"),
    "learner._target_=lifelong.reward.grpo.GRPO": ("learner=grpo", ""),
    "algo.strength!=null": ("algo=ewc algo.strength=2", "algo=ewc"),
    "algo.strength=0": ("algo={} algo.strength=0", "algo={}"),
    "algo.adjustment=0": ("algo=mlr algo.adjustment=0", "algo=mlr"),
    "algo.candidates=1": ("algo=mir algo.candidates=1", "algo=mir"),
    "algo.discriminator_steps=0": ("algo=clare algo.discriminator_steps=0", "algo=clare"),
    "algo.recall_steps=0": ("algo=dmpel algo.recall_steps=0", "algo=dmpel"),
    "algo.factor=1": ("algo=slca algo.factor=1", "algo=slca"),
}
ALGORITHMS = {  # that have a key which several rows of the table name
    "algo.augment_reference": "agem",
    "algo.estimator.augment": "ewc",
    "algo.instruction": "lwf",
    "algo.windows": "mas",
    "algo.of": "mas",
    "algo.damping": "si",
    "algo.gamma": "ewc",
}


def configured(words):
    """Compose the groups among some words, each choice once, and set the values among them."""
    groups = [word for word in words if "." not in word]
    config = composed(*groups)
    for key, _, value in (word.partition("=") for word in words if word not in groups):
        OmegaConf.update(config, key, yaml.safe_load(value))
    return config


@pytest.mark.parametrize("conditions", SWITCHED_OFF)
def test_a_key_is_refused_where_nothing_reads_it(conditions):
    for key in SWITCHED_OFF[conditions].split():
        off, on = (configured(words.format(ALGORITHMS.get(key)).split()) for words in WAYS[conditions])
        require_obeyed(off, [])
        assert OmegaConf.select(on, key, default=Ellipsis) is not Ellipsis
        require_obeyed(on, [key])
        with pytest.raises(ConfigError) as error:
            require_obeyed(off, [key])
        assert str(error.value).startswith(f"{key} has no effect with ") and "\n" not in str(error.value)


def test_in_a_sweep_a_key_is_refused_where_no_job_reads_it():
    folders = config_folders()
    compose_first(["policy/head=deterministic_small,gmm_small", "policy.stochastic=true"], folders)
    compose_first(["preset=laptop,paper", "train.last_batch=short"], folders)
    with pytest.raises(ConfigError, match=r"policy.stochastic has no effect with policy.head="):
        compose_first(["policy/head=deterministic_small", "policy.stochastic=true,false"], folders)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("pretrain.suite=libero_object", "pretrain learns 10 of the run's tasks before their turn, such as"),
        ("pretrain.suite=libero_130 pretrain.tasks=[12]", "pretrain learns 1 of the run's tasks"),
        (
            "stream.base_tasks=10",
            "stream.base_tasks=10 joins all tasks, and joint training is algo=multitask",
        ),
        ("benchmark.tasks=2 benchmark.group_size=2 algo=er", "benchmark.group_size=2 joins all tasks"),
        ("benchmark.tasks=3 eval.until=[0.5,1] eval.curve=all eval.select=last", "eval.until has 2 entries"),
        ("algo=multitask eval.until=0.5 eval.select=last eval.curve=all", "eval.until has no effect"),
        ("eval.until=0.5 eval.select=best", "set eval.select=last, and a learning curve"),
        ("eval.held_out=libero_object", "eval.held_out=libero_object holds nothing out"),
    ],
)
def test_what_would_be_measured_as_something_else_is_refused(words, told):
    with pytest.raises(ConfigError, match=re.escape(told)):
        plan_tasks(Configuration(plain_data(compose_run(words.split())[0])))


@pytest.mark.parametrize(
    "words",
    [
        ["pretrain=libero_90"],
        ["stream.base_tasks=10", "algo=multitask"],
        ["benchmark.tasks=1", "eval.held_out=libero_object"],
    ],
)
def test_what_is_what_it_is_called_is_not(words):
    plan = plan_tasks(Configuration(plain_data(compose_run(words)[0])))
    assert set(plan.tasks) <= set(get_suite("libero_object").tasks)
    assert plan.held_out == (get_suite("libero_object").tasks[1:] if len(plan.tasks) == 1 else ())


@pytest.mark.parametrize(
    ("words", "windows"),
    [
        ("train.warmup_steps=1601", 0),  # of 8 epochs of 200 steps
        ("preset=paper train.epochs=2 train.warmup_steps=9", 100),  # of 2 epochs of 4 batches
        ("algo=packnet algo.post_prune_share=0.125 train.warmup_steps=201", 0),
    ],
)
def test_a_warm_up_that_never_ends_is_refused(words, windows):
    config = Configuration(plain_data(compose_run(words.split())[0]))
    fit, algorithm = config.build("train"), config.build("algo")
    with pytest.raises(ConfigError, match=r"train.warmup_steps is \d+, and a task has \d+ steps"):
        check_warmup(fit, algorithm, windows)
    object.__setattr__(fit, "warmup_steps", fit.warmup_steps - 1)
    check_warmup(fit, algorithm, windows)


@pytest.mark.parametrize("words", [["seed=1,2", "seed=3"], ["algo=er", "algo=ewc,si"]])
def test_a_key_of_a_sweep_that_is_given_twice_is_refused(words):
    with pytest.raises(ConfigError, match=f"{words[0]} and {words[1]}: .* is given twice; leave one of them"):
        compose_first(words, config_folders())


def test_a_key_that_one_job_of_a_sweep_does_not_have_is_told_with_those_it_has(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["libero"])
    assert main(["train", "-m", "algo=er,ewc", "algo.memory.budget=5"]) == 2
    said = capsys.readouterr().err
    assert "key of the configuration 'algo.memory.budget'" in said and "Valid: algo.estimator." in said
    assert main(["train", "hydra/launcher=joblib"]) == 2
    assert "hydra/launcher has no effect without -m" in capsys.readouterr().err
    assert not any(file.name == "job.json" for file in tmp_path.rglob("*"))
