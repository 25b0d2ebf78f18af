from .configuration import GROUPS, Configuration, build, find_target, plain_data
from .run import CAMERAS, BenchmarkSettings, DataSettings, PretrainSettings, RunSettings

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
