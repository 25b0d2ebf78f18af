"""The configuration files, and configurations composed from them."""

import copy
import functools
import operator
import pickle
import warnings
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

ROOT = Path(__file__).parents[2]
CONFIGS = ROOT / "configs"
MISSING = object()  # in place of a value: the key is removed
FOUND = (f.relative_to(CONFIGS) for f in CONFIGS.rglob("*/*.yaml"))
FILES = sorted(f for f in FOUND if f.parts[0] != "hydra")  # launchers are of other packages


def changed(config: dict, **changes: Any) -> dict:
    """Return a plain configuration with other values; a name such as `algo__memory` is a path of keys."""
    config = copy.deepcopy(config)
    for key, value in changes.items():
        *parents, last = key.split("__")
        node = functools.reduce(operator.getitem, parents, config)
        if value is MISSING:
            del node[last]
        else:
            node[last] = value
    return config


def composed(*overrides: str) -> DictConfig:
    return pickle.loads(_composed(*overrides))


def chosen(group: str, name: str, *overrides: str) -> DictConfig:
    """Compose one file of a group, without the others: four times as fast."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*missing `_self_`")
        return pickle.loads(_composed(*overrides, primary=f"{group}/{name}"))[group]


@functools.cache
def _composed(*overrides: str, primary: str = "config") -> bytes:
    """Compose and pickle, which takes a sixteenth of the memory."""
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return pickle.dumps(compose(primary, [*overrides]))
