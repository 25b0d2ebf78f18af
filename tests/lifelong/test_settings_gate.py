"""Every key of a configuration is checked where its object is built, before anything is written or slow."""

import re
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any
from zipfile import ZipFile

import pytest
import torch
from omegaconf import OmegaConf

from libero_cli.main import main
from lifelong.algorithms.base import Algorithm
from lifelong.data.settings import DataSettings
from lifelong.errors import ConfigError
from lifelong.results.run_directory import RunDirectory
from lifelong.settings import GROUPS, Configuration, build, find_target, plain_data
from lifelong.training.distributed import Ranks
from lifelong.training.memory import check_memory, policy_bytes, training_needs
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec
from tests.harness.configs import MISSING, changed, composed

SPEC = PolicySpec(image_size=(64, 64), seq_len=2)


@pytest.fixture(scope="module")
def whole():
    return plain_data(composed("preset=smoke", "algo=er", "device=cpu"))


def checked(config):
    """Build all groups of a configuration."""
    config = Configuration(config)
    config.settings()
    return {
        group: config.build(group, **({"spec": SPEC} if group == "policy" else {}))
        for group in sorted(GROUPS)
        if group != "learner"  # behaviour cloning has no settings
    }


def leaves(node, *path):
    """Yield the path of every value of a configuration but the names of classes."""
    for key, value in node.items():
        if isinstance(value, dict):
            yield from leaves(value, *path, key)
        elif not key.startswith("_"):
            yield (*path, key)


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("data.views", [], "should have at least 1 item"),
        ("data.perturb_copies", 2, "data.perturb_copies has no effect without data.perturb"),
        ("data.perturb_seed", 2, "data.perturb_seed has no effect without data.perturb"),
        ("stream.blur_reach", 2, "stream.blur_reach has no effect without stream.blur"),
        ("eval.cells_share", 0.5, "eval.cells_share has no effect without eval.cells=sampled"),
        ("eval.cells_seed", 2, "eval.cells_seed has no effect without eval.cells=sampled"),
        ("train.lr", 1e-5, "train.lr_min is 0.0001, above train.lr, 1e-05"),
    ],
)
def test_what_would_have_no_effect_is_refused(key, value, told, whole):
    with pytest.raises(ConfigError, match=re.escape(told)):
        checked(changed(whole, **{key.replace(".", "__"): value}))


@pytest.mark.parametrize("wrong", [{"a": {"b": 1}}, [[[1]]], float("inf"), 10**400])
def test_a_value_that_no_key_takes_is_told_with_its_key(wrong, whole):
    for path in leaves(whole):
        with pytest.raises(ConfigError) as error:
            checked(changed(whole, **{"__".join(path): wrong}))
        assert ".".join(path) in str(error.value) and "\n" not in str(error.value)


def test_an_unknown_key_anywhere_is_told_with_the_nearest(whole):
    for path in leaves(whole):
        if len(path[-1]) > 3 and len(path) > 1:
            misspelt = [*path[:-1], f"{path[-1]}s"]
            with pytest.raises(ConfigError) as error:
                checked(changed(whole, **{"__".join(misspelt): 1}))
            assert f"{'.'.join(misspelt)} is an unknown key. Did you mean" in str(error.value)


@pytest.mark.parametrize(("changes", "said"), [
    ({"seed": -1}, "seed is -1; expected greater than or equal to 0"),
    ({"seed": True}, "seed is True; expected a valid integer"),
    ({"seed": MISSING}, "seed is missing"),
    ({"run_id": "../../x"}, "run_id: '../../x' is not a name"),
    ({"trian": {}}, "trian is an unknown key. Did you mean 'train'?"),
    ({"train": MISSING}, "train is missing; choose a file of that group with train=NAME"),
    ({"train": {"lr": 1}}, "a file of that group is chosen with train=NAME"),
    ({"train__betas": [2, 0]}, "train.betas.0 is 2; expected less than 1"),
    ({"train__precision": "bf61"}, "expected 'auto', 'bf16', 'fp32' or 'fp32_strict'. Did you mean 'bf16'?"),
    ({"algo__memory": 5}, "algo.memory is 5; expected a component"),
    ({"algo__memory__budget": MISSING}, "algo.memory.budget is missing"),
    ({"algo__memory___target_": "lifelong.data.fake.FakeWindows"}, "algo.memory._target_ names"),
    ({"algo__memory___partial_": True}, "algo.memory builds a partial; expected a ReplayMemory"),
    ({"algo___target_": "builtins.dict"}, "algo builds a dict; expected a Algorithm"),
    ({"policy__encoder": []}, "policy.encoder is []; expected a component"),
    ({"policy__encoder": {"a": {"_target_": "lifelong.nn.GMMHead", "_partial_": True}}}, "policy.encoder is {'a'"),
    ({"policy__head": "gmm"}, "a file of that group is chosen with policy/head=gmm"),
    ({"policy__temporal___partial_": False}, "policy.temporal._partial_ is False; expected true"),
    ({"policy__temporal___target_": "lifelong.nn.GMMHead"}, "policy.temporal.heads is an unknown key"),
    ({"policy__temporal": {"_target_": "lifelong.nn.GMMHead", "_partial_": True}}, "does not take dim, max"),
    ({"policy__stochastic": {"_target_": "builtins.bool"}}, "policy.stochastic is {'_target_'"),
])  # fmt: skip
def test_what_is_wrong_is_said_with_key_value_and_what_is_valid(changes, said, whole):
    with pytest.raises(ConfigError, match=re.escape(said)) as error:
        checked(changed(whole, **changes))
    assert "\n" not in str(error.value)


def test_whose_classes_a_group_names_is_asked_of_a_group_that_is_there(whole):
    assert Configuration(whole).is_own("policy")
    with pytest.raises(ConfigError, match="policy is missing; choose a file"):
        Configuration({key: value for key, value in whole.items() if key != "policy"}).is_own("policy")


@pytest.mark.parametrize("name", ["__main__", "a_module_made_in_a_cell"])
def test_a_class_of_a_notebook_is_found(name, tmp_path, monkeypatch):
    """The module `__main__` of an interactive session has no specification; a file of its name is another thing."""
    session = ModuleType(name)
    session.Mine = dict
    monkeypatch.setitem(sys.modules, name, session)
    monkeypatch.chdir(tmp_path)  # which is not in sys.path
    assert session.__spec__ is None and find_target(f"{name}.Mine") is dict
    (tmp_path / "__main__.py").touch()
    monkeypatch.setattr(session, "__file__", "a_script.py", raising=False)
    assert find_target(f"{name}.Mine") is dict


def test_a_module_in_an_archive_is_found(tmp_path, monkeypatch):
    with ZipFile(tmp_path / "mine.zip", "w") as archive:
        archive.writestr("a_zipped_policy.py", "class Mine: pass")
    monkeypatch.syspath_prepend(tmp_path / "mine.zip")
    assert find_target("a_zipped_policy.Mine") is find_target("a_zipped_policy.Mine")
    del sys.modules["a_zipped_policy"]


def test_a_module_of_another_folder_that_is_loaded_already_is_refused(tmp_path, monkeypatch):
    for folder in ("mine", "theirs"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a_policy_of_both.py").write_text("class Mine: pass\n")
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path / "mine")
    first = find_target("a_policy_of_both.Mine")
    assert find_target("a_policy_of_both.Mine") is first
    sys.path.remove(str(tmp_path / "mine"))
    monkeypatch.chdir(tmp_path / "theirs")
    with pytest.raises(ConfigError, match="imported a_policy_of_both from .*mine.*, which is not .*theirs"):
        find_target("a_policy_of_both.Mine")
    del sys.modules["a_policy_of_both"]


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
    assert vars(built) == {"rate": 0.5, "anything": [1, {"a": None}], "device": "cuda:1", "part": Part(3)}
    for change, said in [
        ({"rate": "a"}, "algo.rate is 'a'; expected a valid number"),
        ({"raet": 1}, "algo.raet is an unknown key. Did you mean 'rate'?"),
        ({"part": {**own["part"], "size": "x"}}, "algo.part.size is 'x'; expected a valid integer"),
    ]:
        with pytest.raises(ConfigError, match=re.escape(said)):
            Configuration(changed(whole, algo={**own, **change})).build("algo")
    node = {"_target_": f"{__name__}.Loose", "size": "any", "other": 2}
    loose = Configuration(changed(whole, algo=node)).build("algo")
    assert (loose.size, loose.more) == ("any", {"other": 2})


def test_users_may_name_any_function():
    node = {"_target_": "builtins.dict", "_partial_": True, "a": {"_target_": "builtins.list"}}
    assert build(OmegaConf.create(node))(b=2) == {"a": [], "b": 2}


@pytest.mark.parametrize("device", ["meta", "cuda:99", "vulkan", "", "cuda:-1", "cpu:x", "cuda:" + "9" * 40])
def test_devices_that_hold_nothing_are_refused(device):
    with pytest.raises(ConfigError, match="device"):
        Ranks().device(device)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["libero"])
    return tmp_path


def test_a_bad_job_of_a_sweep_leaves_the_others_running(here, monkeypatch, capsys):
    ran = []

    def opened(self, *args, **kwargs):
        ran.append(self.path.name)
        raise ConfigError("a run begins")

    monkeypatch.setattr(RunDirectory, "opened", opened)
    assert main(["train", "-m", "preset=smoke", "device=cpu", "train.lr=-1,0.1", "seed=1,2"]) == 2
    assert ran == ["bc_transformer_small_seed1_lr0.1", "bc_transformer_small_seed2_lr0.1"]
    assert capsys.readouterr().err.count("error: train.lr is -1; expected greater than or equal to 0") == 2


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
    frame = 128 * 128 * 3
    batch = 3 * 64 * 10 * frame  # a byte, and two in half precision
    assert set(needs.values()) == {batch, 20 * frame, 4 << 20, 50 * 20 * frame}
    check_memory(needs, available=1 << 40)
    with pytest.raises(ConfigError, match=r"at least .*, and there are 1\.0 MB: 94\.4 MB for a batch"):
        check_memory(needs, available=1 << 20)


def test_the_estimate_counts_demonstrations_only_where_they_are_in_memory():
    for memory, count in (("auto", 2), ("disk", 2), ("host", 3)):
        data = DataSettings(50, 128, 10, ["agentview_rgb"], [], memory=memory)
        assert len(training_needs(data, FitSettings(), None, demos=50, episodes=20, replayed=0.0)) == count
