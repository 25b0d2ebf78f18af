"""Demonstrations run again as the published LIBERO sets were made.

`experiments/robot/libero/regenerate_libero_dataset.py` of OpenVLA made the published sets of the human demonstrations:
from the first recorded state the robot waits ten steps with its gripper open; the recorded actions are executed without
those that do nothing; what is observed before an action is stored with it; an episode counts if the goal holds at its
end. Images have 256 pixels and are turned by half a turn when they are converted: the original's first row is the
bottom one, so they come out upright and mirrored left to right.

Human demonstrations go on for a while when the goal has been reached; those of this package's expert end there. Run
again they may be a step short, so the expert's last action is repeated a few times until the goal holds.
"""

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from libero_env.assets.pack import Pack, facade_assets, pack_of, select_pack
from libero_env.demos.config import RenderConfig
from libero_env.demos.contents import read_header
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import Episode, Labels, keeps_gripper
from libero_env.demos.replay import EXTRA_STEPS
from libero_env.envs.config import Assets, Drawing, Size
from libero_env.images import flip_rows, rotate_180
from libero_env.tasks import Task
from libero_env.validation import checked
from libero_integrations.exports.layouts import STATE

Steps = Annotated[int, Field(ge=0)]
# [action units] Euclidean norm below which the published sets count a motion as none
NOOP_NORM = 1e-4
_WAIT = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0]])  # the action of the waiting steps


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
            "no_op": f"norm(action[:6]) < {NOOP_NORM} and the gripper as in the last kept action",
        }


def regenerate(file: Path, config: Regeneration, task: Task | None = None) -> Iterator[Episode]:
    """Run the demonstrations of a file again; one that does not reach the goal is yielded with `success` False.

    Args:
        config: How they are run.
        task: Task that was recorded; None for the one that the file states.

    Raises:
        DemoError: The file is broken or does not fit its task's scene.
    """
    # those recorded by hand, and the original's, end as they are
    if not str(read_header(file).get("generator")).startswith("scripted-expert"):
        config = replace(config, extra_steps=0)
    rendering = RenderConfig(size=config.size, drawing=config.drawing)
    with closing(StateRenderer.of_file(file, rendering, config.pack(), task=task)) as renderer:
        for episode in renderer.episodes(file):
            yield _regenerate_episode(renderer, episode, config)


def _regenerate_episode(renderer: StateRenderer, episode: Episode, config: Regeneration) -> Episode:
    env = renderer.env.batch
    labels = episode.labels if config.labels == "expert" else episode.actions
    moving = np.flatnonzero(~published_noop_steps(episode.actions))
    renderer.env.set_state(episode.states[0])
    for _ in range(config.settle_steps):
        env.simulations.step([0], _WAIT)
        env.check_goal(0)  # conditions over time remember each moment
    stored: dict[str, list[np.ndarray]] = {
        key: [] for key in (*env.observer.empty_images(0), *STATE, "joint_states")
    }
    states, actions, success = [], [], False
    recorded = list(zip(episode.actions[moving], labels[moving], strict=True))
    extra = [(episode.labels[-1], episode.labels[-1])] * config.extra_steps
    for i, (executed, label) in enumerate([*recorded, *extra]):
        if success and i >= len(recorded):
            break
        for key, rows in env.render_cameras().items():
            stored[key].append(rotate_180(flip_rows(rows[0])).copy())
        obs = env.proprioception()
        for key in (*STATE, "joint_states"):
            stored[key].append(obs[key][0].copy())
        states.append(env.simulations.physics_state(0))
        actions.append(label)
        env.simulations.step([0], executed[None])
        success = env.check_goal(0)[0] and i + 1 >= len(recorded)
    return Episode(
        np.array(actions).reshape(-1, 7),
        np.array(states),
        obs={key: np.array(values) for key, values in stored.items()},
        success=success,
        fixtures=env.simulations.fixtures[0].copy(),
        name=episode.name,
    )


def published_noop_steps(actions: np.ndarray) -> np.ndarray:
    """Return which actions (T, 7) the makers of the published sets leave out as no-ops, (T,) bool.

    The Euclidean norm of the motion decides, and whether the gripper command is that of the last action that is kept;
    before the first motion no action is kept, whatever the gripper does.
    """
    still = np.linalg.norm(actions[:, :6], axis=1) < NOOP_NORM
    return still & (keeps_gripper(actions) | np.logical_and.accumulate(still))
