"""Demonstrations for Rerun's viewer: images, states, actions and the atoms of the goal on one timeline.

Needs the extra `rerun`. Each demonstration has a branch of its own, such as `demo_3/cameras/agentview_rgb`,
`demo_3/state/ee_pos`, `demo_3/action` and `demo_3/goal/(on bowl_1 plate_1)`; `step` counts control steps, `time` is in
seconds. An action stands at the step of the observation on which it was chosen.
"""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from libero_env.demos.agreement import recorded_frequency
from libero_env.demos.config import MASK_NAMES, RenderConfig
from libero_env.demos.contents import is_image, json_attribute, read_header
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import Episode
from libero_env.errors import LiberoError, need
from libero_env.progress import progress_bar
from libero_env.storage import atomic_path
from libero_env.tasks import Task
from libero_integrations.exports.demonstrations import recorded_language
from libero_integrations.exports.layouts import RECORDED

_QUALITY = 95  # of JPEG


def write_rerun(
    file: Path,
    target: Path,
    *,
    demos: Sequence[str] | None = None,
    task: Task | None = None,
) -> int:
    """Write demonstrations as a file of Rerun; return their number.

    Args:
        file: Demonstration file.
        target: File to write, .rrd; it is replaced in one step.
        demos: Names of the demonstrations; None for all.
        task: Task that was recorded; None for the one that the file states.

    Raises:
        DemoError: The file is broken, does not fit its task's scene, or has no such demonstration.
        LiberoError: The file to write has another ending.
        MissingPackageError: Rerun is not installed.
    """
    rerun = need("rerun")
    if target.suffix != ".rrd":
        raise LiberoError(f"{target}: Rerun opens files that end with .rrd")
    hz = recorded_frequency(file)
    stream = rerun.RecordingStream("libero", recording_id=file.stem)
    memory, written = stream.memory_recording(), 0
    with closing(StateRenderer.of_file(file, RenderConfig(()), task=task)) as renderer:
        for episode in progress_bar(renderer.episodes(file, demos), desc="show", unit="demo"):
            branch = _Branch(rerun, stream, episode.aligned(), hz)
            branch.write(renderer, recorded_language(file, task), _mask_names(file))
            written += 1
    with atomic_path(target) as temporary:
        temporary.write_bytes(memory.drain_as_bytes())
    return written


def _mask_names(file: Path) -> dict[int, str]:
    """Return the names of the numbers in the segmentations of a file."""
    names = json_attribute(read_header(file), MASK_NAMES, file)
    return {int(number): str(name) for number, name in names.items()}


class _Branch:
    """Writer of one demonstration.

    Args:
        rerun: The package.
        stream: What is written to.
        episode: What is written, each action with the observation before it.
        hz: Control steps per second, [Hz].
    """

    def __init__(self, rerun: ModuleType, stream: Any, episode: Episode, hz: int):
        self._rerun, self._stream, self._episode, self._hz = rerun, stream, episode, hz

    def write(self, renderer: StateRenderer, language: str, mask_names: dict[int, str]) -> None:
        """Write everything; the goal is checked in the simulation of a renderer."""
        rerun, episode = self._rerun, self._episode
        self._fixed("task", rerun.TextDocument(language))
        for key, values in episode.obs.items():
            if is_image(key):
                self._frames(f"cameras/{key}", values, mask_names)
            else:
                self._numbers(f"state/{key}", values)
        names = RECORDED["lerobot"].action_names
        self._numbers("action", episode.actions, names)
        if episode.expert_actions is not None:
            self._numbers("expert_action", episode.expert_actions, names)
        held = []
        for step, state in enumerate(episode.states):
            if step == 0:
                renderer.env.batch.set_state(0, state)
            else:  # conditions over time remember the states before
                renderer.env.simulations.set_physics_state(0, state)
            reached, atoms = renderer.env.batch.check_goal(0)
            held.append({"reached": reached, **atoms})
        for atom in held[0]:
            self._numbers(f"goal/{atom}", np.array([[atoms[atom]] for atoms in held], float))

    def _path(self, name: str) -> list[str]:
        return [self._episode.name, *name.split("/", 1)]

    def _fixed(self, name: str, content: Any) -> None:
        self._stream.log(self._path(name), content, static=True)

    def _frames(self, name: str, frames: np.ndarray, mask_names: dict[int, str]) -> None:
        rerun = self._rerun
        if name.endswith("_segmentation"):
            self._fixed(name, rerun.AnnotationContext(list(mask_names.items())))
        for step, frame in enumerate(frames):
            self._stream.set_time("step", sequence=step)
            self._stream.set_time("time", duration=step / self._hz)
            if name.endswith("_rgb"):
                content = rerun.Image(frame).compress(jpeg_quality=_QUALITY)
            elif name.endswith("_depth"):
                content = rerun.DepthImage(frame.astype(np.float32), meter=1.0)
            else:
                content = rerun.SegmentationImage(frame.astype(np.uint16))
            self._stream.log(self._path(name), content)

    def _numbers(self, name: str, values: np.ndarray, names: Sequence[str] = ()) -> None:
        rerun, steps = self._rerun, np.arange(len(values))
        if names:
            self._fixed(name, rerun.SeriesLines(names=list(names)))
        self._stream.send_columns(
            rerun.new_entity_path(self._path(name)),
            indexes=[
                rerun.TimeColumn("step", sequence=steps),
                rerun.TimeColumn("time", duration=steps / self._hz),
            ],
            columns=rerun.Scalars.columns(scalars=values),
        )
