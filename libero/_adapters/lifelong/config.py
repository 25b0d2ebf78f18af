"""The original's configuration: composed by Hydra from `libero/configs`, then a dictionary with attributes."""

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict

from libero_env.errors import UnknownNameError

CONFIGS = Path(__file__).parents[2] / "configs"

# Keys that change nothing: what to do instead. Most were read nowhere in the original either.
NO_EFFECT: Mapping[str, str] = {
    "load_previous_model": "pretrain_model_path names the weights to begin with",
    "data.data_modality": "data.obs.modality lists what is seen",
    "data.frame_stack": "data.seq_len is the history that policies see",
    "data.max_word_len": "instructions are never cut",
    "data.state_dim": "readings have the sizes of the demonstration files",
    "data.num_kp": "the number of keypoints follows from the size of the image embedding",
    "data.shuffle_task": "data.task_order_index chooses one of the published orders",
    "data.affine_translate": "policy.translation_aug.network_kwargs.translation is what is used",
    "data.action_scale": "actions are learned as they are",
    "data.train_dataset_ratio": "all demonstrations are learned from",
    "train.debug": "train.n_epochs=1 eval.n_eval=1 makes a short run",
    "eval.load_path": "lifelong.eval evaluates stored checkpoints",
}


class Config(dict):
    """A dictionary whose keys are attributes too; dictionaries inside are of the same kind."""

    def __init__(self, values: Mapping[str, Any] | None = None, **more: Any):
        super().__init__()
        for key, value in {**(values or {}), **more}.items():
            self[key] = value

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, _wrapped(value))

    def __getattr__(self, name: str) -> Any:
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"the configuration has no key {name!r}; it has {', '.join(self)}") from None

    def __setattr__(self, name: str, value: Any) -> None:
        self[name] = value

    def __delattr__(self, name: str) -> None:
        del self[name]

    def __deepcopy__(self, memo: dict[int, Any]) -> "Config":
        return Config({key: copy.deepcopy(value, memo) for key, value in self.items()})

    def __reduce__(self) -> tuple[Any, ...]:
        return Config, (dict(self),)


def load_config(*overrides: str) -> Config:
    """What the original's command line gives: defaults and overrides such as `lifelong=er`, `seed=100`."""
    held = copy.copy(GlobalHydra.instance())
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return Config(plain(compose("config", list(overrides))))
    finally:
        if held.hydra is not None:
            GlobalHydra.instance().initialize(held.hydra)


def plain(value: Any) -> Any:
    """The same with plain dictionaries and lists, whatever kind of configuration it is.

    Tuples stay tuples; what is neither plain nor a container becomes its text.
    """
    if isinstance(value, DictConfig | ListConfig):
        return OmegaConf.to_container(value, resolve=True)
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(plain(part) for part in value) if type(value) in (list, tuple) else list(value)
    return value if value is None or isinstance(value, str | int | float | bool) else str(value)


def assign(node: Any, key: str, value: Any) -> None:
    """Set a key of a configuration of any kind, also one that is closed to new keys."""
    if isinstance(node, DictConfig):
        with open_dict(node):
            node[key] = value
    else:
        setattr(node, key, value)


def notes(cfg: Any) -> list[str]:
    """One line for each key that was changed though it has no effect."""
    now, default = dict(_leaves(plain(cfg))), dict(_leaves(plain(load_config())))
    return [
        f"{key}={now[key]} has no effect: {why}"
        for key, why in NO_EFFECT.items()
        if key in now and now[key] != default.get(key)
    ]


def named(table: Mapping[str, Any], kind: str, name: str) -> Any:
    """An entry by its name, whatever its case.

    Raises:
        UnknownNameError: no such name; the message lists those there are.
    """
    for key, value in table.items():
        if key.lower() == str(name).lower():
            return value
    raise UnknownNameError(kind, name, sorted(table))


def _wrapped(value: Any) -> Any:
    if isinstance(value, Mapping) and not isinstance(value, Config):
        return Config(value)
    if type(value) in (list, tuple):
        return type(value)(_wrapped(part) for part in value)
    return value


def _leaves(node: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every key by its path. Lists are leaves."""
    if not isinstance(node, Mapping):
        yield path, node
        return
    for key, part in node.items():
        yield from _leaves(part, f"{path}.{key}" if path else str(key))


BENCHMARKS = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90", "libero_100")


ALGOS = {
    "base": "Sequential",
    "single_task": "SingleTask",
    "multitask": "Multitask",
    "er": "ER",
    "agem": "AGEM",
    "ewc": "EWC",
    "packnet": "PackNet",
}


POLICIES = {
    "bc_rnn_policy": "BCRNNPolicy",
    "bc_transformer_policy": "BCTransformerPolicy",
    "bc_vilt_policy": "BCViLTPolicy",
}
