"""Objects built from nodes of the configuration."""

from typing import Any

from hydra.utils import instantiate
from omegaconf import DictConfig


def build(node: DictConfig, **arguments: Any) -> Any:
    """Build the object that a node of the configuration describes, with plain lists and dictionaries inside.

    Args:
        node: Node with `_target_`, the dotted path of a class or function.
        arguments: Further keyword arguments of the target.
    """
    return instantiate(node, _convert_="all", _partial_=True)(**arguments)
