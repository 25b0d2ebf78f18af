"""Replaying recorded demonstrations by their states or by their actions, and rendering them again."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import mujoco
import numpy as np

from libero_env.assets.pack import Pack, select_pack
from libero_env.demos.contents import demo_names, demo_number
from libero_env.demos.curate import read_episodes, recorded_robot, recorded_task
from libero_env.demos.hdf5 import BrokenDemoError, open_demo_file
from libero_env.demos.header import json_attribute, read_header
from libero_env.demos.observe import PERTURBED_HEADER, RenderConfig, StateRenderer, fixture_poses
from libero_env.demos.write import DemoWriter, Episode
from libero_env.errors import DemoError
from libero_env.parallel import progress_bar
from libero_env.perturbations.problem import reword_task
from libero_env.sim.observations import image_name
from libero_env.sim.scene import FAST, Scene, default_drawing
from libero_env.tasks import Task

REPLAY_MODES = ("state", "action")


@dataclass(frozen=True)
class ReplayResult:
    """Outcome of the replay of one demonstration.

    Attributes:
        name: Name of the demonstration, such as `demo_3`.
        recorded: Whether the file states that it reached the goal.
        success: Whether the replay reached the goal.
        steps: Number of steps that were replayed.
        drift: Largest distance of an object from where it was recorded, [m], (T,); 0 where states are replayed.
        arm_drift: Largest difference of a joint angle of the arm from the recorded one, [rad], (T,).
        frames: Images of all cameras side by side, (T, H, W, 3) uint8; None without cameras.
    """

    name: str
    recorded: bool
    success: bool
    steps: int
    drift: np.ndarray = field(repr=False)
    arm_drift: np.ndarray = field(repr=False)
    frames: np.ndarray | None = field(default=None, repr=False)


def replay(
    file: Path,
    *,
    by: str = "action",
    demos: Sequence[str] | None = None,
    cameras: Sequence[str] = (),
    size: tuple[int, int] = (256, 256),
    assets: Pack | str | Path | None = None,
) -> Iterator[ReplayResult]:
    """Replay demonstrations from their first state, with the fixtures at their recorded poses.

    Args:
        file: Demonstration file.
        by: `action` executes the recorded actions; `state` puts the simulation into each recorded state, and executes
            the last action only.
        demos: Names of the demonstrations to replay; None for all.
        cameras: Cameras to render; none by default.
        size: (height, width) of the images, pixels.
        assets: Where models come from, as for `LiberoEnv`.

    Raises:
        DemoError: The file is broken, does not fit its task's scene, or has no such demonstration.
    """
    if by not in REPLAY_MODES:
        raise DemoError(f"replay by {by!r}; valid: {', '.join(REPLAY_MODES)}")
    config = RenderConfig(tuple(cameras), size, drawing=read_header(file).get("drawing"))
    renderer = _renderer(file, config, assets)
    keys = [image_name(camera, "rgb") for camera in cameras]
    found = set()
    try:
        for name, episode in read_episodes(file):
            if demos is None or name in demos:
                found.add(name)
                renderer.place_fixtures(checked_fixtures(file, name, episode, renderer.scene))
                yield _replay_episode(renderer, name, episode, by, keys)
    finally:
        renderer.close()
    if absent := set(demos or ()) - found:
        raise DemoError(f"{file}: no demonstration {', '.join(sorted(absent))}")


def _replay_episode(
    renderer: StateRenderer, name: str, episode: Episode, by: str, keys: list[str]
) -> ReplayResult:
    env, states, nq = renderer.env, episode.states, renderer.scene.model.nq
    objects = _object_positions(renderer.scene)
    obs = env.set_state(states[0])
    drift, arm_drift, frames, terminated = [], [], [], False
    for t, action in enumerate(episode.actions):
        if by == "state" and t:
            obs = env.set_state(states[t])
        qpos, recorded_qpos = env.world.simulations.fields["qpos"][0], states[t, 1 : 1 + nq]
        offsets = qpos[objects] - recorded_qpos[objects]  # (n, 3)
        drift.append(np.linalg.norm(offsets, axis=1).max(initial=0.0))
        arm_drift.append(np.abs(qpos[:7] - recorded_qpos[:7]).max())
        frames += [np.concatenate([obs[key] for key in keys], axis=1)] if keys else []
        if by == "action" or t == len(states) - 1:
            obs, _, terminated, _, _ = env.step(action)
            if terminated:
                break
    return ReplayResult(
        name=name,
        recorded=episode.success,
        success=bool(terminated),
        steps=len(drift),
        drift=np.array(drift),
        arm_drift=np.array(arm_drift),
        frames=np.stack(frames) if frames else None,
    )


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
        file: File to read.
        target: File to write.
        config: What is rendered.
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
    pack = select_pack(assets) if assets is None or isinstance(assets, str | Path) else assets
    config = replace(config, drawing=config.drawing or default_drawing(pack))
    task = task or recorded_task(file)
    writer = DemoWriter(target, rendered_header(file, config, task))
    recorded = writer.recorded_states()
    renderer = StateRenderer(task, config, assets, robot=recorded_robot(file))
    try:
        episodes = islice(read_episodes(file), limit)
        for name, episode in progress_bar(episodes, desc="render", unit="demo", progress=progress):
            if (index := demo_number(name)) in recorded:
                if not np.array_equal(recorded[index], episode.states):
                    raise DemoError(
                        f"{target} has another {name} than {file}; choose another name or remove it"
                    )
            else:
                fixtures = checked_fixtures(file, name, episode, renderer.scene)
                obs, robot_states = renderer.render_states(episode.states, fixtures, name)
                writer.write(index, replace(episode, obs=obs, robot_states=robot_states))
    finally:
        renderer.close()
    return writer.finish()


def recorded_rendering(file: Path) -> RenderConfig:
    """Return how the images of a file were rendered, without the perturbations under which they may have been.

    Raises:
        DemoError: It is not a demonstration file.
    """
    header, default = read_header(file), RenderConfig()
    with open_demo_file(file) as handle:
        names = demo_names(handle, file)
        obs = handle["data"][names[0]].get("obs") if names else None
        views = [key for key in obs if key.endswith("_rgb")] if isinstance(obs, h5py.Group) else []
        size = tuple(map(int, obs[views[0]].shape[1:3])) if views and obs is not None else default.size
    return RenderConfig(
        tuple(map(str, header.get("cameras", default.cameras))),
        (size[0], size[1]),
        tuple(map(str, header.get("pictures", default.modalities))),
        header.get("drawing", FAST if "generator" in header else None),
    )


def rendered_header(file: Path, config: RenderConfig, task: Task) -> dict[str, Any]:
    """Return the attributes of a file that is rendered again, with the instruction where perturbations reword it.

    Args:
        file: File that is read.
        config: What is rendered; its drawing is named.
        task: Task that was recorded.
    """
    before = read_header(file)
    given_up = ("cameras", "pictures", "drawing", *PERTURBED_HEADER)
    header = {k: v for k, v in before.items() if k not in given_up}
    header |= {**config.header(), "pairing": "aligned"}
    if "instruction" in f"{before.get('perturb', '')} {header.get('perturb', '')}":
        said = reword_task(task, config.perturbations).language
        info = json_attribute(before, "problem_info", file)
        header["problem_info"] = json.dumps({**info, "language_instruction": said})
    return header


def rerun_actions(file: Path, target: Path) -> Path:
    """Write a copy of demonstrations with the states that their actions lead to from the first recorded state.

    Args:
        file: File to read.
        target: File to write.

    Returns:
        The new file.

    Raises:
        DemoError: The file is broken or does not fit its task's scene, or the target exists.
    """
    if target.exists():
        raise DemoError(f"{target} exists; choose another name or remove it")
    renderer = _renderer(file, RenderConfig(()))
    writer, world = DemoWriter(target, read_header(file)), renderer.env.world
    writer.discard_parts()  # of an interrupted call, perhaps with another file
    try:
        for name, episode in progress_bar(read_episodes(file), desc="replay", unit="demo"):
            renderer.place_fixtures(checked_fixtures(file, name, episode, renderer.scene))
            renderer.env.set_state(episode.states[0])
            states = []
            for action in episode.actions:
                states.append(world.physics_state(0))
                world.step([0], action[None])
            success = bool(world.check_goal(0)[0])
            writer.write(demo_number(name), replace(episode, states=np.array(states), success=success))
    finally:
        renderer.close()
    return writer.finish()


def _renderer(file: Path, config: RenderConfig, assets: Pack | str | Path | None = None) -> StateRenderer:
    return StateRenderer(recorded_task(file), config, assets, robot=recorded_robot(file))


def checked_fixtures(file: Path, name: str, episode: Episode, scene: Scene) -> np.ndarray:
    """Return the poses of the fixtures, after a check that the states fit the scene."""
    length = 1 + scene.model.nq + scene.model.nv
    if episode.states.shape[1] != length:
        raise BrokenDemoError(
            f"{file}: {name}/states is {episode.states.shape}; expected (T, {length}) for {scene.problem.language!r}"
        )
    return fixture_poses(episode, scene, f"{file}: {name}")


def _object_positions(scene: Scene) -> np.ndarray:
    """Return the addresses in qpos of the positions of free bodies, (n, 3)."""
    free = scene.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    return scene.model.jnt_qposadr[free][:, None] + np.arange(3)
