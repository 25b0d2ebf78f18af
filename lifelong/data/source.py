"""What is read of a demonstration file, and the tensors that datasets make of it.

Shape legend: F frames, V views, H W C image, D size of a reading, A action, L language embedding.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from libero_env.demos.read import Episode, demo_lengths, iter_demos
from lifelong.errors import DataError
from lifelong.types import PolicySpec


@dataclass(frozen=True)
class DemoSource:
    """A demonstration file and what a policy takes from it.

    Attributes:
        path: HDF5 file in the original's layout, or a folder with the parts of one.
        spec: Views, readings, their sizes, and `seq_len`.
        limit: Largest number of demonstrations to read; None for all.
        pairing: `aligned` pairs each action with the observation before it; `stored` reads the file as it is, which
            in the original's files pairs it with the observation after it.
        labels: `expert` or `executed`, see `libero_env.demos.read.read_demos`.
    """

    path: Path
    spec: PolicySpec
    limit: int | None = None
    pairing: Literal["aligned", "stored"] = "aligned"
    labels: Literal["expert", "executed"] = "expert"

    @cached_property
    def lengths(self) -> list[int]:
        """Number of frames of each demonstration; only shapes are read, once.

        Raises:
            DemoError: The file is broken.
            DataError: There are no frames.
        """
        lengths = demo_lengths(self.path, self.limit, pairing=self.pairing)
        if not sum(lengths):
            raise DataError(f"{self.path} has no demonstration with two steps; pairing=aligned needs one")
        return lengths

    def nbytes(self) -> int:
        """Return the number of bytes of the images in memory."""
        height, width = self.spec.image_size
        return sum(self.lengths) * len(self.spec.views) * height * width * 3

    def demos(self) -> Iterator[Episode]:
        """Yield the demonstrations, with one in memory at a time.

        Raises:
            DemoError: The file is broken; the message names file, demonstration, key and what was expected.
            DataError: The file is valid but does not fit the spec.
        """
        keys = [*self.spec.views, *self.spec.proprio]
        for demo in iter_demos(self.path, keys, self.limit, pairing=self.pairing, labels=self.labels):
            check_fits(demo, self.spec, str(self.path))
            yield demo


def demo_tensors(demo: Episode, spec: PolicySpec) -> tuple[Tensor, dict[str, Tensor], Tensor]:
    """Return the tensors of a demonstration that fits the spec.

    Returns:
        Images, (F, V, H, W, C) uint8, upright; readings, name to (F, D) float32; actions, (F, A) float32.
    """
    images = torch.from_numpy(np.stack([demo.obs[view] for view in spec.views], axis=1))
    floats = {name: demo.obs[name] for name in spec.proprio} | {"": demo.actions}
    tensors = {name: torch.from_numpy(np.asarray(x, dtype=np.float32)) for name, x in floats.items()}
    return images, tensors, tensors.pop("")


def last_frames(lengths: list[int]) -> Tensor:
    """Return for each frame the index of the last frame of its demonstration, (F,) int64."""
    counts = torch.tensor(lengths, dtype=torch.int64)
    return (counts.cumsum(0) - 1).repeat_interleave(counts)


def check_fits(demo: Episode, spec: PolicySpec, source: str) -> None:
    """Check that a demonstration fits the spec.

    Raises:
        DataError: It does not; the message names `source`, demonstration, key and what was expected.
    """
    expected: dict[str, tuple[int, ...]] = dict.fromkeys(spec.views, (*spec.image_size, 3))
    expected |= {name: (size,) for name, size in spec.proprio.items()}
    where = f"{source}: {demo.name}"
    if demo.actions.ndim != 2 or demo.actions.shape[1] != spec.action_dim:
        raise DataError(f"{where}/actions is {demo.actions.shape}; expected (T, {spec.action_dim})")
    for key, shape in expected.items():
        if key not in demo.obs:
            raise DataError(f"{where}/obs/{key} is missing; it has {', '.join(sorted(demo.obs))}")
        actual = demo.obs[key].shape
        if actual != (len(demo.actions), *shape):
            hint = ""
            if key in spec.views and len(actual) == 4:
                hint = f". Set the policy's image_size to {list(actual[1:3])}, or record at {list(shape[:2])}"
            raise DataError(
                f"{where}/obs/{key} is {actual}; the policy expects {(len(demo.actions), *shape)}{hint}"
            )
        if key in spec.views and demo.obs[key].dtype != np.uint8:
            raise DataError(f"{where}/obs/{key} is {demo.obs[key].dtype}; expected uint8 in 0..255")


def check_language(language: Tensor, spec: PolicySpec) -> Tensor:
    """Return the embedding of the instruction as (L,) float32.

    Raises:
        DataError: It has another size than the spec.
    """
    language = torch.as_tensor(language, dtype=torch.float32)
    if language.shape != (spec.language_dim,):
        raise DataError(
            f"the language embedding has shape {tuple(language.shape)}; the policy's spec expects "
            f"({spec.language_dim},). Choose the language encoder that the spec was made for"
        )
    return language
