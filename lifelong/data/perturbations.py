"""Perturbations as settings: a text such as `light=1,camera=0.3`, or kinds with severities."""

from collections.abc import Mapping

from libero_env.demos.config import rendered_perturbations
from libero_env.errors import LiberoError
from libero_env.perturbations import Perturbation, parse_perturbations
from lifelong.errors import ConfigError

# On a command line `stream.perturb={light:1}` needs no quotes within quotes, which a text with = does.
PerturbSetting = str | Mapping[str, float | int]


def read_perturbations(
    value: PerturbSetting | None, key: str, *, seed: int = 0, rendered: bool = False
) -> tuple[Perturbation, ...]:
    """Return the perturbations of a setting, in the order in which they are applied, without those of severity 0.

    Args:
        value: The setting; None for no perturbations.
        key: Its name, for error messages.
        seed: Seed of those that name none.
        rendered: Whether recorded demonstrations are to be rendered under them.

    Raises:
        ConfigError: A kind does not exist, a severity is out of range, or a kind cannot be rendered.
    """
    text = value if isinstance(value, str) else ",".join(f"{k}={v}" for k, v in (value or {}).items())
    try:
        found = tuple(one for one in parse_perturbations(text, seed) if one.severity)
        return rendered_perturbations(found) if rendered else found
    except LiberoError as error:
        raise ConfigError(f"{key} is {text!r}: {error}") from error
