"""A run directory may be somebody else's: nothing that it names is executed, resolved, or written to."""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import yaml

from libero_cli.main import main
from libero_eval.repeating import repeated
from libero_eval.requests import EvalRequest
from lifelong.errors import CheckpointError, ConfigError
from lifelong.evaluation.restore import restore
from lifelong.settings import GROUPS, find_target
from tests.harness import configs
from tests.harness.configs import CONFIGS
from tests.harness.runs import make_run

HOSTILE = [
    *("os.system", "subprocess.run", "builtins.open", "builtins.exec", "torch.load", "torch.hub.load"),
    *("shutil.copyfile", "importlib.import_module", "pickle.loads", "hydra.utils.instantiate", "a", "", "..", "os."),
    *("lifelong.checkpoints.save", "lifelong.training.precision.subprocess.run",
     "lifelong.results.records.os.system"),
    *("lifelong.nn.heads.torch.load", "lifelong.nn.heads.torch.nn.Linear", "lifelong.data.dataset.Path"),
    *("libero_cli.main.main", "libero_cli.__main__.main", "lifelong.algorithms.er.ER.__init__", "lifelong"),
    *("lifelong.algorithms.er.ER.mro", "lifelong.settings.build", "lifelong.settings.configuration.find_target"),
    *("lifelong.policies.base.Policy.__subclasses__", "lifelong.language.encoder.np.load", "lifelong.nn"),
    *("libero_env.storage.atomic_path", "libero_eval.user_policy.load_callable", "lifelong.data.loading.Path"),
    *("lifelong.tracking.__builtins__", "lifelong.nn.augmentation.ABC", "lifelong.jobs.Job"),
]  # fmt: skip


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stranger") / "run"
    make_run(folder)
    return folder


@pytest.fixture
def changed(run):
    """A function that changes the saved configuration for the test."""
    file = run / "config.yaml"
    before = file.read_text()

    def change(**changes):
        file.write_text(yaml.safe_dump(configs.changed(yaml.safe_load(before), **changes)))
        return run

    yield change
    file.write_text(before)


@pytest.mark.parametrize("name", HOSTILE)
def test_other_code_is_not_reached(name):
    with pytest.raises(ConfigError):
        find_target(name, ())


def test_every_target_of_the_configuration_files_may_be_saved():
    for file in CONFIGS.rglob("*.yaml"):
        for line in file.read_text().splitlines():
            key, _, name = line.strip().removeprefix("- ").partition("_target_: ")
            if name and not key:
                assert find_target(name.split()[0], ()) is find_target(name.split()[0])


@pytest.mark.parametrize(
    "group", sorted({*GROUPS} - {"stream", "train", "augmentation", "tracker", "pretrain", "learner"})
)
@pytest.mark.parametrize("target", ["posix.mkdir", "libero_eval.user_policy.importlib.import_module"])
def test_a_strangers_run_executes_nothing(group, target, changed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = changed(**{group: {"_target_": target, "path": "made", "name": "made"}})
    for command in (["eval", str(folder)], ["serve", str(folder)], ["saliency", str(folder)]):
        assert main(command) == 2
    assert not (tmp_path / "made").exists()


def test_components_are_looked_at_too(changed, tmp_path, capsys):
    evil = {"_target_": "posix.mkdir", "path": str(tmp_path / "made")}
    places = ("policy__encoder", "policy__stochastic", "eval__episodes", "data__views", "language__model")
    for place in places:
        for value in (evil, [evil], {"within": evil}):
            assert main(["eval", str(changed(**{place: value}))]) == 2
            assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "made").exists()


def test_interpolations_are_texts(changed, monkeypatch, capsys):
    monkeypatch.setenv("SECRET", "hidden")
    run = changed(data__folder="${oc.env:SECRET}", language__model="${oc.env:SECRET}")
    assert main(["eval", str(run)]) == 2
    found = capsys.readouterr().err
    assert "hidden" not in found and "${oc.env:SECRET}" in found


def test_nothing_is_written_into_a_folder_that_a_configuration_names(changed, tmp_path):
    found = restore(changed(language__cache_dir=str(tmp_path / "cache")), device="cpu")
    assert found.language.cache_dir is None and not (tmp_path / "cache").exists()


@pytest.mark.parametrize(
    ("given", "key"),
    [
        ({"pretrained": "stranger/model"}, "pretrained"),
        ({"pretrained": "/tmp/model"}, "pretrained"),
        ({"type": "smolvla"}, "type"),
        ({"type": "a_new_one"}, "type"),
        ({"settings": {"vlm_model_name": "stranger/model"}}, "settings.vlm_model_name"),
        ({"settings": {"dim_model": 32, "tokenizer": {"path": ["gpt2"]}}}, "settings.tokenizer"),
        ({"settings": {"pretrained_backbone_weights": "ResNet18.DEFAULT"}}, "settings.pretrained_backbone"),
    ],
    ids=str,
)
def test_what_lerobot_would_load_needs_permission(run, changed, given, key, tmp_path, capsys):
    """Without it, LeRobot is not even imported: it is in no environment of this package."""
    policy = {"_target_": "libero_integrations.lerobot_policy.LeRobotPolicy", "type": "act", "settings": {}}
    more = {"act_steps": None, "language": True, "pretrained": None}
    path = changed() / "config.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), "policy": policy | more | given}))
    (run / "lerobot").mkdir(exist_ok=True)
    for command in (["eval"], ["serve"], ["saliency"], ["diagnose"], ["relearn"], ["view"]):
        assert main([*command, str(run)]) == 2
        assert f"policy.{key}" in (said := capsys.readouterr().err) and "--allow lerobot" in said
    (run / "lerobot").rmdir()
    if "pretrained" in given:
        with pytest.raises(CheckpointError, match="lerobot is missing, in which the run saved its policy"):
            restore(run, device="cpu", allow=["lerobot"])
        (run / "lerobot").symlink_to(tmp_path)
        with pytest.raises(CheckpointError, match="lerobot is a link"):
            restore(run, device="cpu", allow=["lerobot"])
        (run / "lerobot").unlink()


def test_a_checkpoint_elsewhere_is_not_the_runs(run, changed, tmp_path, capsys):
    file = changed() / "checkpoints" / "task_1.safetensors"
    kept = file.rename(tmp_path / "mine.safetensors")
    file.symlink_to(kept)
    try:
        for command in (["eval", str(run)], ["eval", str(file)], ["serve", str(run)], ["saliency", str(run)]):
            assert main(command) == 2
            assert "task_1.safetensors is a link that leads out of" in capsys.readouterr().err
        assert main(["check", str(run)]) == 1
        assert "is a link that leads out of" in capsys.readouterr().out
    finally:
        kept.replace(file)


def test_a_package_can_be_allowed_by_name(changed, tmp_path, monkeypatch):
    """Its own classes, not what it imports."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "__init__.py").write_text("")
    (tmp_path / "mine" / "algorithm.py").write_text(
        "import os\nfrom lifelong.algorithms.base import Algorithm\nclass Mine(Algorithm):\n    pass\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = changed(algo={"_target_": "mine.algorithm.Mine"})
    with pytest.raises(ConfigError, match="allow it with --allow mine"):
        restore(folder, device="cpu")
    assert "mine" not in sys.modules
    assert type(restore(folder, device="cpu", allow=["mine"]).algorithm).__name__ == "Mine"
    for other in ("mine.algorithm.os.mkdir", "mine_too.Mine", "mine"):
        with pytest.raises(ConfigError):
            restore(changed(algo={"_target_": other}), device="cpu", allow=["mine"])


def test_a_saved_policy_that_no_memory_holds_is_refused(changed):
    with pytest.raises(ConfigError, match="of memory, and there are .*the policy's weights"):
        restore(changed(policy__embed_dim=1_000_000, policy__temporal__mlp_dim=1_000_000), device="cpu")


@pytest.mark.parametrize(("changes", "message"), [
    ({"data": {"_target_": "lifelong.nn.GMMHead", "_partial_": True}}, "data builds a partial; expected"),
    ({"data": {"_target_": "lifelong.nn.TemporalLSTM", "in_dim": 10**6, "hidden": 10**6}},
     "data builds a TemporalLSTM; expected a"),
    ({"algo": {"_target_": "lifelong.algorithms.ER",
               "memory": {"_target_": "lifelong.nn.TemporalLSTM", "in_dim": 10**6, "hidden": 10**6}}},
     "algo.memory builds a TemporalLSTM; expected a"),
    ({"seed": "one"}, "seed is 'one'; expected a valid integer"),
])  # fmt: skip
def test_a_part_of_another_kind_is_refused_before_it_is_built(run, changed, changes, message):
    path = changed() / "config.yaml"
    path.write_text(yaml.safe_dump({**yaml.safe_load(path.read_text()), **changes}))
    with pytest.raises(ConfigError, match=message):
        restore(run, device="cpu")


def test_code_named_by_a_result_needs_permission(tmp_path, monkeypatch):
    result = argparse.Namespace(
        evaluated={}, policy="evil.part:make", tasks=[], unit_starts=1, environment={}, protocol={}
    )
    request = EvalRequest(policy=str(tmp_path))
    for kind in ("policy", "run", "server"):
        result.evaluated = {kind: "evil.part:make"}
        with pytest.raises(ConfigError, match="allow it with --allow evil"):
            repeated(request, result)
    assert repeated(replace(request, allow=("evil",)), result).policy == "evil.part:make"
