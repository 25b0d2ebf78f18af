"""Every configuration file composes, binds to what it builds, and has no key that nothing reads."""

import ast
import dataclasses
import inspect
import textwrap
from functools import cache
from pathlib import Path

import pytest
from hydra.utils import get_object
from omegaconf import DictConfig, ListConfig, OmegaConf

import lifelong
from libero_env.errors import InvalidInputError
from lifelong.errors import ConfigError
from lifelong.evaluation.settings import EvalSettings
from lifelong.settings import GROUPS, RunSettings
from tests.harness.configs import CONFIGS, FILES, composed

GIVEN = {"policy": {"spec"}}  # what the experiment adds
COMPLETED = {"in_dim", "dim", "out_dim", "latent_dim", "max_length"}  # what policies add to their components


def nodes(config, path=""):
    """Every node with a `_target_`, with its path."""
    if isinstance(config, DictConfig):
        if "_target_" in config:
            yield path, config
        for key in config:
            yield from nodes(config[key], f"{path}.{key}" if path else str(key))
    elif isinstance(config, ListConfig):
        for i, value in enumerate(config):
            yield from nodes(value, f"{path}[{i}]")


def names_in(tree: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}


@cache
def attributes_read() -> set[str]:
    """Names of all attributes that the package reads, `self.x` in `__post_init__` left out."""
    found = set()
    for file in Path(lifelong.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name == "__post_init__":
                node.body.clear()
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                found.add(node.attr)
    return found


def unread(target: type) -> set[str]:
    """Parameters of a target that nothing reads."""
    if dataclasses.is_dataclass(target):
        return {f.name for f in dataclasses.fields(target)} - attributes_read()
    if target.__init__ is object.__init__:
        return set()
    source = ast.parse(textwrap.dedent(inspect.getsource(target.__init__)))
    return set(inspect.signature(target).parameters) - names_in(source)


def choice(file: Path) -> list[str]:
    """The overrides that compose a file."""
    if str(file.parent) == "compat/libero":  # chosen by two groups
        groups = [g for g in ("algo", "policy", "language") if (CONFIGS / g / file.name).is_file()]
        return ["compat=libero", *(f"{group}={file.stem}" for group in groups)]
    if file.parts[0] == "tuned":  # chosen by the policy's head and the algorithm
        return [f"policy/head={file.parent.name}", f"algo={file.stem.removesuffix('_sample')}"]
    option = f"{file.parent}={file.stem}"
    return ["algo=ewc", option] if str(file.parent) == "algo/estimator" else [option]


@pytest.mark.parametrize("file", FILES, ids=str)
def test_every_file_binds_to_its_target(file):
    config = composed(*choice(file))
    fields = {f.name for f in dataclasses.fields(RunSettings)}
    learner = {"learner"} if str(file) == "learner/grpo.yaml" else set()
    assert set(config) == set(GROUPS) - {"learner"} | learner | fields, "behaviour cloning has no settings"
    for path, node in nodes(config):
        target = get_object(node["_target_"])
        arguments = {k for k in node if k not in ("_target_", "_partial_")} | GIVEN.get(path, set())
        signature = inspect.signature(target)
        bind = signature.bind_partial if node.get("_partial_") else signature.bind
        bind(**dict.fromkeys(arguments))
        optional = {k for k, p in signature.parameters.items() if p.default is not p.empty}
        left_out = optional - arguments - COMPLETED if node.get("_partial_") else None
        assert not left_out, f"{path} leaves out {left_out}"
        assert not unread(target), f"{path}: {target.__name__} never reads {unread(target)}"


def test_every_group_has_a_target():
    config = composed("learner=grpo")
    assert {path for path, _ in nodes(config)} >= set(GROUPS)


def test_settings_at_the_top_are_read():
    assert not unread(RunSettings)


# another algorithm with one other choice
VARIANTS = {"lora_one": "lora", "phase_er": "er", "self_distillation": "lwf"}


@pytest.mark.parametrize("file", [f for f in FILES if str(f.parent) == "algo"], ids=str)
def test_an_algorithm_is_named_like_its_file(file):
    name = VARIANTS.get(file.stem, file.stem)
    module, _, kind = composed(f"algo={file.stem}").algo["_target_"].rpartition(".")
    assert module.removeprefix("lifelong.algorithms.").removeprefix("contrib.") == name
    assert kind.lower() == name.replace("_", "")


@pytest.mark.parametrize("preset", ["laptop", "smoke", "paper"])
def test_values_on_the_command_line_win_over_the_preset(preset):
    config = composed(f"preset={preset}", "train.epochs=3", "policy=bc_transformer", "data.demos=7")
    assert (config.train.epochs, config.data.demos, config.policy.encoder.width) == (3, 7, 64)


def test_the_paper_preset_is_the_published_protocol():
    config = composed("preset=paper")
    assert OmegaConf.to_container(config.train) == {
        "_target_": "lifelong.training.FitSettings", "epochs": 50, "batch_size": 32, "steps_per_epoch": None,
        "lr": 1e-4, "lr_min": 1e-5, "warmup_steps": 0, "betas": [0.9, 0.999], "weight_decay": 1e-4,
        "grad_clip": 100.0, "lr_every": "step", "last_batch": "filled", "statistics_first": False,
        "precision": "auto", "accumulate": 1, "compile": "off"
    }  # fmt: skip
    assert (config.data.demos, config.data.image_size, config.data.seq_len) == (50, 128, 10)
    e = config.eval
    assert (e.episodes, e.curve_episodes, e.every, e.horizon, e.settle_steps) == (20, 20, 5, 600, 5)


@pytest.mark.parametrize(("change", "message"), [
    ({"select": "worst"}, "expected 'best', 'first_best' or 'last'"),
    ({"selection": "apart", "episodes": 40, "curve_episodes": 20}, "need 60 initial states"),
    ({"episodes": 0}, "greater than or equal to 1"),
])  # fmt: skip
def test_invalid_evaluation_settings_are_named(change, message):
    with pytest.raises((ConfigError, InvalidInputError), match=message):
        EvalSettings(**change)


def test_a_curve_has_the_last_epoch():
    assert EvalSettings().curve_epochs(12) == (0, 5, 10, 12)


def test_forward_transfer_says_how_it_is_estimated():
    assert EvalSettings().transfer_estimate == "cross_fitted"
    assert EvalSettings(curve_episodes=1).transfer_estimate == "published"  # no start to choose by
    assert EvalSettings(curve_episodes=1, select="last").transfer_estimate == "plain"
