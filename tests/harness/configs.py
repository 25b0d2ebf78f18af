"""The configuration files, and configurations composed from them."""

import copy
from functools import cache
from pathlib import Path

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

ROOT = Path(__file__).parents[2]


CONFIGS = ROOT / "configs"


FOUND = (f.relative_to(CONFIGS) for f in CONFIGS.rglob("*/*.yaml"))
FILES = sorted(f for f in FOUND if f.parts[0] != "hydra")  # launchers are of other packages


def composed(*overrides: str) -> DictConfig:
    return copy.deepcopy(_composed(*overrides))


@cache
def _composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return compose("config", [*overrides])
