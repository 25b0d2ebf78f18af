"""Memory of past tasks that stores their frames themselves as small pictures, within a number of bytes.

Shape legend: F frames, N windows, K instructions, T time, V views, H W C image, D size of a reading, A action, L
language embedding.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import reduce
from typing import Annotated, Any

import numpy as np
import torch
from PIL import Image
from pydantic import Field
from torch import Tensor

from lifelong.data.memory import TaskMemory, even_shares
from lifelong.data.windows import TaskWindows, divided
from lifelong.errors import DataError
from lifelong.types import Batch, Count, Observation

Quality = Annotated[int, Field(ge=0, le=100)]  # of WebP

_TENSORS = ("codes", "ends", "actions", "frames", "window_ids", "languages", "language_ids")
WINDOWS_FORM = {  # see `lifelong.checkpoints.check`
    **dict.fromkeys(_TENSORS, Tensor),
    "proprio": {str: Tensor},
    **dict.fromkeys(("task_id", "total", "views", "height", "width"), int),
}
COMPRESSED_FORM = {"budget": int, "tasks": {int: WINDOWS_FORM}}  # see `lifelong.checkpoints.check`
_CHUNK = 16  # windows that are read and compressed at a time


@dataclass(frozen=True, eq=False)
class CompressedWindows:
    """Windows of a task whose frames are compressed.

    A frame is one WebP picture of all views, one above the other. Frames are numbered in the order in which windows
    use them first, so the first windows need the first frames only.

    Attributes:
        codes: WebP files of the frames, one after the other, (bytes,) uint8.
        ends: End of each frame's file in `codes`, (F,) int32.
        proprio: Name to (F, D) float32.
        actions: (F, A) float32.
        frames: Frame at each step of each window, (N, T) int32.
        window_ids: Index of each window in its task's dataset, (N,) int32.
        languages: Embeddings of the instructions, (K, L) float32.
        language_ids: Instruction of each window, (N,) int32.
        task_id: Position in the task sequence.
        total: Number of windows of the task, of which these are a part.
        views: V.
        height: H, pixels.
        width: W, pixels.
    """

    codes: Tensor
    ends: Tensor
    proprio: Mapping[str, Tensor]
    actions: Tensor
    frames: Tensor
    window_ids: Tensor
    languages: Tensor
    language_ids: Tensor
    task_id: int
    total: int
    views: int
    height: int
    width: int

    def __len__(self) -> int:
        """Return the number of windows, N."""
        return len(self.frames)

    def nbytes(self) -> int:
        """Return the number of bytes of all tensors."""
        return sum(t.nbytes for t in (*(getattr(self, name) for name in _TENSORS), *self.proprio.values()))

    def within(self, budget: int) -> "CompressedWindows":
        """Return the first windows, as many as have at most `budget` bytes together."""
        last = self.frames.amax(1).cummax(0).values.long()  # (N,) last frame that the first windows need
        per_frame = self.ends.itemsize + sum(4 * x.shape[1] for x in (self.actions, *self.proprio.values()))
        per_window = 4 * (self.frames.shape[1] + 2)
        sizes = self.ends.long()[last] + (last + 1) * per_frame + torch.arange(1, len(last) + 1) * per_window
        return self._first(int((sizes + self.languages.nbytes <= budget).sum()), last)

    def _first(self, windows: int, last: Tensor) -> "CompressedWindows":
        frames = int(last[windows - 1]) + 1 if windows else 0
        part = {
            name: getattr(self, name)[:windows].clone() for name in ("frames", "window_ids", "language_ids")
        }
        part |= {name: getattr(self, name)[:frames].clone() for name in ("ends", "actions")}
        part["codes"] = self.codes[: int(self.ends[frames - 1]) if frames else 0].clone()
        return replace(self, proprio={k: v[:frames].clone() for k, v in self.proprio.items()}, **part)

    def pictures(self, frames: Tensor) -> Tensor:
        """Decode frames (n,), -> (n, V, H, W, C) uint8.

        Raises:
            DataError: A file is not a WebP picture of the views' size.
        """
        out = np.empty((len(frames), self.views * self.height, self.width, 3), np.uint8)
        codes = self.codes.numpy()
        for row, frame in enumerate(frames.tolist() if self.views else ()):
            start = int(self.ends[frame - 1]) if frame else 0
            out[row] = _decode(codes[start : int(self.ends[frame])].tobytes(), out.shape[1:])
        return torch.from_numpy(out).view(len(frames), self.views, self.height, self.width, 3)

    def batch(self, indices: Tensor, decoded: Tensor | None = None) -> Batch:
        """Return the windows of the given indices, (B,) int64 in [0, N), as one batch.

        Args:
            indices: The windows.
            decoded: All frames of `pictures`, if they are decoded already.
        """
        frames = self.frames[indices].long()
        if decoded is None:
            needed, places = frames.unique(return_inverse=True)
            images = self.pictures(needed)[places]
        else:
            images = decoded[frames]
        observation = Observation(
            images,
            {name: readings[frames] for name, readings in self.proprio.items()},
            self.languages[self.language_ids[indices].long()],
        )
        tasks = torch.full((len(indices),), self.task_id, dtype=torch.int64)
        is_pad = torch.zeros_like(frames, dtype=torch.bool)
        is_pad[:, 1:] = frames[:, 1:] == frames[:, :-1]  # frames are stored once
        return Batch(observation, self.actions[frames], tasks, self.window_ids[indices].long(), is_pad)

    def state_dict(self) -> dict[str, Any]:
        """Return all attributes, as tensors and numbers."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {**values, "proprio": dict(self.proprio)}

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "CompressedWindows":
        """Return the windows that have a state, on the CPU.

        Raises:
            DataError: Its parts contradict each other.
        """
        tensors = {name: state[name].cpu() for name in _TENSORS}
        proprio = {name: values.cpu() for name, values in state["proprio"].items()}
        windows = cls(**{**state, **tensors, "proprio": proprio})
        if not windows._is_whole():
            raise DataError(f"the compressed windows of task {windows.task_id} contradict each other")
        return windows

    def _is_whole(self) -> bool:
        """Return whether kinds and lengths of the tensors fit together, and indices are within what they count."""
        lengths = self.ends.diff(prepend=self.ends.new_zeros(1))
        per_frame, per_window = (self.actions, *self.proprio.values()), (self.window_ids, self.language_ids)
        return (
            self.codes.dtype == torch.uint8
            and self.codes.dim() == self.ends.dim() == 1
            and self.frames.dim() == self.languages.dim() == 2
            and all(x.dtype == torch.int32 for x in (self.ends, self.frames, *per_window))
            and all(x.is_floating_point() and x.dim() == 2 and len(x) == len(self.ends) for x in per_frame)
            and all(x.dim() == 1 and len(x) == len(self) for x in per_window)
            and min(len(self), self.height, self.width) > 0
            and min(self.views, int(lengths.min())) >= 0
            and int(self.ends[-1]) == len(self.codes)
            and _are_below(self.frames, len(self.ends))
            and _are_below(self.language_ids, len(self.languages))
        )


class _Packer:
    """Collects windows, and each of their frames once.

    Frames are told apart by their content, so it does not matter how a dataset's windows overlap.
    """

    def __init__(self, quality: int):
        self.quality, self.nbytes = quality, 0
        self.seen: dict[bytes, int] = {}
        self.instructions: dict[bytes, int] = {}
        self.codes: list[bytes] = []
        self.rows: dict[str, list[Tensor]] = {}

    def add(self, batch: Batch) -> None:
        """Add windows, on the CPU."""
        observation = batch.observation
        for window in range(len(batch)):
            frames = [self._frame(batch, window, step) for step in range(batch.actions.shape[1])]
            words = observation.language[window].numpy().tobytes()
            if words not in self.instructions:
                self.instructions[words] = len(self.instructions)
                self._keep("languages", observation.language[window])
            self._keep("frames", torch.tensor(frames, dtype=torch.int32))
            self._keep("window_ids", batch.window_ids[window].int())
            self._keep("language_ids", torch.tensor(self.instructions[words], dtype=torch.int32))

    def _frame(self, batch: Batch, window: int, step: int) -> int:
        """Return the number of a frame, which is compressed if it is new."""
        observation = batch.observation
        image, action = observation.images[window, step].numpy(), batch.actions[window, step]
        readings = {name: values[window, step] for name, values in observation.proprio.items()}
        content = b"".join(
            x.tobytes() for x in (image, action.numpy(), *(r.numpy() for r in readings.values()))
        )
        if content not in self.seen:
            self.seen[content] = len(self.seen)
            self.codes.append(_encode(image, self.quality))
            self.nbytes += len(self.codes[-1])
            self._keep("actions", action)
            for name, reading in readings.items():
                self._keep(f"proprio/{name}", reading)
        return self.seen[content]

    def _keep(self, name: str, row: Tensor) -> None:
        self.rows.setdefault(name, []).append(row.clone())

    def windows(self, like: Batch, total: int) -> CompressedWindows:
        """Return what was collected, of `total` windows; the names and sizes are those of a batch."""
        stacked = {name: torch.stack(rows) for name, rows in self.rows.items()}
        views, height, width = like.observation.images.shape[2:5]
        return CompressedWindows(
            codes=torch.from_numpy(np.frombuffer(b"".join(self.codes), np.uint8).copy()),
            ends=torch.tensor([len(code) for code in self.codes]).cumsum(0).int(),
            proprio={name: stacked.pop(f"proprio/{name}") for name in like.observation.proprio},
            task_id=int(like.task_ids[0]),
            total=total,
            views=views,
            height=height,
            width=width,
            **stacked,
        )


def compress(dataset: TaskWindows, order: Tensor, budget: int, quality: Quality) -> CompressedWindows:
    """Compress a task's windows, as many as have at most `budget` bytes together.

    Args:
        order: Indices of its windows, (n,) int64; the first ones are kept.
        budget: Largest number of bytes.
        quality: Quality of WebP.
    """
    packer, first = _Packer(quality), dataset.batch(order[:1])
    for indices in order.split(_CHUNK):
        packer.add(dataset.batch(indices).to("cpu"))
        if packer.nbytes > budget:
            break
    return packer.windows(first, len(dataset)).within(budget)


def _encode(image: np.ndarray, quality: int) -> bytes:
    """Return a frame's views (V, H, W, C), one above the other, as a WebP file; nothing of no views."""
    if not len(image):
        return b""
    file = io.BytesIO()
    Image.fromarray(image.reshape(-1, *image.shape[2:])).save(file, "WEBP", quality=quality)
    return file.getvalue()


def _decode(code: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return the picture (height, width, 3) in a WebP file; raise DataError if there is none of this shape."""
    try:
        with Image.open(io.BytesIO(code), formats=["WEBP"]) as picture:
            if (picture.height, picture.width, 3) == shape:
                return np.asarray(picture.convert("RGB"))
            content = f"{picture.width} x {picture.height} pixels"
    except (OSError, ValueError) as error:
        content = f"no readable picture ({error})"
    raise DataError(f"a frame in the memory has {content}; expected {shape[1]} x {shape[0]} pixels")


def _are_below(indices: Tensor, size: int) -> bool:
    return int(indices.min()) >= 0 and int(indices.max()) < size


class CompressedMemory(TaskMemory[CompressedWindows]):
    """A uniform sample of the windows of each past task, with compressed images, within one budget of bytes.

    The bytes are split evenly over the tasks: when a task is added, the shares of the others shrink. A task keeps the
    first of its windows in a random order, so a smaller share is again a sample without replacement. Where windows have
    several steps, runs of that many neighbouring windows are drawn, because they share most frames: two frames are kept
    for a window instead of T. Nothing is read from the demonstrations again. Actions, readings and instructions are
    kept exactly.

    Args:
        budget: Largest number of bytes over all tasks.
        quality: Quality of the pictures, that of WebP.
        keep_decoded: Whether to keep decoded frames in the process's memory until the next task is added; otherwise
            frames are decoded whenever they are drawn, which takes longer and no memory.
    """

    def __init__(self, budget: Count, quality: Quality = 60, keep_decoded: bool = True) -> None:
        super().__init__(budget)
        self.quality, self.keep_decoded = quality, keep_decoded
        self._decoded: dict[int, Tensor] = {}  # all pictures of each task

    def nbytes(self) -> int:
        """Return the number of bytes that are kept; never more than the budget."""
        return sum(windows.nbytes() for windows in self.tasks.values())

    def add(self, dataset: TaskWindows, generator: torch.Generator) -> None:
        """Add a task.

        Args:
            generator: Draws which of its windows are kept.

        Raises:
            DataError: The task is in the memory already, or a task's share of the bytes is less than one window.
        """
        task = dataset.task_id
        self._require_new(task)
        steps = dataset.batch(torch.tensor([0])).actions.shape[1]
        runs = list(torch.arange(len(dataset)).split(steps))
        drawn = torch.randperm(len(runs), generator=generator).tolist()
        order = torch.cat([runs[run] for run in drawn])
        self.tasks[task] = compress(dataset, order, self.budget, self.quality)
        self._shrink()

    def _shrink(self) -> None:
        """Reduce every task to its share; what small tasks do not need is given to the others."""
        self._decoded = {}
        sizes = {t: w.nbytes() if len(w) == w.total else self.budget for t, w in self.tasks.items()}
        for task, share in even_shares(sizes, self.budget).items():
            if self.tasks[task].nbytes() > share:
                self.tasks[task] = self.tasks[task].within(share)
            if not len(self.tasks[task]):
                raise DataError(
                    f"a share of {share} bytes for each of {len(sizes)} tasks holds no window; raise algo.budget "
                    f"({self.budget}), or lower algo.quality or data.image_size"
                )

    def sample(self, n: int, generator: torch.Generator) -> Batch:
        """Return windows on the CPU; see `ReplayMemory.sample`."""
        drawn = self._draw(n, generator)
        if self.keep_decoded and not self._decoded:
            self._decoded = {t: w.pictures(torch.arange(len(w.ends))) for t, w in self.tasks.items()}
        parts = divided(list(self.tasks.values()), drawn)
        return reduce(Batch.join, [w.batch(rows, self._decoded.get(w.task_id)) for w, rows in parts])

    def load_state_dict(
        self, state: Mapping[str, Any], datasets: Mapping[int, TaskWindows] | None = None
    ) -> None:
        """Restore what `state_dict` returned.

        Args:
            state: From `state_dict`.
            datasets: Windows by task id, as `ReplayMemory` needs them; they are not read.

        Raises:
            DataError: The state is not consistent; the memory is unchanged.
        """
        tasks = {task: CompressedWindows.from_state(kept) for task, kept in state["tasks"].items()}
        if odd := [task for task, windows in tasks.items() if windows.task_id != task]:
            raise DataError(
                f"the compressed windows of task {odd[0]} are those of task {tasks[odd[0]].task_id}"
            )
        self.budget, self.tasks, self._decoded = int(state["budget"]), tasks, {}
