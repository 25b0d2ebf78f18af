"""What is read of a demonstration file, and in which form the windows want it."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from libero_env.demos.read import Demo, demo_lengths, iter_demos
from lifelong.errors import DataError
from lifelong.types import PolicySpec


@dataclass(frozen=True)
class DemoSource:
    """A demonstration file and what a policy takes from it.

    Attributes:
        path: HDF5 in the original's layout.
        spec: Which views and readings, their sizes, and `seq_len`.
        limit: The first so many demonstrations only.
        pairing: `aligned` pairs each action with the observation before it; `stored` takes the file as it is,
            which in the original's files is the observation after it.
        labels: `expert` or `executed`, see `libero_env.demos.read.read_demos`.
    """

    path: Path
    spec: PolicySpec
    limit: int | None = None
    pairing: Literal["aligned", "stored"] = "aligned"
    labels: Literal["expert", "executed"] = "expert"

    def lengths(self) -> list[int]:
        """Frames of each demonstration, from the file's headers alone."""
        return demo_lengths(self.path, self.limit, pairing=self.pairing)

    def nbytes(self) -> int:
        """Bytes that the pictures take in memory."""
        height, width = self.spec.image_size
        return sum(self.lengths()) * len(self.spec.views) * height * width * 3

    def demos(self) -> Iterator[Demo]:
        """The demonstrations, one in memory at a time.

        Raises:
            DemoError: The file is broken; names file, demonstration, key and what was expected.
            DataError: The file is sound but does not fit the spec.
        """
        keys = [*self.spec.views, *(self.spec.proprio or ())]
        for demo in iter_demos(self.path, keys, self.limit, pairing=self.pairing, labels=self.labels):
            check_fits(demo, self.spec, str(self.path))
            yield demo


@dataclass(frozen=True)
class DemoArrays:
    """A demonstration as windows store it."""

    images: Tensor  # (F, V, H, W, C) uint8, upright
    proprio: dict[str, Tensor]  # name -> (F, D) float32
    actions: Tensor  # (F, A) float32

    @classmethod
    def of(cls, demo: Demo, spec: PolicySpec) -> "DemoArrays":
        """Those of a demonstration that fits the spec."""
        images = torch.from_numpy(np.stack([demo.obs[view] for view in spec.views], axis=1))
        proprio = {name: _floats(demo.obs[name]) for name in spec.proprio or ()}
        return cls(images, proprio, _floats(demo.actions))


def last_frames(lengths: list[int]) -> Tensor:
    """(F,) int64: of each frame, the last one of its demonstration."""
    counts = torch.tensor(lengths, dtype=torch.int64)
    return (counts.cumsum(0) - 1).repeat_interleave(counts)


def check_fits(demo: Demo, spec: PolicySpec, source: str) -> None:
    """Raises DataError when a demonstration does not fit the spec."""
    expected: dict[str, tuple[int, ...]] = dict.fromkeys(spec.views, (*spec.image_size, 3))
    expected |= {name: (size,) for name, size in (spec.proprio or {}).items()}
    where = f"{source}: {demo.name}"
    if demo.actions.ndim != 2 or demo.actions.shape[1] != spec.action_dim:
        raise DataError(f"{where}/actions is {demo.actions.shape}; expected (T, {spec.action_dim})")
    for key, shape in expected.items():
        if key not in demo.obs:
            raise DataError(f"{where}/obs/{key} is missing; it has {', '.join(sorted(demo.obs))}")
        found = demo.obs[key].shape
        if found != (len(demo.actions), *shape):
            hint = ""
            if key in spec.views and len(found) == 4:
                hint = f". Set the policy's image_size to {list(found[1:3])}, or record at {list(shape[:2])}"
            raise DataError(
                f"{where}/obs/{key} is {found}; the policy expects {(len(demo.actions), *shape)}{hint}"
            )
        if key in spec.views and demo.obs[key].dtype != np.uint8:
            raise DataError(f"{where}/obs/{key} is {demo.obs[key].dtype}; expected uint8 in 0..255")


def check_language(language: Tensor, spec: PolicySpec) -> Tensor:
    """The embedding as (L,) float32; raises DataError where it is not what the policy was made for."""
    language = torch.as_tensor(language, dtype=torch.float32)
    if language.shape != (spec.language_dim,):
        raise DataError(
            f"the language embedding has shape {tuple(language.shape)}; the policy's spec expects "
            f"({spec.language_dim},). Choose the language encoder that the spec was made for"
        )
    return language


def _floats(array: np.ndarray) -> Tensor:
    return torch.from_numpy(np.asarray(array, dtype=np.float32))
