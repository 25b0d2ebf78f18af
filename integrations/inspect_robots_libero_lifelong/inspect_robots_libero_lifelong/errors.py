"""Our errors as those of Inspect Robots."""

from collections.abc import Iterator
from contextlib import contextmanager

from inspect_robots.errors import ConfigError

from libero_env.errors import LiberoError


@contextmanager
def as_config_error() -> Iterator[None]:
    """Raise our errors as Inspect Robots' `ConfigError`, which its commands print as one line."""
    try:
        yield
    except LiberoError as error:
        raise ConfigError(str(error)) from error
