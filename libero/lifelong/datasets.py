"""The original's datasets of demonstrations: windows as dictionaries of tensors.

Shape legend: T time, C H W image, D dimension of a proprioceptive input, A action, L language embedding.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import ConcatDataset, Dataset, Subset

from libero._adapters.batches import image_tensor
from libero_env.demos.contents import check_demo, demo_names, subset_names
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.read import demo_files, read_demos
from libero_env.errors import DemoError
from lifelong.data import SequenceVLDataset as Windows
from lifelong.types import PolicySpec

_VIEWS, _LOW_DIM = ["agentview_rgb", "eye_in_hand_rgb"], ["gripper_states", "joint_states"]
_DEFAULT_KEYS: dict[str, list[str]] = {"rgb": _VIEWS, "depth": [], "low_dim": _LOW_DIM}


class SequenceDataset(Dataset):
    """All windows of a demonstration file: one begins at every frame, and past the end the last frame repeats.

    A window is `{"obs": {view: (T, C, H, W) in [0, 1] bottom row first, proprioceptive input: (T, D)}, "actions":
    (T, A)}`. Frames are in memory as uint8.

    Attributes:
        n_demos: Number of demonstrations.
        total_num_sequences: Number of windows.
    """

    def __init__(self, windows: Windows, views: Sequence[str], frame_stack: int = 1):
        self.windows, self.views, self.frame_stack = windows, tuple(views), frame_stack
        ends, lengths = torch.unique_consecutive(windows.last, return_counts=True)
        self._first = (ends - lengths + 1).repeat_interleave(lengths)
        self.n_demos, self.total_num_sequences = len(ends), len(windows)
        self.seq_length = windows.seq_len

    def __len__(self) -> int:
        return self.total_num_sequences

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = range(len(self))[index]
        w, steps = self.windows, torch.arange(1 - self.frame_stack, self.seq_length)
        frames = (index + steps).clamp(int(self._first[index]), int(w.last[index]))
        images = w.images[frames].flip(-3)  # (T, V, H, W, C)
        obs = {view: image_tensor(images[:, k]) for k, view in enumerate(self.views)}
        obs.update({name: values[frames] for name, values in w.proprio.items()})
        return {"actions": w.actions[frames[self.frame_stack - 1 :]], "obs": obs}


class SequenceVLDataset(Dataset):
    """Windows with the embedding of their task's instruction, (L,), under `task_emb`."""

    def __init__(self, sequence_dataset: Any, task_emb: Tensor):
        self.sequence_dataset, self.task_emb = sequence_dataset, task_emb
        self.n_demos, self.total_num_sequences = getattr(sequence_dataset, "n_demos", 0), len(self)

    def __len__(self) -> int:
        return len(self.sequence_dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {**self.sequence_dataset[index], "task_emb": self.task_emb}


class GroupedTaskDataset(Subset):
    """Windows of several tasks that are learned together, each with its task's embedding.

    The tasks take turns: the first window of each, the second of each, and so on, as long as a task has any.
    """

    def __init__(self, sequence_datasets: Sequence[Dataset], task_embs: Sequence[Tensor]):
        parts = [SequenceVLDataset(*pair) for pair in zip(sequence_datasets, task_embs, strict=True)]
        places = sorted((i, task) for task, part in enumerate(parts) for i in range(len(part)))
        starts = np.cumsum([0, *map(len, parts)])
        super().__init__(ConcatDataset(parts), [int(starts[task]) + i for i, task in places])
        self.sequence_datasets, self.task_embs = list(sequence_datasets), task_embs
        self.group_size = self.task_group_size = len(parts)
        self.n_demos, self.total_num_sequences = sum(part.n_demos for part in parts), len(self)


class TruncatedSequenceDataset(Subset):
    """First `buffer_size` windows of a dataset, or all if it has fewer."""

    def __init__(self, sequence_dataset: Any, buffer_size: int):
        self.sequence_dataset = sequence_dataset
        self.buffer_size = min(int(buffer_size), len(sequence_dataset))
        super().__init__(sequence_dataset, range(self.buffer_size))


def get_dataset(
    dataset_path: str | Path,
    obs_modality: Mapping[str, Sequence[str]] | Sequence[str],
    initialize_obs_utils: bool = True,
    seq_len: int = 1,
    frame_stack: int = 1,
    filter_key: str | None = None,
    hdf5_cache_mode: str | None = "low_dim",
) -> tuple[SequenceDataset, dict[str, Any]]:
    """Read the windows of a demonstration file; actions are paired with observations as they are stored.

    Args:
        dataset_path: HDF5 file in the original's layout.
        obs_modality: Keys of the observation under `rgb` and `low_dim`; or a list of these two, for the default keys.
        initialize_obs_utils: Without effect: there is no global state.
        seq_len: Number of steps of a window, T.
        frame_stack: Number of frames at the first step: observations begin `frame_stack - 1` frames before the window.
        filter_key: Subset of the demonstrations in the file's group `mask`.
        hdf5_cache_mode: Without effect: images are in memory as uint8.

    Returns:
        The windows, and the shapes that a policy is built from: `ac_dim`, `all_shapes` (key -> shape),
        `all_obs_keys`, `use_images`, and `obs.rgb_shape`.

    Raises:
        DemoError: The file does not exist, is broken, or lacks a key or the subset.
    """
    views, proprio, depths = (_keys(obs_modality, kind) for kind in ("rgb", "low_dim", "depth"))
    if depths:
        raise DemoError(
            f"depth images ({', '.join(depths)}) are not supported; leave obs_modality['depth'] empty"
        )
    path = Path(dataset_path)
    shapes = _shapes(path, [*views, *proprio])
    spec = PolicySpec(
        views=tuple(views),
        image_size=tuple(shapes[views[0]][:2]) if views else (0, 0),  # type: ignore[arg-type]
        proprio={name: shapes[name][0] for name in proprio},
        language_dim=1,
        seq_len=seq_len,
    )
    if filter_key is None:
        windows = Windows.from_file(path, spec=spec, language=torch.zeros(1), pairing="stored")
    else:
        with open_demo_file(path) as handle:
            names = set(subset_names(handle, path, filter_key))
        demos = read_demos(path, [*views, *proprio])
        chosen = [demo for demo in demos if demo.name in names]
        windows = Windows.from_demos(chosen, spec=spec, language=torch.zeros(1), source=str(path))
    all_shapes = dict.fromkeys(views, (3, *spec.image_size)) | {name: shapes[name] for name in proprio}
    shape_meta = {
        "ac_dim": spec.action_dim,
        "all_shapes": all_shapes,
        "all_obs_keys": [*views, *proprio],
        "use_images": bool(views),
        "obs": {"rgb_shape": (3, *spec.image_size)},
    }
    return SequenceDataset(windows, views, frame_stack), shape_meta


def _keys(obs_modality: Mapping[str, Sequence[str]] | Sequence[str], kind: str) -> list[str]:
    if isinstance(obs_modality, Mapping) or hasattr(obs_modality, "get"):
        return list(obs_modality.get(kind) or [])
    return _DEFAULT_KEYS[kind] if kind in obs_modality else []


def _shapes(path: Path, keys: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Return the shapes of one frame's observations."""
    file = next(iter(demo_files(path)), path)
    with open_demo_file(file) as handle:
        names = demo_names(handle, file)
        if not names:
            raise DemoError(f"{file}: it has no demonstrations")
        demo = handle["data"][names[0]]
        check_demo(demo, f"{file}: {names[0]}", keys)
        return {key: tuple(demo["obs"][key].shape[1:]) for key in keys}
