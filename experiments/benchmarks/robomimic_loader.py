"""robomimic's dataset, timed; a worker of loader_speed.py that needs torch and robomimic only.

    python robomimic_loader.py FILE VIEWS LOW_DIM SEQ_LEN BATCH REPEATS    (two JSON lists of keys)

The last line of its output is a JSON list of rows: name, windows per second of wall time and of CPU time.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator

import torch
from robomimic.utils import obs_utils
from robomimic.utils.dataset import SequenceDataset
from torch.utils.data import DataLoader, Dataset

TASK_EMBEDDING = 768


class WithTask(Dataset):
    """The original's wrapper: each sample also holds the task's embedding."""

    def __init__(self, windows: SequenceDataset):
        self.windows, self.embedding = windows, torch.zeros(TASK_EMBEDDING)

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> dict:
        return {**self.windows[index], "task_emb": self.embedding}


def endless(loader: DataLoader) -> Iterator[dict]:
    """Batches, pass after pass."""
    while True:
        yield from loader


def measured(name: str, step: Callable[[], object], windows: int, repeats: int) -> tuple[str, float, float]:
    """Windows per second of a call, after one to warm up."""
    step()
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        step()
    total = windows * repeats
    return name, total / (time.perf_counter() - wall), total / (time.process_time() - cpu)


def main(path: str, rgb: str, low_dim: str, seq_len: str, batch: str, repeats: str) -> None:
    """Measure both ways in which robomimic can keep a file."""
    torch.set_num_threads(1)
    views, readings, size, count = json.loads(rgb), json.loads(low_dim), int(batch), int(repeats)
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": readings, "rgb": views}})
    rows = []
    for mode, where in (("low_dim", "pictures from the file"), ("all", "everything in memory")):
        windows = SequenceDataset(
            hdf5_path=path,
            obs_keys=(*views, *readings),
            dataset_keys=("actions",),
            seq_length=int(seq_len),
            hdf5_cache_mode=mode,
            hdf5_use_swmr=False,
            load_next_obs=False,
        )
        draws = torch.Generator().manual_seed(0)
        batches = endless(DataLoader(WithTask(windows), size, shuffle=True, drop_last=True, generator=draws))
        rows.append(measured(f"robomimic, {where}", lambda b=batches: next(b), size, count))
    seen = next(batches)["obs"]
    rows.append(
        measured("robomimic, conversion to float32", lambda: obs_utils.process_obs_dict(seen), size, count)
    )
    print(json.dumps(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
