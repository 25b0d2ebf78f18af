"""Settings of a run, and the gate through which every configuration passes before anything is built from it."""

from lifelong.data.settings import CAMERAS, DataSettings
from lifelong.settings.configuration import Configuration
from lifelong.settings.nodes import build, plain_data
from lifelong.settings.run import BenchmarkSettings, PretrainSettings, RunSettings

__all__ = [
    "CAMERAS",
    "BenchmarkSettings",
    "Configuration",
    "DataSettings",
    "PretrainSettings",
    "RunSettings",
    "build",
    "plain_data",
]
