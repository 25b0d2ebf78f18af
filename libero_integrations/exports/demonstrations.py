"""Demonstrations as data sets for other tools: LeRobot's, GR00T's, RLDS, and those in the form of published sets.

All store 8 numbers of state (position of the grip site, rotation vector, fingers), 7 of action (8 of goals of the
joints), images of agentview and of the hand, and the observation on which an action was chosen. LeRobot's and GR00T's
need PyArrow and PyAV.

The own forms have recordings as they are: 20 frames per second, upright images. The published sets have images that are
upright and mirrored left to right, other names, and no no-ops; a policy that is trained on them has to be evaluated on
mirrored images, as the clients of openpi, OpenVLA-OFT, GR00T and LeRobot do.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from libero_env.demos.actions import KINDS, ActionConverter
from libero_env.demos.agreement import noisy_labels, require_alike, require_default_control, stated_facts
from libero_env.demos.contents import json_attribute, read_header
from libero_env.demos.hdf5 import BrokenDemoError
from libero_env.demos.observe import recorded_rendering, recorded_robot, recorded_task
from libero_env.demos.read import Episode, Labels, read_episodes
from libero_env.demos.write import require_absent
from libero_env.errors import DemoError, InvalidInputError, UnknownNameError, require_known
from libero_env.progress import progress_bar
from libero_env.storage import atomic_folder
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ
from libero_integrations.exports.layouts import GRIPPER, ORIGIN, PUBLISHED, RECORDED, STATE, Layout
from libero_integrations.exports.lerobot import EpisodeDatasetWriter, VideoDatasetWriter, write_json
from libero_integrations.exports.regeneration import Regeneration, regenerate
from libero_integrations.exports.rlds import RldsWriter

Writer = VideoDatasetWriter | EpisodeDatasetWriter | RldsWriter


def export(
    files: Sequence[Path],
    root: Path,
    form: str,
    *,
    labels: Labels,
    actions: str | None,
    settle: int | None,
    assets: str | None,
    drawing: str | None,
    task: Task | None,
    despite: Sequence[str] = (),
) -> list[str]:
    """Do what `libero demos export` is asked for; return lines about what was written.

    Raises:
        InvalidInputError: An option is given that means nothing for the form.
    """
    again = {"--settle": settle, "--assets": assets, "--drawing": drawing}
    refused = {"--actions": actions} if form in PUBLISHED else again
    if given := [option for option, value in refused.items() if value is not None]:
        forms = "what was recorded" if form in PUBLISHED else f"published sets: {', '.join(PUBLISHED)}"
        raise InvalidInputError(f"{', '.join(given)} cannot be used with --as {form}; only with {forms}")
    if form not in PUBLISHED:
        episodes, frames = export_demos(
            files, root, form, labels=labels, actions=actions or "delta", task=task, despite=despite
        )
        return [f"{root}: {episodes} episodes, {frames} frames"]
    chosen: dict[str, Any] = {"settle_steps": settle, "assets": assets, "drawing": drawing}
    config = Regeneration(labels=labels, **{key: value for key, value in chosen.items() if value is not None})
    episodes, frames, failed = export_published(files, root, form, config, task=task, despite=despite)
    return [
        f"{root}: {episodes} episodes, {frames} frames, as {form}",
        f"models: {config.pack().name}, drawing: {config.drawing}",
        *(f"left out, does not reach the goal when it is run again: {where}" for where in failed),
    ]


def export_demos(
    files: Sequence[Path],
    root: Path,
    form: str = "lerobot",
    *,
    labels: Labels = "expert",
    actions: str = "delta",
    video_mb: float | None = None,
    task: Task | None = None,
    despite: Sequence[str] = (),
    progress: bool | None = None,
) -> tuple[int, int]:
    """Write demonstration files, as they were recorded, as one data set.

    Args:
        files: Files to read, in this order; all have the same cameras and image size.
        root: Folder to write; it must not exist. RLDS takes its name from it.
        form: One of `libero_integrations.exports.layouts.RECORDED`.
        labels: As for `read_demos`.
        actions: Kind of the actions, one of `libero_env.demos.actions.KINDS`.
        video_mb: Size from which a video of LeRobot's form is continued in another file, [MiB].
        task: Task that all files recorded; None for those that they state.
        despite: In what the files may differ, of `libero_env.demos.agreement.FACTS`.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        Number of episodes and number of frames.

    Raises:
        UnknownNameError: No such form or kind of actions is known.
        DemoError: A file is broken, has other images than the first or does not fit the task, or the folder exists.
        LiberoError: PyArrow or PyAV is not installed.
    """
    if form not in RECORDED:
        raise UnknownNameError("form of a data set", form, (*RECORDED, *PUBLISHED))
    layout = RECORDED[form].of_joints() if actions == "joint" else RECORDED[form]
    facts = _checked_facts(files, labels, despite, f"the layout {form}")
    with _data_set(root, layout, video_mb) as (folder, dataset):
        for file in progress_bar(files, desc="export", unit="file", progress=progress):
            language = recorded_language(file, task)
            with closing(ActionConverter(file, actions, task)) as converter:
                for episode in read_episodes(file):
                    where = f"{file}: {episode.name}"
                    dataset.add(converter.convert(_exported(episode, where, labels)), language, where)
        controller, relative = KINDS[actions]
        control = {"actions": actions, "controller": controller, "control_delta": relative}
        how = {"labels": labels, **control, "models": _recorded_models(files), "robot": _robots(files)}
        stated = {
            "drawing": [recorded_rendering(file).drawing or "not stated" for file in files],
            "perturb": [str(read_header(file).get("perturb", "none")) for file in files],
        }
        stated |= _origins(facts)
        how |= {key: "; ".join(sorted(set(values))) for key, values in stated.items()}
        return _finish(folder, dataset, how)


def export_published(
    files: Sequence[Path],
    root: Path,
    name: str,
    config: Regeneration | None = None,
    *,
    task: Task | None = None,
    despite: Sequence[str] = (),
    progress: bool | None = None,
) -> tuple[int, int, list[str]]:
    """Run demonstrations again and write them as one data set in the form of a published one.

    Args:
        files: Files to read, in this order; their images are not used.
        root: Folder to write; it must not exist. RLDS takes its name from it.
        name: Published set, one of `libero_integrations.exports.layouts.PUBLISHED`.
        config: How the demonstrations are run.
        task: Task that all files recorded; None for those that they state.
        despite: In what the files may differ, of `libero_env.demos.agreement.FACTS`.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        Number of episodes, number of frames, and the demonstrations that were left out, since they did not reach the
        goal when they were run again.

    Raises:
        UnknownNameError: No such set is known.
        DemoError: A file is broken or perturbed, no demonstration reaches its goal, or the folder exists.
        LiberoError: PyArrow or PyAV is not installed.
    """
    require_known("published data set", name, PUBLISHED)
    config, exported, failed = config or Regeneration(), 0, []
    # models are drawn anew
    facts = _checked_facts(files, config.labels, (*despite, "models"), f"the layout {name}")
    with _data_set(root, PUBLISHED[name]) as (folder, dataset):
        for file in progress_bar(files, desc="export", unit="file", progress=progress):
            if perturb := read_header(file).get("perturb"):
                raise DemoError(
                    f"{file} was rendered under {perturb}, and the layout {name} has images that are drawn anew, "
                    f"without it: use --as {', '.join(RECORDED)}, or files without perturbations"
                )
            recorded = task or recorded_task(file)
            for episode in regenerate(file, config, recorded):
                where = f"{file}: {episode.name}"
                if episode.success:
                    dataset.add(episode, recorded.language, where)
                    exported += 1
                else:
                    failed.append(where)
        if failed and not exported:
            raise DemoError(f"{failed[0]}: neither this demonstration nor any other reaches its goal again")
        how = {"robot": _robots(files), "as": name, "left_out": len(failed)}
        how |= {key: "; ".join(sorted(set(values))) for key, values in _origins(facts).items()}
        return *_finish(folder, dataset, config.record() | how), failed


def _checked_facts(
    files: Sequence[Path], labels: Labels, despite: Sequence[str], use: str
) -> list[dict[str, str]]:
    """Return what files state of themselves; raise a DemoError where that does not suit the use, or differs."""
    for file in files:
        require_default_control(file, use)
        if labels == "expert" and (noisy := noisy_labels(file)):
            raise DemoError(f"{file} {noisy}; --labels executed exports them as they are")
    facts = {file: stated_facts(file, labels) for file in files}
    require_alike(facts, despite, "--despite {0}")
    return list(facts.values())


def _origins(facts: Sequence[dict[str, str]]) -> dict[str, list[str]]:
    return {"expert": [one["expert"] for one in facts], "actions_are": [one["labels"] for one in facts]}


@contextmanager
def _data_set(root: Path, layout: Layout, video_mb: float | None = None) -> Iterator[tuple[Path, Writer]]:
    """Yield a temporary folder, which becomes `root` where nothing fails, and a writer into it."""
    require_absent(root)
    with atomic_folder(root) as folder:
        writer: Writer
        if layout.version == "rlds":
            writer = RldsWriter(folder, layout, root.name)
        elif layout.version == "v3.0":
            writer = VideoDatasetWriter(folder, layout, video_mb)
        else:
            writer = EpisodeDatasetWriter(folder, layout)
        with closing(writer):
            yield folder, writer


def _finish(folder: Path, dataset: Writer, how: dict[str, Any]) -> tuple[int, int]:
    """Complete a data set; return its number of episodes and of frames."""
    dataset.close()
    size, layout = dataset.finish(), dataset.layout
    images = {"first_row": "top", "mirrored": layout.mirrored}
    mirrored = "seen as through a mirror: the original's pictures after half a turn, as in the published sets"
    images["meaning"] = mirrored if layout.mirrored else "as the camera sees the scene"
    origin = {
        "generator": "libero-lifelong",
        "images": images,
        "gripper": GRIPPER[layout.open_gripper],
        "control_hz": CONTROL_HZ,
        "fps_is": "a label; time between frames is 1 / control_hz"
        if layout.fps != CONTROL_HZ
        else "control_hz",
    }
    write_json(folder / ORIGIN, origin | how)
    return size


def recorded_language(file: Path, task: Task | None = None) -> str:
    """Return the instruction of a file's demonstrations, in the words of the perturbations that it was rendered under.

    Args:
        task: Task that was recorded; None for the one that the file states.
    """
    header = read_header(file)
    if task is not None and "instruction" not in str(header.get("perturb", "")):
        return task.language
    stated = json_attribute(header, "problem_info", file).get("language_instruction")
    return stated if isinstance(stated, str) else recorded_task(file).language


def _exported(episode: Episode, where: str, labels: Labels) -> Episode:
    """Return an episode with the actions to learn, each with the observation on which it was chosen."""
    for key in STATE:
        if key not in episode.obs:
            raise BrokenDemoError(
                f"{where}/obs/{key} is missing; expected it beside {', '.join(episode.obs)}"
            )
    aligned = episode.aligned()
    if not len(aligned):
        raise BrokenDemoError(f"{where} has one step; expected a second one to pair it with")
    return replace(aligned, actions=aligned.labels if labels == "expert" else aligned.actions)


def _robots(files: Sequence[Path]) -> str:
    return ", ".join(sorted(set(map(recorded_robot, files))))


def _recorded_models(files: Sequence[Path]) -> list[Any]:
    """Return the models that the files state, each once."""
    stated = [json_attribute(read_header(file), "models", file) for file in files]
    texts = {json.dumps(models, sort_keys=True): models for models in stated if models}
    return [texts[text] for text in sorted(texts)]
