"""Every key of a configuration passes one gate before anything is built, written or slow."""

import copy
import os
import re
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from libero_env.cli.main import main
from lifelong import experiment
from lifelong.algorithms.base import Algorithm
from lifelong.data.settings import DataSettings
from lifelong.errors import ConfigError
from lifelong.results.run_directory import RunDirectory
from lifelong.settings import Configuration, build, plain_data
from lifelong.training.distributed import Ranks
from lifelong.training.memory import Need, check_memory, policy_bytes, training_needs
from lifelong.training.settings import FitSettings
from tests.harness.configs import composed

pytestmark = pytest.mark.unit
MISSING = object()


@pytest.fixture(scope="module")
def whole():
    return plain_data(composed("preset=smoke", "algo=er", "device=cpu"))


def changed(config, **changes):
    config = copy.deepcopy(config)
    for key, value in changes.items():
        *parents, last = key.split("__")
        node = config
        for parent in parents:
            node = node[parent]
        if value is MISSING:
            del node[last]
        else:
            node[last] = value
    return config


def test_a_valid_configuration_passes(whole):
    Configuration(whole).check()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seed": "abc"}, "seed is 'abc'; expected a whole number"),
        ({"seed": -1}, "seed is -1; expected at least 0"),
        ({"seed": 1.5}, "seed is 1.5; expected a whole number"),
        ({"seed": True}, "seed is True; expected a whole number"),
        ({"seed": MISSING}, "seed is missing"),
        ({"resume": "no"}, "resume is 'no'; expected true or false"),
        ({"threads": 10**8}, "threads is 100000000; expected at most 4096"),
        ({"runs_dir": "a\0b"}, "runs_dir: 'a\\x00b' is no path"),
        ({"run_id": "../../x"}, "run_id: '../../x' is no name"),
        ({"run_id": "a/b"}, "run_id: 'a/b' is no name"),
        ({"foo": 1}, "foo is an unknown key. Valid: seed,"),
        ({"trian": {}}, "trian is an unknown key. Did you mean 'train'?"),
        ({"train": MISSING}, "train is missing; choose a file of that group with train=NAME"),
        ({"train": 5}, "train is 5; expected keys with values"),
        ({"train": {"lr": 1}}, "train._target_ is missing"),
        ({"train__lr": -1}, "train.lr is -1; expected at least 0"),
        ({"train__lr": float("nan")}, "train.lr is nan; expected a finite number"),
        ({"train__lr": float("inf")}, "train.lr is inf; expected a finite number"),
        ({"train__lr": 10**400}, "train.lr is inf; expected a finite number"),
        ({"train__lr": [1]}, "train.lr is [1]; expected a number"),
        ({"train__epochs": 1.5}, "train.epochs is 1.5; expected a whole number"),
        ({"train__epochs": 10**5000}, "train.epochs is inf; expected a whole number"),
        ({"train__betas": [2, 0]}, "train.betas.0 is 2; expected below 1"),
        ({"train__betas": [0.9]}, "train.betas is [0.9]; expected at least 2 entries"),
        ({"train__precision": "bf61"}, "expected one of 'auto', 'bf16' or 'fp32'. Did you mean 'bf16'?"),
        ({"train__foo": 1}, "train.foo is an unknown key. Valid: epochs,"),
        ({"eval__horizon": 1.5}, "eval.horizon is 1.5; expected a whole number"),
        ({"eval__sim_threads": -1}, "eval.sim_threads is -1; expected at least 0"),
        ({"data__views": None}, "data.views is None; expected a list"),
        ({"data__views": "agentview_rgb"}, "data.views is 'agentview_rgb'; expected a list"),
        ({"data__robot": "liber"}, "Did you mean 'libero'?"),
        ({"data__demos": 10**9}, "data.demos is 1000000000; expected at most 100000"),
        ({"benchmark__tasks": []}, "benchmark.tasks is []; expected"),
        ({"benchmark__order": -1}, "benchmark.order is -1; expected at least 0"),
        ({"stream__blur": 1}, "stream.blur is 1; expected below 1"),
        ({"wandb__mode": "onlin"}, "Did you mean 'online'?"),
        ({"language__dim": 10**9}, "language.dim is 1000000000; expected at most 1000000"),
        ({"augmentation__pixels": -1}, "augmentation.pixels is -1; expected at least 0"),
        ({"algo__ratio": "abc"}, "algo.ratio is 'abc'; expected a number"),
        ({"algo__memory": 5}, "algo.memory is 5; expected a component"),
        ({"algo__memory__budget": 0}, "algo.memory.budget is 0; expected at least 1"),
        ({"algo__memory__budget": MISSING}, "algo.memory.budget is missing"),
        ({"algo__memory__budgt": 5}, "algo.memory.budgt is an unknown key. Did you mean 'budget'?"),
        (
            {"algo__memory___target_": "lifelong.nn.GMMHead"},
            "algo.memory._target_ is lifelong.nn.GMMHead; expected",
        ),
        ({"algo__memory___partial_": True}, "algo.memory._partial_ is True; expected a whole ReplayMemory"),
        ({"algo__memory___target_": "no.such"}, "algo.memory._target_ names no.such, which cannot be found"),
        (
            {"algo___target_": "lifelong.policies.BCRNN"},
            "algo._target_ is lifelong.policies.BCRNN; expected a Algo",
        ),
        ({"policy__embed_dim": 10**9}, "policy.embed_dim is 1000000000; expected at most 1000000"),
        ({"policy__head": "gmm"}, "a file of that group is chosen with policy/head=gmm"),
        ({"policy__head__layers": 10**6}, "policy.head.layers is 1000000; expected at most 1000"),
        ({"policy__encoder": None}, "policy.encoder is None; expected a component"),
        ({"policy__encoder__norm": "grup"}, "Did you mean 'group'?"),
        ({"policy__temporal___partial_": False}, "policy.temporal._partial_ is False; expected true"),
        ({"policy__temporal___target_": "lifelong.nn.GMMHead"}, "which does not take dim, max_length"),
        (
            {"policy__stochastic": {"_target_": "builtins.bool"}},
            "policy.stochastic is {'_target_': 'builtins.bool'}",
        ),
    ],
)
def test_what_is_wrong_is_said_with_key_value_and_what_is_valid(changes, said, whole):
    with pytest.raises(ConfigError, match=re.escape(said)) as error:
        Configuration(changed(whole, **changes)).check()
    assert "\n" not in str(error.value)


def test_all_faults_are_listed(whole):
    config = changed(whole, seed="x", train__lr=-1, train__epochs=0, algo__memory__budget="a", foo=1)
    with pytest.raises(ConfigError) as error:
        Configuration(config).check()
    for key in (
        "seed is",
        "train.lr is",
        "train.epochs is",
        "algo.memory.budget is",
        "foo is an unknown key",
    ):
        assert key in str(error.value)


def test_a_truth_may_be_written_as_a_number(whole):
    Configuration(changed(whole, resume=1, policy__stochastic=0)).check()
    with pytest.raises(ConfigError, match="resume is 2; expected true or false"):
        Configuration(changed(whole, resume=2)).check()


@dataclass
class Part:
    size: int


class Own(Algorithm):
    """A user's algorithm: partly annotated, with a component and names that exist for type checkers only."""

    def __init__(
        self, *, rate: float, anything=None, device: torch.device | str = "cpu", part: Part | None = None
    ):
        self.rate, self.anything, self.device, self.part = rate, anything, device, part


class Loose(Algorithm):
    def __init__(self, *, size: "NoSuchName" = 1, **more: Any):  # noqa: F821
        self.size, self.more = size, more


def test_users_classes_are_checked_by_their_own_annotations(whole):
    own = {"_target_": f"{__name__}.Own", "rate": 0.5, "anything": [1, {"a": None}], "device": "cuda:1"}
    own["part"] = {"_target_": f"{__name__}.Part", "size": 3}
    built = Configuration(changed(whole, algo=own)).build("algo")
    assert (built.rate, built.anything, built.device, built.part) == (
        0.5,
        [1, {"a": None}],
        "cuda:1",
        Part(3),
    )
    for change, said in [
        ({"rate": "a"}, "algo.rate is 'a'; expected a number"),
        ({"raet": 1}, "algo.raet is an unknown key. Did you mean 'rate'?"),
        ({"part": {**own["part"], "size": "x"}}, "algo.part.size is 'x'; expected a whole number"),
    ]:
        with pytest.raises(ConfigError, match=re.escape(said)):
            Configuration(changed(whole, algo={**own, **change})).check()
    loose = Configuration(
        changed(whole, algo={"_target_": f"{__name__}.Loose", "size": "any", "other": 2})
    ).build("algo")
    assert (loose.size, loose.more) == ("any", {"other": 2})


def test_positional_and_partial_arguments_of_users():
    node = {"_target_": "builtins.dict", "_args_": [[["a", 1]]], "b": {"_target_": "builtins.list"}}
    assert build(OmegaConf.create(node)) == {"a": 1, "b": []}
    kept = build({"_target_": "builtins.dict", "_recursive_": False, "b": {"_target_": "builtins.list"}})
    assert kept == {"b": {"_target_": "builtins.list"}}
    assert build({"_target_": "builtins.dict", "_partial_": True, "a": 1})(b=2) == {"a": 1, "b": 2}


@pytest.mark.parametrize("device", ["meta", "cuda:99", "vulkan", "", "cuda:-1", "cpu:x", "cuda:" + "9" * 40])
def test_devices_that_hold_nothing_are_refused(device):
    with pytest.raises(ConfigError, match="device"):
        Ranks().device(device)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["libero"])
    return tmp_path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["seed=-1"], "seed is -1"),
        (["run_id=../../x"], "is no name"),
        (["~train"], "choose a file of that group with train=NAME"),
        (["device=meta"], "device is 'meta'"),
        (["train.lr=${nothing}"], "train.lr: Interpolation key 'nothing' not found"),
        (["train.lr=${train.lr}"], "train.lr: Recursive interpolation"),
        (["runs_dir=taken"], "taken is a file"),
        (["policy.encoder.width=17"], "17 channels cannot be normalised in groups of 8"),
        (["data.image_size=100000"], "of memory, and there are"),
        (["train.batch_size=1000000000"], "for a batch (train.batch_size=1000000000, data.seq_len=2"),
        (["=3"], "the configuration cannot be composed"),
        (["policy.head_hidden=5"], "Did you mean policy.head.hidden?"),
        (["algo=er", "algo.budget=5"], "Did you mean algo.memory.budget?"),
        (["policy.encoder.widht=5"], "Did you mean policy.encoder.width?"),
    ],
)
def test_a_bad_configuration_leaves_nothing_behind(words, said, here, capsys):
    (here / "taken").write_text("")
    assert main(["train", "preset=smoke", "device=cpu", *words]) == 2
    found = capsys.readouterr().err
    assert said in found and found.count("\n") == 1
    assert os.listdir(here) == ["taken"]


def test_a_bad_job_of_a_sweep_leaves_the_others_running(here, monkeypatch, capsys):
    ran = []

    def opened(self, *args, **kwargs):
        ran.append(self.path.name)
        raise ConfigError("a run begins")

    monkeypatch.setattr(RunDirectory, "opened", opened)
    assert main(["train", "-m", "preset=smoke", "device=cpu", "train.lr=-1,0.1", "seed=1,2"]) == 2
    assert ran == ["bc_transformer_small_seed1_lr0.1", "bc_transformer_small_seed2_lr0.1"]
    assert capsys.readouterr().err.count("error: train.lr is -1; expected at least 0") == 2


def test_what_runs_today_fits(whole):
    """The paper's configuration needs less than 2 GiB by this estimate, so a laptop runs it."""
    config = Configuration(plain_data(composed("preset=paper", "algo=er")))
    data, fit = config.build("data"), config.build("train")
    weights = policy_bytes(config, data.spec(384))
    built = config.build("policy", spec=data.spec(384))
    assert weights == sum(t.nbytes for t in (*built.parameters(), *built.buffers()))
    check_memory(training_needs(data, fit, weights, demos=50, episodes=20, replayed=1.0), available=2 << 30)


def test_measuring_a_policy_draws_nothing(whole):
    config = Configuration(whole)
    torch.manual_seed(0)
    policy_bytes(config, config.build("data").spec(384))
    drawn = torch.rand(3)
    torch.manual_seed(0)
    assert torch.equal(drawn, torch.rand(3))


def test_memory_that_there_is_not_is_refused_with_the_estimate():
    data = DataSettings(50, 128, 10, ["agentview_rgb"], [], memory="host")
    needs = training_needs(data, FitSettings(batch_size=64), 1 << 20, demos=50, episodes=20, replayed=0.0)
    assert {need.nbytes for need in needs} == {
        3 * 64 * 10 * 128 * 128 * 3,  # a byte, and two in half precision
        20 * 128 * 128 * 3,
        4 << 20,
        50 * 20 * 128 * 128 * 3,
    }
    check_memory(needs, available=1 << 40)
    with pytest.raises(ConfigError, match=r"at least .* of memory, and there are 1 MiB: 90 MiB for a batch"):
        check_memory(needs, available=1 << 20)
    with pytest.raises(ConfigError, match=r"this needs at least 9e.11 EiB"):
        check_memory([Need("much", 10**30)])


def test_the_estimate_counts_demonstrations_only_where_they_are_in_memory():
    for memory, count in (("auto", 2), ("disk", 2), ("host", 3)):
        data = DataSettings(50, 128, 10, ["agentview_rgb"], [], memory=memory)
        assert len(training_needs(data, FitSettings(), None, demos=50, episodes=20, replayed=0.0)) == count
    assert experiment.EXAMPLE_DIM == 384
