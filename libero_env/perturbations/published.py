"""What the variants of LIBERO-Plus change, as exact changes of an environment."""

from dataclasses import dataclass

import numpy as np

from libero_env.assets.arena import workspace_of_problem
from libero_env.perturbations.corruptions import corrupt
from libero_env.perturbations.kinds import Change, Episode, ObservationFilter
from libero_env.perturbations.starts import RobotJoints
from libero_env.sim.appearance import Appearance, CameraView
from libero_env.tasks.published.plus import camera_pose, joint_pose
from libero_env.tasks.published.suites import PublishedTask
from libero_env.tasks.task import Task

CAMERA = "agentview"  # the only camera that LIBERO-Plus changes
_PICTURE = f"{CAMERA}_rgb"


@dataclass(frozen=True)
class Corruption(ObservationFilter):
    """Noise on the pictures of `agentview`, sampled anew for each, see `libero_env.perturbations.corruptions`.

    LIBERO-Plus' code leaves the first picture after an initial state is set without noise; here it has it too.

    Attributes:
        kind: `motion`, `gaussian`, `zoom`, `fog` or `glass`.
        severity: Severity, 1 to 10.
    """

    kind: str
    severity: int

    def image(self, name: str, image: np.ndarray, episode: Episode) -> np.ndarray:
        """Return the picture with noise."""
        if name != _PICTURE:
            return image
        rng = episode.key.generator(episode.step)
        upside_down = corrupt(image[::-1], self.kind, self.severity, rng)  # as theirs are
        return upside_down[::-1]


def published_changes(task: Task) -> tuple[Change, ...]:
    """Return what the environment of a task changes beside the problem; nothing for most tasks.

    Args:
        task: Task; those of LIBERO-Plus change something.
    """
    if not isinstance(task, PublishedTask) or task.variant is None:
        return ()
    variant, workspace = task.variant, workspace_of_problem(task.problem.name).name
    pose = camera_pose(workspace, variant.view)
    view = CameraView(tuple(pose.pos.tolist()), tuple(pose.quat_wxyz.tolist()))
    changes: list[Change] = [Appearance(cameras={CAMERA: view})]
    if variant.pose and task.robot_state == "skipped":
        changes.append(RobotJoints(tuple(joint_pose(variant.pose).tolist())))
    if variant.noise is not None:
        changes.append(Corruption(variant.noise.kind, variant.noise.severity))
    return tuple(changes)


def rest_of(task: Task) -> np.ndarray:
    """Return the joints that the controller takes for the arm's rest pose, (7,) [rad].

    In LIBERO-Plus they are those of the variant, whether the arm starts there or not: its controller pulls towards
    them in its null space, and its first goals are relative to them.
    """
    variant = task.variant if isinstance(task, PublishedTask) else None
    return joint_pose(0 if variant is None else variant.pose)
