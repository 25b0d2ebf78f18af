"""The original's configuration: every file composes and binds, and every key is read or said to have no effect."""

import ast
import inspect
import re
from pathlib import Path

import hydra
import pytest
import yaml
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

import libero
from libero._adapters.config import CONFIGS, Config, assign, load_config, plain
from libero.lifelong.algos import get_algo_class
from libero.lifelong.models import get_policy_class
from libero.lifelong.models.modules import (
    data_augmentation,
    language_modules,
    rgb_modules,
    transformer_modules,
)
from libero.lifelong.models.policy_head import HEADS

GROUPS = ("data", "eval", "lifelong", "policy", "train")
PARTS = sorted(p.relative_to(CONFIGS / "policy") for p in CONFIGS.glob("policy/*/*.yaml"))
NETWORKS = {
    **data_augmentation.AUGMENTATIONS,
    **language_modules.ENCODERS,
    **HEADS,
    "ResnetEncoder": rgb_modules.ResnetEncoder,
    "PatchEncoder": rgb_modules.PatchEncoder,
    "SinusoidalPositionEncoding": transformer_modules.SinusoidalPositionEncoding,
}


def words() -> set[str]:
    """All attributes and texts in the package, also those that a prefix and an ending make, as f"{prefix}_dropout"."""
    found, endings = set(), set()
    root = Path(libero.__file__).parent
    for file in (*root.glob("lifelong/**/*.py"), *root.glob("_adapters/**/*.py")):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Attribute):
                found.add(node.attr)
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
            if isinstance(node, ast.JoinedStr) and len(node.values) == 2:
                endings |= {part.value for part in node.values[1:] if isinstance(part, ast.Constant)}
    table = (CONFIGS / "native.yaml").read_text()  # which keys of main.py are which of `libero train`
    found |= set(re.findall(r"\w+", table))
    return found | {word + ending for word in found for ending in endings if ending.startswith("_")}


def leaves(node, path=""):
    for key, value in node.items():
        inner = f"{path}.{key}" if path else key
        if isinstance(value, dict) and value and not key.endswith("kwargs"):
            yield from leaves(value, inner)
        else:
            yield inner, key


@pytest.mark.parametrize("group", GROUPS)
def test_every_key_is_read_or_listed(group):
    known = words()
    texts = [file.read_text() for file in CONFIGS.rglob("*.yaml")]
    idle = {key for text in texts for key in re.findall(r"(\w+):.*# without effect: ", text)}
    for file in (CONFIGS / group).glob("*.yaml"):
        config = load_config(f"{group}={file.stem}")
        for path, key in leaves(config):
            mapped = path.startswith(("data.obs_key_mapping.", "data.obs.modality."))
            assert key in idle or mapped or key in known, f"{file}: {path} is read nowhere"


@pytest.mark.parametrize("file", PARTS, ids=str)
def test_modules_bind(file):
    node = yaml.safe_load((CONFIGS / "policy" / file).read_text())
    signature = inspect.signature(NETWORKS[node["network"]])
    signature.bind_partial(**node["network_kwargs"], **node.get("loss_kwargs", {}))


def test_names_are_of_classes():
    for file in (CONFIGS / "lifelong").glob("*.yaml"):
        assert get_algo_class(yaml.safe_load(file.read_text())["algo"])
    for file in (CONFIGS / "policy").glob("*.yaml"):
        assert get_policy_class(yaml.safe_load(file.read_text())["policy_type"])


def test_composition_as_in_the_guides():
    hydra.core.global_hydra.GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        hydra_cfg = compose(config_name="config", overrides=["+reproduce_experiment=default_experiment"])
    cfg = Config(yaml.safe_load(OmegaConf.to_yaml(hydra_cfg)))
    assert (cfg.seed, cfg.policy.policy_type, cfg.train.n_epochs) == (100, "BCTransformerPolicy", 50)
    assert cfg.policy.policy_head.network_kwargs.num_modes == 5
    assert cfg.data.obs.modality.rgb == ["agentview_rgb", "eye_in_hand_rgb"]


def test_attributes_are_keys():
    cfg = Config({"a": {"b": [{"c": 1}]}}, d=2)
    cfg.a.e = {"f": 3}
    assert (cfg["a"].b[0].c, cfg.a.e.f, cfg.get("x"), "d" in cfg) == (1, 3, None, True)
    assert not hasattr(cfg, "experiment_dir")
    del cfg.d
    assert plain(cfg) == {"a": {"b": [{"c": 1}], "e": {"f": 3}}}
    with pytest.raises(AttributeError, match="no key 'd'"):
        cfg.d  # noqa: B018
    composed = OmegaConf.create({"a": 1})
    OmegaConf.set_struct(composed, True)
    assign(composed, "new", "x")
    assert composed.new == "x"


def test_hydras_state_is_restored():
    hydra.core.global_hydra.GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        load_config("lifelong=er")
        assert compose("config", ["lifelong=ewc"]).lifelong.algo == "EWC"
    assert not hydra.core.global_hydra.GlobalHydra.instance().is_initialized()
