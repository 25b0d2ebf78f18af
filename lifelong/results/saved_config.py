"""Saved configurations: read as plain data, and brought from the keys of earlier versions to those of today.

A run directory may be somebody else's, so nothing in its config.yaml is executed or resolved: a text with `${...}` is a
text.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError
from libero_env.storage import read_yaml_file
from lifelong.errors import ConfigError

Node = dict[str, Any]

# Earlier flat key -> key of the component. Keys that are not listed belong to the policy itself.
_RESNET = {
    "image_width": "width",
    "stage_blocks": "stage_blocks",
    "stem_kernel": "stem_kernel",
    "stem_stride": "stem_stride",
    "stem_pool": "stem_pool",
    "keypoints": "keypoints",
    "keypoint_temperature": "temperature",
    "readout": "readout",
    "norm": "norm",
}
_PATCHES = {
    "patch_width": "width",
    "stem_kernel": "stem_kernel",
    "stem_stride": "stem_stride",
    "patch": "patch",
    "norm": "norm",
}
_SPATIAL = {
    "spatial_layers": "layers",
    "spatial_heads": "heads",
    "spatial_head_dim": "head_dim",
    "spatial_mlp_dim": "mlp_dim",
    "dropout": "dropout",
}
_TRANSFORMER = {key: key for key in ("layers", "heads", "head_dim", "mlp_dim", "dropout")}
_LSTM = {"rnn_hidden": "hidden", "rnn_layers": "layers", "dropout": "dropout"}
_TRUNK = {"head_hidden": "hidden", "head_layers": "layers"}
_HEADS = {
    "deterministic": ("DeterministicHead", {**_TRUNK, "head_norm": "norm"}),
    "gmm": (
        "GMMHead",
        {
            **_TRUNK,
            "head_norm": "norm",
            "modes": "modes",
            "min_std": "min_std",
            "low_eval_noise": "low_eval_noise",
        },
    ),
    "flow": ("FlowHead", {**_TRUNK, "chunk": "chunk", "execute": "execute", "flow_steps": "steps"}),
}
_POLICIES = {
    "lifelong.policies.bc_transformer.BCTransformer": {
        "encoder": ("ResNetFiLMEncoder", _RESNET),
        "temporal": ("TemporalTransformer", _TRANSFORMER),
    },
    "lifelong.policies.bc_rnn.BCRNN": {
        "encoder": ("ResNetFiLMEncoder", _RESNET),
        "temporal": ("TemporalLSTM", _LSTM),
    },
    "lifelong.policies.bc_vilt.BCViLT": {
        "encoder": ("PatchEncoder", _PATCHES),
        "spatial": ("SpatialTransformer", _SPATIAL),
        "temporal": ("TemporalTransformer", _TRANSFORMER),
    },
}
# Keys that classes had not always, with the values by which they do as before; by the end of the class's name.
_DROPOUT = {"attention_dropout": None, "drop_path": 0.0}
_ADDED: Mapping[str, Mapping[str, Any]] = {
    "ResNetFiLMEncoder": {"stem_film": False, "pixels": "centred", "init": "identity"},
    "PatchEncoder": {"pixels": "centred", "rectify": True},
    "TemporalTransformer": _DROPOUT,
    "SpatialTransformer": _DROPOUT,
    "FitSettings": {"lr_every": "step", "last_batch": "filled", "statistics_first": False},
    "LanguageEncoder": {"numbered": False, "pad_to": 0},
    "FirstWindows": {"batch_size": None},
    "StreamSettings": {"perturb": None, "perturb_seed": 0},
}
_ER, _AGEM = "lifelong.algorithms.er.ER", "lifelong.algorithms.agem.AGEM"
_EWC, _PACKNET = "lifelong.algorithms.ewc.EWC", "lifelong.algorithms.packnet.PackNet"
_DMPEL = "lifelong.algorithms.dmpel.DMPEL"
_REPLAY = {_ER, _AGEM}


def read_saved_config(path: str | Path) -> Node:
    """Return the content of a run's or pretraining's config.yaml as it was saved; see `upgrade_config` for old keys.

    Args:
        path: File config.yaml.

    Raises:
        ConfigError: The file is missing, is not valid YAML, or holds no keys with values.
    """
    try:
        config = read_yaml_file(path).data
    except InvalidInputError as error:
        raise ConfigError(f"{error}; expected the configuration that a run has saved") from error
    if not isinstance(config, dict) or not config or not all(isinstance(key, str) for key in config):
        raise ConfigError(f"{path} is no configuration of a run: expected keys with values, such as seed: 1")
    return config


def upgrade_config(config: Mapping[str, Any]) -> Node:
    """Return the resolved configuration of a saved run with the keys of today.

    A configuration of today comes back unchanged, so that callers need not know its version.

    Args:
        config: A run's config.yaml, or the part of it that a pretraining keeps, as plain data; it is not modified.
    """
    upgrades: dict[str, Callable[[Mapping[str, Any]], Node]] = {
        "data": upgrade_data,
        "policy": upgrade_policy,
        "algo": upgrade_algorithm,
        "eval": upgrade_evaluation,
        "stream": upgrade_stream,
    }
    return {
        key: _with_added(upgrades[key](node) if key in upgrades and isinstance(node, Mapping) else node)
        for key, node in config.items()
        if key != "compat"
    }


def _with_added(node: Any) -> Any:
    """Return a node with the keys that its classes have got since it was saved."""
    if not isinstance(node, Mapping):
        return [_with_added(part) for part in node] if isinstance(node, list) else node
    target = str(node.get("_target_", ""))
    added = _ADDED.get(target.rpartition(".")[2], {}) if target.startswith("lifelong.") else {}
    return {**added, **{key: _with_added(value) for key, value in node.items()}}


def upgrade_data(node: Mapping[str, Any]) -> Node:
    """Return the node of the data with what was the only way before it had a key: drawing, robot, no copies.

    Args:
        node: The `data` node; one of today comes back unchanged.
    """
    copies = {"perturb": None, "perturb_copies": 1, "perturb_seed": 0}
    return {"drawing": "fast", "robot": "robosuite-1.4.1", **copies, **node}


def upgrade_evaluation(node: Mapping[str, Any]) -> Node:
    """Return the node of the evaluation with what was always so before it could be chosen.

    Args:
        node: The `eval` node; one of today comes back unchanged.
    """
    return {"curve": "all", "cells": "all", "reuse": True, "backend": "mujoco", "shift": None, **node}


def upgrade_stream(node: Mapping[str, Any]) -> Node:
    """Return the node of the stream with the base stage that there was none of before it had a key.

    Args:
        node: The `stream` node; one of today comes back unchanged.
    """
    return {"base_tasks": None, **node}


def upgrade_policy(node: Mapping[str, Any]) -> Node:
    """Return the node of a policy with components in place of flat keys such as `image_width` and `head_hidden`.

    Args:
        node: The `policy` node, all of its keys or some; nodes of other policies and of today come back unchanged.
    """
    components, head = dict(_POLICIES.get(str(node.get("_target_")), {})), node.get("head", "gmm")
    if not components or not isinstance(head, str) or head not in _HEADS:
        return dict(node)
    components["head"] = _HEADS[head]
    flat = {"head", *(key for _, keys in (*components.values(), *_HEADS.values()) for key in keys)}
    upgraded = {key: value for key, value in node.items() if key not in flat}
    for name, (target, keys) in components.items():
        values = {new: node[old] for old, new in keys.items() if old in node}
        upgraded[name] = {"_target_": f"lifelong.nn.{target}", "_partial_": True, **values}
    return upgraded


def upgrade_algorithm(node: Mapping[str, Any]) -> Node:
    """Return the node of an algorithm with components in place of `compat` and of the keys that went with it.

    Args:
        node: The `algo` node; nodes of other algorithms and of today come back unchanged.
    """
    target = str(node.get("_target_"))
    if target == _DMPEL:  # its weights of earlier versions are refused when they are loaded
        return {key: value for key, value in node.items() if key != "replay"}
    if target not in _REPLAY | {_EWC, _PACKNET} or {"memory", "estimator", "masks_only"} & set(node):
        return dict(node)
    upgraded = dict(node)
    libero = upgraded.pop("compat", None) == "libero"
    if target in _REPLAY:
        budget, per_task = upgraded.pop("budget", 10_000), upgraded.pop("per_task", 1000)
        kind, windows = ("FirstWindows", per_task) if libero else ("ReplayMemory", budget)
        upgraded["memory"] = {"_target_": f"lifelong.data.memory.{kind}", "budget": windows}
    if target == _AGEM:
        upgraded["augment_reference"] = libero
    if target == _EWC:
        upgraded["estimator"] = _estimator(upgraded, libero)
    if target == _PACKNET:
        upgraded["masks_only"] = libero
    return upgraded


def _estimator(node: Node, libero: bool) -> Node:
    """Take EWC's earlier keys out of its node; return the estimator that they describe."""
    kind = node.pop("fisher", None) or ("batch" if libero else "per_sample")
    windows, batch_size = node.pop("fisher_windows", None), node.pop("fisher_batch_size", 32)
    if windows is None:
        windows = 0 if libero else 512
    estimator = {"windows": windows, "augment": libero}
    if kind == "per_sample":
        return {"_target_": "lifelong.algorithms.importance.SampleFisher", **estimator}
    return {"_target_": "lifelong.algorithms.importance.BatchFisher", **estimator, "batch_size": batch_size}
