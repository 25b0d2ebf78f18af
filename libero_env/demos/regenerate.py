"""Demonstrations run again as the published LIBERO sets were made, with their images, states and actions.

`experiments/robot/libero/regenerate_libero_dataset.py` of OpenVLA made them of the human demonstrations: from the first
recorded state the robot waits ten steps with its gripper open; the recorded actions are executed without those that do
nothing; what is observed before an action is stored with it; an episode counts if the goal holds at its end. Images
have 256 pixels and are turned by half a turn when they are converted: the original's first row is the bottom one, so
they come out upright and mirrored left to right.

Human demonstrations go on for a while when the goal has been reached; those of this package's expert end there. Run
again they may be a step short, so the expert's last action is repeated a few times until the goal holds.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from libero_env.assets.pack import Pack, facade_assets, pack_of, select_pack
from libero_env.demos.curate import read_episodes, recorded_robot, recorded_task
from libero_env.demos.header import read_header
from libero_env.demos.lerobot_layout import ExportedEpisode
from libero_env.demos.replay import checked_fixtures
from libero_env.demos.write import Episode
from libero_env.envs.config import EnvConfig
from libero_env.envs.world import World

NOOP_NORM = 1e-4  # [action units] Euclidean norm of a motion below which it counts as none
_OPEN = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]])  # the action of the waiting steps


@dataclass(frozen=True)
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
        robot: Model of the arm, as for `LiberoEnv`.
    """

    size: tuple[int, int] = (256, 256)
    settle_steps: int = 10
    extra_steps: int = 10
    labels: Literal["expert", "executed"] = "expert"
    assets: Pack | str | Path | None = None
    drawing: str = "faithful"
    robot: str = EnvConfig.robot

    def pack(self) -> Pack:
        """Return the pack of the models."""
        if self.assets is None:
            return pack_of(facade_assets())
        return select_pack(self.assets) if isinstance(self.assets, str | Path) else self.assets

    def env_config(self) -> EnvConfig:
        """Return the configuration of the simulation."""
        return EnvConfig(camera_size=self.size, assets=self.pack(), drawing=self.drawing, robot=self.robot)

    def record(self) -> dict[str, Any]:
        """Return what a data set states about how it was made."""
        pack = self.pack()
        return {
            "models": {"pack": pack.name, "digest": pack.digest},
            "drawing": self.drawing,
            "robot": self.robot,
            "settle_steps": self.settle_steps,
            "extra_steps": f"at most {self.extra_steps}, of the expert's recordings",
            "labels": self.labels,
            "no_op": f"norm(action[:6]) < {NOOP_NORM} and the gripper as in the last kept action",
        }


def regenerate(file: Path, config: Regeneration) -> Iterator[ExportedEpisode]:
    """Run the demonstrations of a file again; one that does not reach the goal is yielded with `success` False.

    Args:
        file: Demonstration file.
        config: How they are run.

    Raises:
        DemoError: The file is broken or does not fit its task's scene.
    """
    if "generator" not in read_header(file):  # not of this package's expert
        config = replace(config, extra_steps=0)
    world = World(recorded_task(file), config=config.env_config(), robot=recorded_robot(file))
    try:
        for name, episode in read_episodes(file):
            world.simulations.fixtures[0] = checked_fixtures(file, name, episode, world.scene)
            yield _run(world, episode, config, f"{file}: {name}")
    finally:
        world.close()


def noop_mask(actions: np.ndarray) -> np.ndarray:
    """Return which actions (T, 7) do nothing, (T,) bool: no motion, and the gripper as in the last one that is kept."""
    still = np.linalg.norm(actions[:, :6], axis=1) < NOOP_NORM
    found = np.zeros(len(actions), bool)
    gripper = None
    for t, action in enumerate(actions):
        found[t] = still[t] and gripper in (None, action[6])
        gripper = gripper if found[t] else action[6]
    return found


def _run(world: World, episode: Episode, config: Regeneration, where: str) -> ExportedEpisode:
    labels = episode.labels if config.labels == "expert" else episode.actions
    kept = np.flatnonzero(~noop_mask(episode.actions))
    world.set_physics_state(0, episode.states[0])
    for _ in range(config.settle_steps):
        world.step([0], _OPEN)
    images = world.empty_images()
    stored: dict[str, list[np.ndarray]] = {key: [] for key in images}
    states, actions, success = [], [], False
    recorded = list(zip(episode.actions[kept], labels[kept], strict=True))
    extra = [(episode.labels[-1], episode.labels[-1])] * config.extra_steps
    for i, (executed, label) in enumerate([*recorded, *extra]):
        if success and i >= len(recorded):
            break
        world.render_cameras([0], images)
        for key, rows in images.items():
            stored[key].append(rows[0, :, ::-1].copy())  # here images are upright: mirrored is half a turn
        obs = world.proprioception()
        states.append(np.concatenate([obs[key][0] for key in ("ee_pos", "ee_ori", "gripper_states")]))
        actions.append(label)
        world.step([0], executed[None])
        success = i + 1 >= len(recorded) and world.check_goal(0)[0]
    return ExportedEpisode(
        state=np.array(states, np.float32).reshape(-1, 8),
        action=np.array(actions, np.float32).reshape(-1, 7),
        success=success,
        images={key: np.array(frames) for key, frames in stored.items()},
        where=where,
    )
