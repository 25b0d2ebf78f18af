"""Keys that another key switches off: who writes one of them is told so, whatever file has chosen the other."""

from collections.abc import Collection

import yaml
from omegaconf import DictConfig, OmegaConf

from lifelong.errors import ConfigError

# Conditions, all of which hold -> the keys that nothing reads then. Of a key that is not there, none holds. What values
# alone tell, as of `stream.blur_reach` without `stream.blur`, is refused where settings are built.
SWITCHED_OFF = {
    "benchmark.tasks=1": "benchmark.order_seed",
    "data.proprio=[]": "policy.normalise_proprio policy.proprio_dropout",
    "data.seq_len=1": "policy.memory",
    "policy.head._target_=lifelong.nn.DeterministicHead": "policy.stochastic",
    "policy.stochastic=true": "policy.head.acts",
    "policy.stochastic=false": "policy.head.low_eval_noise",
    "policy.encoder.readout=flat": "policy.encoder.temperature",
    "policy.temporal.layers=0": " ".join(
        f"policy.temporal.{key}"
        for key in ("heads", "head_dim", "mlp_dim", "dropout", "attention_dropout", "drop_path")
    ),
    "language.model=onehot": "language.cache_dir language.numbered language.pad_to",
    "language.model=minilm": "language.pad_to",
    "train.steps_per_epoch!=null": "train.last_batch",
    "train.epochs=1 train.lr_every=epoch": "train.lr_min",
    "policy.encoder.norm!=batch": "train.statistics_first",
    "eval.curve=none": "eval.curve_episodes eval.every eval.selection eval.transfer",
    "eval.select!=last eval.curve_episodes=1": "eval.transfer",
    "eval.backend!=mujoco": "eval.sim_threads eval.beside",
    "augmentation.augmentations=[]": "algo.augment_reference algo.estimator.augment",
    "learner._target_=lifelong.reward.grpo.GRPO": "augmentation",
    "algo.strength!=null": "algo.estimator.strength",
    "algo.strength=0": "algo.instruction algo.windows algo.of algo.damping algo.gamma",
    "algo.adjustment=0": "algo.margin",
    "algo.candidates=1": "algo.rate",
    "algo.discriminator_steps=0": "algo.discriminator_lr",
    "algo.recall_steps=0": "algo.recall_lr",
    "algo.factor=1": "algo.slow algo.base_tasks",
}
_ABSENT = object()


def require_obeyed(config: DictConfig, keys: Collection[str], varied: Collection[str] = ()) -> None:
    """Check that none of some keys is switched off by another.

    Args:
        config: The composed configuration, with its interpolations.
        keys: Keys that the user has written, such as `eval.every`.
        varied: Keys and groups of which other jobs of a sweep have others: what they decide is not checked.

    Raises:
        ConfigError: Nothing would read one of them.
    """
    for conditions, unread in SWITCHED_OFF.items():
        found = [key for key in unread.split() if key in keys]
        if found and all(_holds(config, one, varied) for one in conditions.split()):
            told = " and ".join(conditions.replace("._target_", "").split())
            raise ConfigError(f"{found[0]} has no effect with {told}; leave it out, or change the other")


def _holds(config: DictConfig, condition: str, varied: Collection[str]) -> bool:
    name, _, text = condition.partition("=")
    key = name.rstrip("!")
    value = OmegaConf.select(config, key, default=_ABSENT)
    if value is _ABSENT or any(
        one in ("preset", "compat") or key.startswith(one.replace("/", ".")) for one in varied
    ):
        return False
    return (value == yaml.safe_load(text)) != name.endswith("!")
