"""Recorded states rendered again: with other cameras, or under perturbations, once and kept beside the recording."""

import hashlib
import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import Any

from libero_env.assets.pack import BUILTIN, Pack, select_pack
from libero_env.demos.config import MASK_NAMES, PERTURBED_HEADER, RenderConfig, camera_kwargs
from libero_env.demos.contents import demo_motion, demo_names, demo_number, json_attribute, same_motion
from libero_env.demos.generate import DemoJob, claim_incomplete, number_of_processes, run_each
from libero_env.demos.hdf5 import open_demo_file
from libero_env.demos.observe import StateRenderer, fixture_poses, recorded_task, task_header
from libero_env.demos.read import read_episodes
from libero_env.demos.write import DemoWriter
from libero_env.errors import DemoError
from libero_env.perturbations.perturbation import format_perturbations, reword_task
from libero_env.progress import progress_bar, tell_progress
from libero_env.sim.scene_spec import default_drawing
from libero_env.storage import own_folder
from libero_env.tasks import Task
from libero_env.text import counted

_LONGEST = 120  # [characters] of the text of perturbations in the name of a folder


@dataclass(frozen=True)
class RenderJob(DemoJob):
    """Demonstrations to be rendered under perturbations.

    Attributes:
        task: Task that was recorded; its id names the draws.
        n: Number of demonstrations, the first of the file.
        path: File to write: the recorded one where nothing is perturbed, or one in a folder named by the perturbations.
    """

    file: Path
    task: Task
    n: int
    config: RenderConfig
    path: Path = field(init=False)

    def __post_init__(self) -> None:
        pack = select_pack()
        drawing = self.config.drawing or default_drawing(pack)
        object.__setattr__(self, "config", replace(self.config, drawing=drawing))
        text, (height, width) = format_perturbations(self.config.perturb), self.config.size
        if len(text) > _LONGEST:
            text = f"{text[:40]}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
        shown = drawing if pack.name == BUILTIN else f"{drawing}-{pack.name}"
        folder = own_folder(self.file.parent, f"under-{text}-{height}x{width}-{shown}", error=DemoError)
        object.__setattr__(self, "path", folder / self.file.name if text else self.file)

    @cached_property
    def writer(self) -> DemoWriter:
        return DemoWriter(
            self.path, rendered_header(self.file, self.config, self.task, select_pack()), ("models",)
        )

    def missing(self, n: int) -> set[int]:
        """Return which of the first `n` recorded demonstrations are not rendered; see `DemoJob`.

        Raises:
            DemoError: What is there is broken, or of other demonstrations.
        """
        rendered, missing = self.writer.recorded_motion(), set()
        with open_demo_file(self.file) as handle:
            names = demo_names(handle, self.file)
        if gone := set(rendered) - set(map(demo_number, names)):
            raise DemoError(f"{self.path} has demo_{min(gone)}, which {self.file} no longer has")
        for name in names[:n]:
            if (number := demo_number(name)) not in rendered:
                missing.add(number)
            elif not same_motion(rendered[number], demo_motion(self.file, name)):
                raise DemoError(f"{self.path} has another {name} than {self.file}")
        return missing

    def render(self) -> None:
        """Render what is missing; what is broken or was made of another file is removed before.

        Raises:
            DemoError: The recorded demonstrations are broken, or the file cannot be written.
        """
        try:
            self.missing(self.n)
        except DemoError as error:
            self.discard(error)
        rerender(self.file, self.path, self.config, task=self.task, limit=self.n, progress=False)


def ensure_rendered(
    jobs: Sequence[RenderJob], *, workers: int = 0, progress: bool | None = None
) -> list[Path]:
    """Return files of demonstrations under perturbations; what is missing is rendered.

    A job without perturbations has the recorded file. An interrupted call can be repeated, and several processes may
    call this at the same time: each file is made once.

    Args:
        jobs: What is needed.
        workers: Number of processes; 0 means one per core, 1 renders in this process.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal, and lines otherwise.

    Raises:
        DemoError: A recorded file is broken, or a file cannot be written.
    """
    workers = number_of_processes(workers)
    largest: dict[Path, RenderJob] = {}  # each file once, with the most demonstrations that are asked for
    for job in jobs:
        if job.config.perturb and (job.path not in largest or largest[job.path].n < job.n):
            largest[job.path] = job
    with claim_incomplete((job, job.n) for job in largest.values()) as incomplete:
        if incomplete:
            _render(incomplete, min(workers, len(incomplete)), progress)
    return [job.path for job in jobs]


def _render(jobs: Sequence[RenderJob], workers: int, progress: bool | None) -> None:
    """Render jobs while no other process writes in their folders."""
    if progress is not False:
        folders = ", ".join(sorted({str(job.path.parent) for job in jobs}))
        tell_progress(f"rendering demonstrations of {counted(len(jobs), 'task')} in {folders}")
    with progress_bar(total=len(jobs), desc="render", unit="file", progress=progress) as bar:
        for _ in run_each(RenderJob.render, [(job,) for job in jobs], workers):
            bar.update(1)


def rerender(
    file: Path,
    target: Path,
    config: RenderConfig,
    *,
    assets: Pack | str | Path | None = None,
    task: Task | None = None,
    limit: int | None = None,
    progress: bool | None = None,
) -> Path:
    """Write the demonstrations of a file with other observations: cameras, resolution, modalities, perturbations.

    The observations are those of the recorded states, so the new file has "aligned" pairing, whatever the old one had.
    Perturbations under which the file was rendered are not kept. Each demonstration has a draw of its own, named by its
    name; actions and states stay as they are to the bit. An interrupted call can be repeated: it resumes where it
    stopped.

    Args:
        assets: Where models come from, as for `LiberoEnv`.
        task: Task that was recorded, which names the draws of perturbations; by default the one that the file states.
        limit: Largest number of demonstrations to write, the first of the file; None for all.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        The new file.

    Raises:
        DemoError: The file is broken or does not fit its task's scene, or the target was recorded with another
            configuration, or made of another file.
    """
    if target.exists() and target.samefile(file):
        raise DemoError(f"{target} is the file to read; choose another name")
    pack = select_pack(assets)
    config = replace(config, drawing=config.drawing or default_drawing(pack))
    task = task or recorded_task(file)
    with closing(StateRenderer.of_file(file, config, pack, task=task)) as renderer:
        header = rendered_header(file, config, task, pack) | config.mask_names(renderer.scene)
        writer = DemoWriter(target, header, ("models",))
        recorded = writer.recorded_motion()
        episodes = islice(read_episodes(file), limit)
        for episode in progress_bar(episodes, desc="render", unit="demo", progress=progress):
            name, number = episode.name, demo_number(episode.name)
            if number not in recorded:
                poses = fixture_poses(episode, renderer.scene, f"{file}: {name}")
                obs, robot_states = renderer.render_states(episode.states, poses, name)
                writer.write(number, replace(episode, obs=obs, robot_states=robot_states))
            elif not same_motion(recorded[number], (episode.states, episode.actions, episode.expert_actions)):
                raise DemoError(f"{target} has another {name} than {file}; choose another name or remove it")
    return writer.finish()


def rendered_header(file: Path, config: RenderConfig, task: Task, pack: Pack) -> dict[str, Any]:
    """Return the attributes of a file that is rendered again, with the instruction where perturbations reword it.

    Args:
        config: What is rendered; its drawing is named.
        task: Task that was recorded.
        pack: Models that are shown.
    """
    before = task_header(file, task)
    replaced = ("cameras", "pictures", "drawing", MASK_NAMES, *PERTURBED_HEADER)
    header = {k: v for k, v in before.items() if k not in replaced}
    models = json.dumps({"pack": pack.name, "digest": pack.digest})
    header |= {**config.header(), "pairing": "aligned", "models": models}
    made_with = json_attribute(before, "env_args", file)
    if isinstance(kwargs := made_with.get("env_kwargs"), dict):
        header["env_args"] = json.dumps({**made_with, "env_kwargs": {**kwargs, **camera_kwargs(config)}})
    if "instruction" in f"{before.get('perturb', '')} {header.get('perturb', '')}":
        instruction = reword_task(task, config.perturb).language
        info = json_attribute(before, "problem_info", file)
        header["problem_info"] = json.dumps({**info, "language_instruction": instruction})
    return header
