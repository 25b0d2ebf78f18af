"""The original's configuration, composed by Hydra from `libero/configs`, and the options of its evaluation."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from pydantic.dataclasses import dataclass

from libero_env.cli.options import Positive
from libero_env.text import flatten

CONFIGS = Path(__file__).parents[1] / "configs"

# key without effect -> what to do instead; most had none in the original either
NO_EFFECT: Mapping[str, str] = {
    "load_previous_model": "pretrain_model_path names the initial weights",
    "data.data_modality": "data.obs.modality lists the observations",
    "data.frame_stack": "data.seq_len is the length of the history",
    "data.max_word_len": "instructions are never truncated",
    "data.state_dim": "proprioceptive inputs have the sizes of the demonstration files",
    "data.num_kp": "the number of keypoints follows from the size of the image embedding",
    "data.shuffle_task": "data.task_order_index chooses one of the published orders",
    "data.affine_translate": "policy.translation_aug.network_kwargs.translation is used",
    "data.action_scale": "actions are not scaled",
    "data.train_dataset_ratio": "all demonstrations are used for training",
    "train.debug": "train.n_epochs=1 eval.n_eval=1 makes a short run",
    "eval.load_path": "lifelong.eval evaluates stored checkpoints",
}


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


def notes(cfg: Any) -> list[str]:
    """Return one line for each key that was changed but has no effect."""
    current, usual = flatten(plain(cfg)), flatten(load_config())
    changed = [key for key in NO_EFFECT if current.get(key, usual[key]) != usual[key]]
    return [f"{key}={current[key]} has no effect: {NO_EFFECT[key]}" for key in changed]


def _wrap(value: Any) -> Any:
    if isinstance(value, Mapping) and not isinstance(value, Config):
        return Config(value)
    if type(value) in (list, tuple):
        return type(value)(_wrap(part) for part in value)
    return value


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Measure the success of a stored policy on a task.

    Attributes:
        experiment_dir: Folder of the runs.
        benchmark: Name of the benchmark, such as libero_object.
        task_id: Position of the task in the benchmark.
        algo: Algorithm of the run.
        policy: Policy of the run.
        seed: Seed of the run.
        ep: Epoch of a multitask run's checkpoint (default: the last).
        load_task: Last task before the checkpoint of another run (default: task_id).
        run: Number of the run (default: the newest).
        device_id: Number of the GPU, if there is one.
        n_eval: Number of episodes (default: as in the run).
        max_steps: Maximum steps of an episode (default: as in the run).
        save_videos: Write a video of each episode.
    """

    experiment_dir: Path = Path("experiments")
    benchmark: str
    task_id: int
    algo: Literal["agem", "base", "er", "ewc", "multitask", "packnet", "single_task"]
    policy: Literal["bc_rnn_policy", "bc_transformer_policy", "bc_vilt_policy"]
    seed: int
    ep: int | None = None
    load_task: int | None = None
    run: Positive | None = None
    device_id: int = 0
    n_eval: Positive | None = None
    max_steps: Positive | None = None
    save_videos: bool = False
