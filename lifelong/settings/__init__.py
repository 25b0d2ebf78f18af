"""Settings of a run, and what is built from its configuration."""

from lifelong.data.settings import CAMERAS, DataSettings
from lifelong.settings.configuration import GROUPS, Configuration, build, find_target, plain_data
from lifelong.settings.run import BenchmarkSettings, PretrainSettings, RunSettings

__all__ = [
    "CAMERAS",
    "GROUPS",
    "BenchmarkSettings",
    "Configuration",
    "DataSettings",
    "PretrainSettings",
    "RunSettings",
    "build",
    "find_target",
    "plain_data",
]
