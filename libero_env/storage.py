"""The package's own YAML files."""

from importlib import resources
from typing import Any

import yaml

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # eight times as fast, where PyYAML has it


def parse_yaml(text: str) -> Any:
    """What a YAML text says; nothing in it is executed."""
    return yaml.load(text, Loader=_LOADER)


def read_yaml(path: str) -> Any:
    """What one of the package's files says; the path is relative to `libero_env`."""
    return parse_yaml(resources.files("libero_env").joinpath(*path.split("/")).read_text(encoding="utf-8"))


def show_bytes(count: float) -> str:
    """`1.5 GB`."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
