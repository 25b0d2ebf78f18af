"""Facts about demonstration files."""

from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.contents import check_demo, demo_names, file_attributes, read_values, subset_names
from libero_env.demos.hdf5 import open_demo_file
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
            names = subset_names(file, path, filter_key)
        if not names:
            raise DemoError(f"{path}: no demonstrations; expected at least data/demo_0")
        counts, ends = [], []
        for name in names:
            check_demo(data[name], f"{path}: {name}", ())
            actions = np.asarray(read_values(data[name], "actions", f"{path}: {name}", check=False))
            counts.append(len(actions))
            ends.append((actions.min(), actions.max()))
        lengths, (low, high) = np.array(counts), np.transpose(ends)
        structure = {name: _shapes(data[name]) for name in names}
        attributes, first = file_attributes(file, path), structure[names[0]]
    info = {
        "demos": len(names),
        "transitions": int(lengths.sum()),
        "length_mean": float(lengths.mean()),
        "length_std": float(lengths.std()),
        "length_min": int(lengths.min()),
        "length_max": int(lengths.max()),
        "action_min": float(low.min()),
        "action_max": float(high.max()),
        "observations": {key[4:]: shape[1:] for key, shape in first.items() if key.startswith("obs/")},
        "attributes": {key: value for key, value in attributes.items() if key != "bddl_file_content"},
        "structure": structure,
    }
    for key, value in info.items() if verbose else ():
        if key != "structure":
            print(f"{key}: {value}")
    return info


def _shapes(group: Any) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the arrays in a group by path."""
    shapes: dict[str, tuple[int, ...]] = {}
    group.visititems(lambda name, item: shapes.update({name: item.shape}) if hasattr(item, "shape") else None)
    return shapes
