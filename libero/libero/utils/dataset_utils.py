"""Facts about demonstration files."""

from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.read import demo_names, open_demo_file
from libero_env.errors import DemoError


def get_dataset_info(dataset_path: str | Path, filter_key: str | None = None, verbose: bool = True) -> dict:
    """Return number and lengths of demonstrations, range of actions, observation keys and attributes of a file.

    Args:
        dataset_path: HDF5 file.
        filter_key: Name of a subset in `mask`.
        verbose: Whether the facts are printed, without `structure`.

    Returns:
        Facts by name; `structure` holds the shapes of the arrays of each demonstration.

    Raises:
        DemoError: The file is not a demonstration file, or does not have the subset.
    """
    path = Path(dataset_path)
    with open_demo_file(path) as file:
        names, data = demo_names(file, path), file["data"]
        if filter_key is not None:
            names = _subset(file, filter_key)
        lengths = np.array([len(data[name]["actions"]) for name in names])
        actions = np.concatenate([data[name]["actions"][()] for name in names])
        info = {
            "demos": len(names),
            "transitions": int(lengths.sum()),
            "length_mean": float(lengths.mean()),
            "length_std": float(lengths.std()),
            "length_min": int(lengths.min()),
            "length_max": int(lengths.max()),
            "action_min": float(actions.min()),
            "action_max": float(actions.max()),
            "observations": {key: rows.shape[1:] for key, rows in data[names[0]].get("obs", {}).items()},
            "attributes": {key: value for key, value in data.attrs.items() if key != "bddl_file_content"},
            "structure": {name: _shapes(data[name]) for name in names},
        }
    for key, value in info.items() if verbose else ():
        if key != "structure":
            print(f"{key}: {value}")
    return info


def _subset(file: Any, filter_key: str) -> list[str]:
    """Return the names of the demonstrations in a subset."""
    if (masks := file.get("mask")) is None or filter_key not in masks:
        known = ", ".join(masks or ()) or "none"
        raise DemoError(f"{file.filename}: no subset {filter_key!r} in mask; valid: {known}")
    return [name.decode() for name in masks[filter_key][()]]


def _shapes(group: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in a group by path."""
    found: dict[str, tuple[int, ...]] = {}
    group.visititems(lambda name, item: found.update({name: item.shape}) if hasattr(item, "shape") else None)
    return found
