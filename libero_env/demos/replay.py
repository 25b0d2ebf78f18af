"""Recorded demonstrations run again: by their states, or by their actions."""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from libero_env.assets.pack import Pack
from libero_env.demos.actions import KINDS, ActionConverter
from libero_env.demos.agreement import require_default_control
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import demo_number, read_header
from libero_env.demos.observe import StateRenderer, recorded_rendering
from libero_env.demos.read import Episode
from libero_env.demos.write import DemoWriter, require_absent
from libero_env.errors import DemoError
from libero_env.mujoco_compat import mujoco
from libero_env.progress import progress_bar
from libero_env.sim.observations import image_name
from libero_env.tasks import Task

REPLAY_MODES = ("state", "action")
EXTRA_STEPS = 10  # largest number of repetitions of the last action until the goal is reached


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
    task: Task | None = None,
    actions: str = "delta",
) -> Iterator[ReplayResult]:
    """Replay demonstrations from their first state, with the fixtures at their recorded poses.

    Args:
        by: `action` executes the recorded actions; `state` puts the simulation into each recorded state, and executes
            the last action only.
        demos: Names of the demonstrations to replay; None for all.
        cameras: Cameras to render; none by default.
        size: (height, width) of the images, pixels.
        assets: Where models come from, as for `LiberoEnv`.
        task: Task that was recorded; None for the one that the file states.
        actions: Kind of the actions that are executed, by the controller of this kind; see `libero_env.demos.actions`.
            Of other kinds than `delta` the last is repeated up to ten times until the goal is reached.

    Raises:
        UnknownNameError: No such kind of actions is known.
        DemoError: The file is broken, does not fit its task's scene, or has no such demonstration.
    """
    if by not in REPLAY_MODES:
        raise DemoError(f"replay by {by!r}; valid: {', '.join(REPLAY_MODES)}")
    if by == "state" and actions != "delta":
        raise DemoError(f"a replay by state executes no {actions} actions; replay by action")
    config = RenderConfig(tuple(cameras), size, drawing=recorded_rendering(file).drawing)
    keys = [image_name(camera, "rgb") for camera in cameras]
    extra = 0 if actions == "delta" else EXTRA_STEPS
    with (
        closing(ActionConverter(file, actions, task, assets)) as converter,
        closing(StateRenderer.of_file(file, config, assets, task=task, control=KINDS[actions])) as renderer,
    ):
        for episode in renderer.episodes(file, demos):
            yield _replay_episode(renderer, converter.convert(episode), by, keys, extra)


def _replay_episode(
    renderer: StateRenderer, episode: Episode, by: str, keys: list[str], extra: int
) -> ReplayResult:
    env, states, nq = renderer.env, episode.states, renderer.scene.model.nq
    free = renderer.scene.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    objects = renderer.scene.model.jnt_qposadr[free][:, None] + np.arange(3)  # addresses of positions, (n, 3)
    obs = env.set_state(states[0])
    drift, arm_drift, frames, terminated = [], [], [], False
    for t, action in enumerate(episode.actions):
        if by == "state" and t:  # the goal's conditions over time remember the states before
            env.simulations.set_physics_state(0, states[t])
            env.batch.check_goal(0)
            obs = {name: rows[0] for name, rows in env.batch.observe(0).items()}
        qpos, recorded_qpos = env.simulations.fields["qpos"][0], states[t, 1 : 1 + nq]
        offsets = qpos[objects] - recorded_qpos[objects]  # (n, 3)
        drift.append(np.linalg.norm(offsets, axis=1).max(initial=0.0))
        arm_drift.append(np.abs(qpos[:7] - recorded_qpos[:7]).max())
        frames += [np.concatenate([obs[key] for key in keys], axis=1)] if keys else []
        if by == "action" or t == len(states) - 1:
            obs, _, terminated, _, _ = env.step(action)
            if terminated:
                break
    for _ in range(0 if terminated else extra):
        *_, terminated, _, _ = env.step(episode.actions[-1])
        if terminated:
            break
    return ReplayResult(
        name=episode.name,
        recorded=episode.success,
        success=bool(terminated),
        steps=len(drift),
        drift=np.array(drift),
        arm_drift=np.array(arm_drift),
        frames=np.stack(frames) if frames else None,
    )


def rerun_actions(file: Path, target: Path) -> Path:
    """Write a copy of demonstrations with the states that their actions lead to from the first recorded state.

    Returns:
        The new file.

    Raises:
        DemoError: The file is broken or does not fit its task's scene, or the target exists.
    """
    require_absent(target)
    require_default_control(file, "running it again", any_frequency=True)
    writer = DemoWriter(target, read_header(file))
    writer.discard_parts()  # of an interrupted call, perhaps with another file
    with closing(StateRenderer.of_file(file, RenderConfig(()))) as renderer:
        env = renderer.env.batch
        for episode in progress_bar(renderer.episodes(file), desc="replay", unit="demo"):
            renderer.env.set_state(episode.states[0])
            states, success = [], False
            for action in episode.actions:
                states.append(env.simulations.physics_state(0))
                env.simulations.step([0], action[None])
                success, _ = env.check_goal(0)  # conditions over time remember each moment
            writer.write(
                demo_number(episode.name), replace(episode, states=np.array(states), success=success)
            )
    return writer.finish()
