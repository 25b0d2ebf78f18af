"""Windows read through robomimic, the library that the original LIBERO reads its data with.

robomimic is optional: `pip install --no-deps robomimic termcolor` is enough, as only its dataset is used.
"""

import contextlib
import io
from typing import Any

import h5py
import numpy as np
import torch
from torch import Tensor

from libero_env.demos.contents import check_demo, demo_names, read_pairing
from libero_env.demos.hdf5 import open_demo_file, read_attribute
from libero_env.demos.read import demo_files
from lifelong.data.source import DemoSource, check_indices, check_language
from lifelong.errors import DataError
from lifelong.types import Batch, Observation


class RobomimicWindows:
    """The windows of `SequenceVLDataset`, each read by robomimic's `SequenceDataset` when it is requested.

    robomimic keeps the low-dimensional data in memory and reads images from the file, as in the original LIBERO. It
    repeats the last frame past the end of a demonstration, as `SequenceVLDataset` does. It has no notion of pairings:
    for `aligned` windows of a file that pairs each action with the observation after it, windows of one more step are
    read, and observations and actions are taken one step apart.
    """

    def __init__(
        self,
        source: DemoSource,
        *,
        language: Tensor,
        task_id: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Open a file.

        Args:
            source: What is read; a file, not a folder of parts.
            language: Embedding of the instruction, (L,).
            task_id: Position in the task sequence.
            device: Device of the batches.

        Raises:
            DemoError: The file is broken.
            DataError: The file does not fit the spec, or robomimic is not installed.
        """
        self.source, self.task_id, self.seq_len = source, task_id, source.spec.seq_len
        self.device = torch.device(device)
        self.language = check_language(language, source.spec)
        for _ in source.demos():  # raises DataError if one does not fit
            pass
        self._labels, self._shift = self._layout()
        self._windows = _sequence_dataset(source, self._labels, self.seq_len + self._shift)
        lengths = torch.tensor(source.lengths())
        self._steps = torch.cat([torch.arange(n) for n in lengths])  # (W,) first step of each window
        # (W,) number of frames after that step
        self._left = lengths.repeat_interleave(lengths) - 1 - self._steps
        starts = (lengths + self._shift).cumsum(0) - (lengths + self._shift)
        self._indices = starts.repeat_interleave(lengths) + self._steps  # (W,) index in robomimic's dataset

    def _layout(self) -> tuple[str, int]:
        """Return the key of the labels, and by how many steps actions and observations are apart."""
        files = demo_files(self.source.path)
        if files != [self.source.path]:
            raise DataError(f"{self.source.path}: robomimic reads single files; use data.backend=native")
        with open_demo_file(files[0]) as file:
            names = demo_names(file, files[0])
            self._check_all(file, names)
            names = names[: self.source.limit]
            labelled = {"expert_actions" in file["data"][name] for name in names}
            if self.source.labels == "expert" and len(labelled) > 1:
                raise DataError(
                    f"{files[0]}: only some demonstrations have expert_actions, which robomimic cannot read; "
                    "use data.labels=executed or data.backend=native"
                )
            expert = self.source.labels == "expert" and True in labelled
            shifted = self.source.pairing == "aligned" and read_pairing(file, files[0]) == "libero"
        return ("expert_actions" if expert else "actions"), int(shifted)

    def _check_all(self, file: h5py.File, names: list[str]) -> None:
        """Check what robomimic takes as it is: all demonstrations of the file, and the lengths that they state."""
        path = self.source.path
        if other := sorted(set(file["data"]) - set(names)):
            raise DataError(
                f"{path}: robomimic takes data/{other[0]} for a demonstration; use data.backend=native"
            )
        for name in names:
            group = file["data"][name]
            check_demo(group, f"{path}: {name}", [*self.source.spec.views, *self.source.spec.proprio])
            stated, steps = read_attribute(group, "num_samples", f"{path}: {name}"), len(group["actions"])
            if stated != steps:
                raise DataError(
                    f"{path}: {name} has {steps} steps and the attribute num_samples {stated}, which robomimic relies "
                    "on; use data.backend=native"
                )

    def __len__(self) -> int:
        """Return the number of windows, W."""
        return len(self._steps)

    @property
    def demos(self) -> int:
        """Number of demonstrations."""
        return len(self.source.lengths())

    def batch(self, indices: Tensor) -> Batch:
        """Return the windows of the given indices, (B,) int64 in [0, W), as one batch.

        Raises:
            DataError: An index is out of range.
        """
        indices = torch.as_tensor(indices, dtype=torch.int64, device="cpu")
        check_indices(indices, len(self))
        spec, windows = self.source.spec, [self._window(int(i)) for i in indices]
        views = [np.stack([w["obs"][view] for w in windows])[:, :, ::-1] for view in spec.views]
        images = torch.from_numpy(np.stack(views, axis=2))  # the file has OpenGL rows
        floats = lambda arrays: torch.from_numpy(np.stack(arrays).astype(np.float32))  # noqa: E731
        proprio = {name: floats([w["obs"][name] for w in windows]) for name in spec.proprio}
        observation = Observation(images, proprio, self.language.expand(len(indices), -1))
        actions = floats([w["actions"] for w in windows])
        task_ids = torch.full_like(indices, self.task_id)
        is_pad = self._left[indices][:, None] < torch.arange(self.seq_len)
        return Batch(observation, actions, task_ids, indices, is_pad).to(self.device)

    def _window(self, index: int) -> dict[str, Any]:
        """Return the arrays (T, ...) of a window: observations at its steps, actions `_shift` steps later."""
        raw = self._windows[int(self._indices[index])]
        steps = np.minimum(np.arange(self.seq_len), int(self._left[index]))
        keys = [*self.source.spec.views, *self.source.spec.proprio]
        observations = {key: raw["obs"][key][steps] for key in keys}
        return {"obs": observations, "actions": raw[self._labels][steps + self._shift]}


def _sequence_dataset(source: DemoSource, labels: str, steps: int) -> Any:
    """Return robomimic's dataset of a file; what robomimic prints is suppressed."""
    try:
        from robomimic.utils import obs_utils
        from robomimic.utils.dataset import SequenceDataset
    except ImportError as error:
        raise DataError(
            f"data.backend=robomimic needs robomimic ({error}): pip install --no-deps robomimic termcolor, or "
            "data.backend=native"
        ) from error
    rgb, low_dim = list(source.spec.views), list(source.spec.proprio)
    output = io.StringIO()
    try:
        with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
            # which keys are images is global in robomimic
            obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": low_dim, "rgb": rgb}})
            return SequenceDataset(
                hdf5_path=str(source.path),
                obs_keys=(*rgb, *low_dim),
                dataset_keys=(labels,),
                seq_length=steps,
                hdf5_cache_mode="low_dim",
                hdf5_use_swmr=False,
                load_next_obs=False,
            )
    except KeyError as error:
        raise DataError(
            f"{source.path}: robomimic needs something that the file does not have ({error}), such as the "
            "attribute num_samples of each demonstration; use data.backend=native"
        ) from error
