"""Windows of a demonstration file as robomimic reads them, the library that the original reads its data with."""

import contextlib
import io

import h5py
import numpy as np
import torch

from lifelong.data import DemoSource
from lifelong.types import Batch, Observation


def read_with_robomimic(source: DemoSource, language: torch.Tensor, task_id: int = 0) -> Batch:
    """All windows of a source, each read by robomimic's `SequenceDataset`.

    robomimic has no notion of pairings: for `aligned` windows of a file that pairs each action with the observation
    after it, windows of one more step are read, and observations and actions are taken one step apart.
    """
    from robomimic.utils import obs_utils
    from robomimic.utils.dataset import SequenceDataset

    spec = source.spec
    with h5py.File(source.path) as file:
        stated = file["data"].attrs.get("pairing", "libero")
        stated = stated.decode() if isinstance(stated, bytes) else stated
        labels = "expert_actions" if "expert_actions" in file["data/demo_0"] else "actions"
    labels = labels if source.labels == "expert" else "actions"
    shift = int(source.pairing == "aligned" and stated == "libero")
    rgb, low_dim = list(spec.views), list(spec.proprio)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": low_dim, "rgb": rgb}})
        windows = SequenceDataset(
            hdf5_path=str(source.path),
            obs_keys=(*rgb, *low_dim),
            dataset_keys=(labels,),
            seq_length=spec.seq_len + shift,
            hdf5_cache_mode="low_dim",
            hdf5_use_swmr=False,
            load_next_obs=False,
        )
    images, readings, actions, padding, start = [], {name: [] for name in low_dim}, [], [], 0
    for length in source.lengths:
        for first in range(length):
            raw = windows[start + first]
            steps = np.minimum(np.arange(spec.seq_len), length - 1 - first)
            images.append(np.stack([raw["obs"][view][steps][:, ::-1] for view in rgb], axis=1))
            for name in low_dim:
                readings[name].append(raw["obs"][name][steps])
            actions.append(raw[labels][steps + shift])
            padding.append(np.arange(spec.seq_len) > length - 1 - first)
        start += length + shift
    count = len(actions)
    floats = lambda rows: torch.from_numpy(np.stack(rows).astype(np.float32))  # noqa: E731
    observation = Observation(
        torch.from_numpy(np.stack(images)),
        {name: floats(rows) for name, rows in readings.items()},
        language.expand(count, -1),
    )
    task_ids, window_ids = torch.full((count,), task_id), torch.arange(count)
    return Batch(observation, floats(actions), task_ids, window_ids, torch.from_numpy(np.stack(padding)))
