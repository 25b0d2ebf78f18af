"""Demonstrations as LeRobot data sets: in this package's own layout, or in that of a published set of LIBERO.

Needs the extra `export` (PyArrow and PyAV). Both store 8 numbers of state (position of the grip site, rotation vector,
fingers), 7 of action, images of agentview and of the hand, and the observation on which an action was chosen.

The own layout is a LeRobotDataset v3.0 at 20 frames per second with upright images, as recorded. The published sets
have images that are upright and mirrored left to right, 10 as frames per second, other names, and no no-ops; a policy
that is trained on them has to be evaluated on mirrored images, as the clients of openpi, OpenVLA-OFT and LeRobot do.
"""

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from libero_env.demos.contents import EXPORTED_STATE, json_attribute, read_header
from libero_env.demos.hdf5 import BrokenDemoError
from libero_env.demos.lerobot_layout import OWN, PUBLISHED, Layout
from libero_env.demos.lerobot_writers import ImageDatasetWriter, VideoDatasetWriter, write_json
from libero_env.demos.observe import recorded_robot, recorded_task, require_default_frequency
from libero_env.demos.read import Episode, Labels, read_episodes
from libero_env.demos.replay import Regeneration, regenerate
from libero_env.demos.write import require_absent
from libero_env.errors import DemoError, UnknownNameError
from libero_env.parallel import progress_bar
from libero_env.storage import atomic_folder
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ

ORIGIN = "meta/libero.json"  # how a data set was made


def export_lerobot(
    files: Sequence[Path],
    root: Path,
    *,
    labels: Labels = "expert",
    video_mb: float | None = None,
    task: Task | None = None,
    progress: bool | None = None,
) -> tuple[int, int]:
    """Write demonstration files as one data set in this package's layout.

    Args:
        files: Files to read, in this order; all have the same cameras and image size.
        root: Folder to write; it must not exist.
        labels: As for `read_demos`.
        video_mb: Size from which a video is continued in another file, [MiB].
        task: Task that all files recorded; None for those that they state.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        Number of episodes and number of frames.

    Raises:
        DemoError: A file is broken or has other images than the first, or the folder exists.
        LiberoError: PyArrow or PyAV is not installed.
    """
    require_absent(root)
    with atomic_folder(root) as folder, closing(VideoDatasetWriter(folder, OWN, video_mb)) as dataset:
        for file in progress_bar(files, desc="export", unit="file", progress=progress):
            require_default_frequency(file, "export to LeRobot's format")
            language = _language(file, task)
            for episode in read_episodes(file):
                where = f"{file}: {episode.name}"
                dataset.add(_exported(episode, where, labels), language, where)
        dataset.close()
        size = dataset.finish()
        _write_origin(folder, OWN, {"labels": labels, "models": _recorded_models(files)})
        return size


def export_published(
    files: Sequence[Path],
    root: Path,
    name: str,
    config: Regeneration | None = None,
    *,
    task: Task | None = None,
    progress: bool | None = None,
) -> tuple[int, int, list[str]]:
    """Run demonstrations again and write them as one data set in the layout of a published one.

    Args:
        files: Files to read, in this order; their images are not used.
        root: Folder to write; it must not exist.
        name: Published set, one of `libero_env.demos.lerobot_layout.PUBLISHED`.
        config: How the demonstrations are run.
        task: Task that all files recorded; None for those that they state.
        progress: Whether to show a progress bar. None shows one if stderr is a terminal.

    Returns:
        Number of episodes, number of frames, and the demonstrations that were left out, since they did not reach the
        goal when they were run again.

    Raises:
        UnknownNameError: No such set is known.
        DemoError: A file is broken, no demonstration reaches its goal, or the folder exists.
        LiberoError: PyArrow or PyAV is not installed.
    """
    if name not in PUBLISHED:
        raise UnknownNameError("published data set", name, PUBLISHED)
    require_absent(root)
    layout, config = PUBLISHED[name], config or Regeneration()
    writer = ImageDatasetWriter if layout.codec is None else VideoDatasetWriter
    exported, failed = 0, []
    with atomic_folder(root) as folder, closing(writer(folder, layout)) as dataset:
        for file in progress_bar(files, desc="export", unit="file", progress=progress):
            require_default_frequency(file, f"the layout {name}")
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
        dataset.close()
        episodes, frames = dataset.finish()
        robots = ", ".join(sorted(set(map(recorded_robot, files))))
        how = {"robot": robots, "as": name, "left_out": len(failed)}
        _write_origin(folder, layout, config.record() | how)
    return episodes, frames, failed


def _language(file: Path, task: Task | None) -> str:
    if task is not None:
        return task.language
    stated = json_attribute(read_header(file), "problem_info", file).get("language_instruction")
    return stated if isinstance(stated, str) else recorded_task(file).language


def _exported(episode: Episode, where: str, labels: Labels) -> Episode:
    """Return an episode with the actions to learn, each with the observation on which it was chosen."""
    for key in EXPORTED_STATE:
        if key not in episode.obs:
            raise BrokenDemoError(
                f"{where}/obs/{key} is missing; expected it beside {', '.join(episode.obs)}"
            )
    aligned = episode.aligned()
    if not len(aligned):
        raise BrokenDemoError(f"{where} has one step; expected a second one to pair it with")
    return replace(aligned, actions=aligned.labels if labels == "expert" else aligned.actions)


def _recorded_models(files: Sequence[Path]) -> list[Any]:
    """Return the models that the files state, each once."""
    stated = [json_attribute(read_header(file), "models", file) for file in files]
    texts = {json.dumps(models, sort_keys=True): models for models in stated if models}
    return [texts[text] for text in sorted(texts)]


def _write_origin(root: Path, layout: Layout, how: dict[str, Any]) -> None:
    images = {"first_row": "top", "mirrored": layout.mirrored}
    mirrored = "seen as through a mirror: the original's pictures after half a turn, as in the published sets"
    images["meaning"] = mirrored if layout.mirrored else "as the camera sees the scene"
    origin = {
        "generator": "libero-lifelong",
        "images": images,
        "control_hz": CONTROL_HZ,
        "fps_is": "a label; time between frames is 1 / control_hz"
        if layout.fps != CONTROL_HZ
        else "control_hz",
    }
    write_json(root / ORIGIN, origin | how)
