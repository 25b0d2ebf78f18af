"""Pictures of a task: its initial states through several cameras, and a video of the expert."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from libero_env.curating.video import write_video
from libero_env.envs.env import LiberoEnv
from libero_env.errors import LiberoError
from libero_env.expert import Expert
from libero_env.expert.expert import MAX_STEPS
from libero_env.perturbations.perturbation import Perturbation
from libero_env.sim.observations import image_name
from libero_env.tasks.cameras import camera_name
from libero_env.tasks.task import Task
from libero_env.timing import CONTROL_HZ

_PAIR = ("agentview", "robot0_eye_in_hand")
CAMERAS = (*_PAIR, "birdview")
_EVERY = 2  # [control steps] between frames of a video
_BAND = 14  # [pixels] height of the caption above a picture


def contact_sheet(
    task: Task, path: Path, *, starts: int = 3, cameras: Sequence[str] = (), size: int = 256
) -> Path:
    """Write a PNG of the first initial states of a task, a row for each, a column for each camera.

    Args:
        task: Task of a suite, whose initial states are stored, or of a file, whose initial state i is that of seed i.
        path: File to write; its folder is created.
        starts: Number of initial states.
        cameras: Names of cameras; by default `CAMERAS` and the task's own.
        size: Height and width of a picture, [pixels].

    Returns:
        `path`.

    Raises:
        PlacementError: There is no collision-free placement of the objects.
        UnknownNameError: A camera does not exist.
    """
    check_picture(path)
    cameras = cameras or (*CAMERAS, *(camera.name for camera in task.problem.cameras))
    with LiberoEnv(task, cameras=tuple(cameras), camera_size=(size, size)) as env:
        rows = [
            np.concatenate([_reset(env, i)[image_name(c, "rgb")] for c in cameras], axis=1)
            for i in range(starts)
        ]
    sheet = Image.fromarray(np.concatenate(rows))
    draw = ImageDraw.Draw(sheet)
    for i in range(starts):
        for k, camera in enumerate(cameras):
            words = f"{camera_name(camera)}, start {i}"
            draw.rectangle((k * size, i * size, k * size + 7 * len(words), i * size + _BAND), fill=(0, 0, 0))
            draw.text((k * size + 3, i * size + 1), words, fill=(255, 255, 255))
    path.parent.mkdir(parents=True, exist_ok=True)
    sheet.save(path)
    return path


def compare_starts(
    task: Task, perturbations: Sequence[Perturbation], path: Path, *, start: int = 0, size: int = 256
) -> Task:
    """Write a PNG of an initial state as it is, and beside it with perturbations, a row for each camera.

    Args:
        path: File to write; its folder is created.
        start: Number of the initial state.
        size: Height and width of a picture, [pixels].

    Returns:
        The task as the perturbations change it.

    Raises:
        PlacementError: The perturbations make no valid start of it.
    """
    check_picture(path)
    columns = []
    for perturb in ((), tuple(perturbations)):
        with LiberoEnv(task, cameras=_PAIR, camera_size=(size, size), perturb=perturb) as env:
            obs = _reset(env, start)
            columns.append(np.concatenate([obs[image_name(c, "rgb")] for c in _PAIR]))
            changed = env.task
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(columns, axis=1)).save(path)
    return changed


def check_picture(path: Path) -> None:
    """Check that the name of a file says how a picture is stored.

    Raises:
        LiberoError: It ends in nothing that is known.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp", ".gif", ".bmp", ".tiff"):
        raise LiberoError(f"{path}: the name of a picture ends in .png, .jpg, .webp, .gif, .bmp or .tiff")


def expert_video(task: Task, path: Path, *, size: int = 256) -> tuple[bool, str]:
    """Write a video of the expert performing a task from the first initial state.

    Args:
        task: Task to perform.
        path: File to write, whose name ends in .webp, .gif or .mp4.
        size: Height and width of the video, [pixels].

    Returns:
        Whether the goal was reached, and the reason of failure ("" after a success).

    Raises:
        UnsupportedGoalError: The goal needs a skill that the expert does not have.
    """
    name = image_name("agentview", "rgb")
    with LiberoEnv(task, cameras=("agentview",), camera_size=(size, size), horizon=MAX_STEPS) as env:
        frames = [_reset(env, 0)[name]]
        expert, terminated, truncated, step = Expert(task, np.random.default_rng(0)), False, False, 0
        while not (terminated or truncated or expert.failure_reason):
            env.render_images = step % _EVERY == _EVERY - 1
            obs, _, terminated, truncated, _ = env.step(expert.act(env.view))
            if env.render_images or terminated:
                frames.append(env.render_cameras()[name] if terminated else obs[name])
            step += 1
    write_video(path, np.stack(frames), CONTROL_HZ // _EVERY)
    reason = expert.failure_reason or f"in phase {expert.phase} after {step} steps"
    return terminated, "" if terminated else reason


def _reset(env: LiberoEnv, start: int) -> dict[str, np.ndarray]:
    """Reset the environment to an initial state and return the observations."""
    if env.task.suite == "file":
        return env.reset(seed=start)[0]
    return env.reset(options={"init_state": start})[0]
