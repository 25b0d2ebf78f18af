"""Recorded demonstrations run again: by their states, by their actions, or as the published LIBERO sets were made.

`experiments/robot/libero/regenerate_libero_dataset.py` of OpenVLA made the published sets of the human demonstrations:
from the first recorded state the robot waits ten steps with its gripper open; the recorded actions are executed without
those that do nothing; what is observed before an action is stored with it; an episode counts if the goal holds at its
end. Images have 256 pixels and are turned by half a turn when they are converted: the original's first row is the
bottom one, so they come out upright and mirrored left to right.

Human demonstrations go on for a while when the goal has been reached; those of this package's expert end there. Run
again they may be a step short, so the expert's last action is repeated a few times until the goal holds.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from libero_env.assets.pack import Pack, facade_assets, pack_of, select_pack
from libero_env.demos.actions import KINDS, ActionConverter
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import EXPORTED_STATE, demo_number, read_header
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import PUBLISHED_NOOP_NORM, Episode, Labels, published_noop_steps
from libero_env.demos.write import DemoWriter, require_absent
from libero_env.envs.config import Assets, Drawing, Size
from libero_env.errors import DemoError
from libero_env.mujoco_compat import mujoco
from libero_env.parallel import progress_bar
from libero_env.sim.observations import image_name
from libero_env.tasks import Task
from libero_env.validation import checked

Steps = Annotated[int, Field(ge=0)]
REPLAY_MODES = ("state", "action")
EXTRA_STEPS = 10  # largest number of repetitions of the last action until the goal is reached
_WAIT = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]])  # the action of the waiting steps


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
    config = RenderConfig(tuple(cameras), size, drawing=read_header(file).get("drawing"))
    keys = [image_name(camera, "rgb") for camera in cameras]
    extra = 0 if actions == "delta" else EXTRA_STEPS
    control = KINDS[actions]
    with (
        closing(ActionConverter(file, actions, task)) as converter,
        closing(StateRenderer.of_file(file, config, assets, task=task, control=control)) as renderer,
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
        if by == "state" and t:
            obs = env.set_state(states[t])
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
    writer = DemoWriter(target, read_header(file))
    writer.discard_parts()  # of an interrupted call, perhaps with another file
    with closing(StateRenderer.of_file(file, RenderConfig(()))) as renderer:
        env = renderer.env.batch
        for episode in progress_bar(renderer.episodes(file), desc="replay", unit="demo"):
            renderer.env.set_state(episode.states[0])
            states = []
            for action in episode.actions:
                states.append(env.simulations.physics_state(0))
                env.simulations.step([0], action[None])
            success = bool(env.check_goal(0)[0])
            writer.write(
                demo_number(episode.name), replace(episode, states=np.array(states), success=success)
            )
    return writer.finish()


@checked
class Regeneration:
    """How demonstrations are run again.

    Attributes:
        size: Height and width of the images, pixels.
        settle_steps: Number of waiting steps before the first action.
        extra_steps: Largest number of repetitions of the last action, in recordings of the expert only.
        labels: Actions to store: those that were executed, or the expert's own where the file has them.
        assets: Where models come from, as for `LiberoEnv`; None is the original's models where they are installed, as
            in the facade.
        drawing: How images are drawn, `faithful` or `fast`.
    """

    size: Size = (256, 256)
    settle_steps: Steps = 10
    extra_steps: Steps = EXTRA_STEPS
    labels: Labels = "expert"
    assets: Assets = None
    drawing: Drawing = "faithful"

    def pack(self) -> Pack:
        """Return the pack of the models."""
        return pack_of(facade_assets()) if self.assets is None else select_pack(self.assets)

    def record(self) -> dict[str, Any]:
        """Return what a data set states about how it was made."""
        pack = self.pack()
        return {
            "models": {"pack": pack.name, "digest": pack.digest},
            "drawing": self.drawing,
            "settle_steps": self.settle_steps,
            "extra_steps": f"at most {self.extra_steps}, of the expert's recordings",
            "labels": self.labels,
            "no_op": f"norm(action[:6]) < {PUBLISHED_NOOP_NORM} and the gripper as in the last kept action",
        }


def regenerate(file: Path, config: Regeneration, task: Task | None = None) -> Iterator[Episode]:
    """Run the demonstrations of a file again; one that does not reach the goal is yielded with `success` False.

    Args:
        config: How they are run.
        task: Task that was recorded; None for the one that the file states.

    Raises:
        DemoError: The file is broken or does not fit its task's scene.
    """
    if "generator" not in read_header(file):  # not of this package's expert
        config = replace(config, extra_steps=0)
    rendering = RenderConfig(size=config.size, drawing=config.drawing)
    with closing(StateRenderer.of_file(file, rendering, config.pack(), task=task)) as renderer:
        for episode in renderer.episodes(file):
            yield _regenerate_episode(renderer, episode, config)


def _regenerate_episode(renderer: StateRenderer, episode: Episode, config: Regeneration) -> Episode:
    env = renderer.env.batch
    labels = episode.labels if config.labels == "expert" else episode.actions
    moving = np.flatnonzero(~published_noop_steps(episode.actions))
    env.simulations.set_physics_state(0, episode.states[0])
    for _ in range(config.settle_steps):
        env.simulations.step([0], _WAIT)
    stored: dict[str, list[np.ndarray]] = {
        key: [] for key in (*env.observer.empty_images(0), *EXPORTED_STATE, "joint_states")
    }
    states, actions, success = [], [], False
    recorded = list(zip(episode.actions[moving], labels[moving], strict=True))
    extra = [(episode.labels[-1], episode.labels[-1])] * config.extra_steps
    for i, (executed, label) in enumerate([*recorded, *extra]):
        if success and i >= len(recorded):
            break
        for key, rows in env.render_cameras().items():
            stored[key].append(rows[0, :, ::-1].copy())  # here images are upright: mirrored is half a turn
        obs = env.proprioception()
        for key in (*EXPORTED_STATE, "joint_states"):
            stored[key].append(obs[key][0].copy())
        states.append(env.simulations.physics_state(0))
        actions.append(label)
        env.simulations.step([0], executed[None])
        success = i + 1 >= len(recorded) and bool(env.check_goal(0)[0])
    return Episode(
        np.array(actions).reshape(-1, 7),
        np.array(states),
        obs={key: np.array(values) for key, values in stored.items()},
        success=success,
        fixtures=env.simulations.fixtures[0].copy(),
        name=episode.name,
    )
