"""From a node of the configuration to an object."""

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig


def build(node: DictConfig, **more: Any) -> Any:
    """The object a node of the configuration describes, with plain lists and dictionaries inside."""
    return instantiate(node, _convert_="all", _partial_=True)(**more)
