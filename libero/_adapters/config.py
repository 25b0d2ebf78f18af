"""The original's configuration, composed by Hydra from `libero/configs`."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

CONFIGS = Path(__file__).parents[1] / "configs"


class Config(dict):
    """Dictionary whose keys are attributes too; nested dictionaries are of the same class."""

    def __init__(self, values: Mapping[str, Any] | None = None, **more: Any):
        super().__init__({key: _wrap(value) for key, value in {**(values or {}), **more}.items()})

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, _wrap(value))

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"the configuration has no key {name!r}; it has {', '.join(self)}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value

    __delattr__ = dict.__delitem__


def load_config(*overrides: str) -> Config:
    """Compose the configuration from defaults and overrides such as `lifelong=er`, `seed=100`."""
    previous = copy.copy(GlobalHydra.instance())
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return Config(plain(compose("config", list(overrides))))
    finally:
        if previous.hydra is not None:
            GlobalHydra.instance().initialize(previous.hydra)


def plain(value: Any) -> Any:
    """Convert a configuration of any kind to plain dictionaries, lists and tuples; other objects become strings."""
    if isinstance(value, DictConfig | ListConfig):
        return OmegaConf.to_container(value, resolve=True)
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(plain(part) for part in value) if type(value) in (list, tuple) else list(value)
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def assign(node: Any, key: str, value: Any) -> None:
    """Set a key of a configuration of any kind, even if it is closed to new keys."""
    if isinstance(node, DictConfig):
        with open_dict(node):
            node[key] = value
    else:
        setattr(node, key, value)


def _wrap(value: Any) -> Any:
    if isinstance(value, Mapping) and not isinstance(value, Config):
        return Config(value)
    if type(value) in (list, tuple):
        return type(value)(_wrap(part) for part in value)
    return value
