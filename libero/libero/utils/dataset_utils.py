"""What a file of demonstrations holds."""

from typing import Any

import h5py
import numpy as np


def get_dataset_info(
    dataset_path: str, filter_key: str | None = None, verbose: bool = True
) -> dict[str, Any]:
    """Number and lengths of demonstrations, range of actions, observation keys and attributes of a file.

    Args:
        dataset_path: HDF5 file.
        filter_key: name of a subset in `mask`.
        verbose: whether it is printed.
    """
    with h5py.File(dataset_path, "r") as file:
        data = file["data"]
        names = sorted(data) if filter_key is None else [n.decode() for n in file[f"mask/{filter_key}"][()]]
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
        }
    if verbose:
        for key, value in info.items():
            print(f"{key}: {value}")
    return info
