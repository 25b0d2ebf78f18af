"""Plans to pick and place an object, and the choice of one that the arm reaches."""

from dataclasses import dataclass, replace

import numpy as np

from libero_env.expert.arm import joint_angles
from libero_env.expert.grasping.grasps import Grasp
from libero_env.expert.planning.place_poses import PlacePose
from libero_env.expert.shapes import Shapes
from libero_env.geometry import Pose, rotation_between
from libero_env.sim.state import StateView

# signs of the axes of the hand as it is, and rotated by half a turn about its approach
FLIPS = np.ones(3), np.array([-1.0, -1.0, 1.0])
ENTRY_DISTANCE = 0.16  # [m] before a place that is entered from a side
_ENTRY_HEIGHT = 0.08  # [m] above a place that is entered from above
_PREGRASP_DISTANCE = 0.10  # [m] before a grasp
_LIFT_HEIGHT = 0.10  # [m] above the grasp, where the hand rotates to its orientation at the place


@dataclass(frozen=True)
class PickPlan:
    """Where to grasp an object and where to release it.

    Attributes:
        object_pose: Pose of the object now.
        drop_height: Height above the place at which the object is released, [m].
        cost: Cost of the plan; lower is better.
    """

    grasp: Grasp
    place: PlacePose
    object_pose: Pose
    drop_height: float
    cost: float

    @property
    def release_mat(self) -> np.ndarray:
        """Orientation of the grip site where the object is released, (3, 3)."""
        return self.place.mat @ self.object_pose.mat.T @ self.grasp.mat

    @property
    def release_pos(self) -> np.ndarray:
        """Position of the grip site where the object is released, (3,)."""
        rotation = self.place.mat @ self.object_pose.mat.T
        offset = rotation @ (self.grasp.pos_world - self.object_pose.pos)
        return self.place.pos + [0, 0, self.drop_height] + offset


@dataclass(frozen=True)
class FailedAttempt:
    """What was tried without success.

    Attributes:
        grasp: Pose of the grip site in the object's frame; None where the grasp did not fail.
        place: Place, where the object got there.
    """

    grasp: Pose | None
    place: PlacePose | None = None

    @classmethod
    def from_plan(cls, plan: PickPlan, placed: bool) -> "FailedAttempt":
        """Return the failed attempt of a plan, after the object was released at its place or before."""
        grasp = plan.object_pose.to_local(Pose(plan.grasp.pos_world, plan.grasp.mat))
        return cls(grasp, plan.place if placed else None)


@dataclass(frozen=True)
class PickSearch:
    """Limits of the search for a pick plan.

    Attributes:
        top_grasps: Number of grasps from straight above, for each attempt so far and the next one.
        tilted_grasps: Number of grasps for one tilted approach, likewise.
        crowded_grasps: Number of them at the first attempt where obstacles leave no room from above: the first few
            may all hit something. Later attempts differ more from each other with few.
        grasp_spacing: Distance between grasps below which only the best is kept, [m].
        obstacle_radius: Distance from an object beyond which nothing is in the hand's way, [m].
        collision_limit: Cost of the best grasp from which on more tilted approaches are searched.
        places_per_group: Number of places with the same orientation of the object and the same depth.
        depth_step: Difference in depth, along the entry, that makes a different group, [m].
        entry_directions: Number of directions of tilted approaches.
        pairs: Number of grasp and place pairs.
        reach_trials: Number of pairs for which inverse kinematics is solved.
        reach_tolerance: Error of inverse kinematics that counts as reached, [m].
        unreachable_error: Error from which on similar pairs are skipped, [m].
        retry_cost: Cost of a grasp or a place that failed before.
        side_cost: Cost of a grasp for each [m] that it is farther from the place than the middle of the object, so that
            all demonstrations take the same side of a symmetric one.
        same_distance: Distance between grasps or places that count as the same, [m].
        same_angle: Angle between them, [rad].
    """

    top_grasps: int = 20
    tilted_grasps: int = 4
    crowded_grasps: int = 16
    grasp_spacing: float = 0.015
    obstacle_radius: float = 0.3
    collision_limit: float = 1.0
    places: int = 72
    places_per_group: int = 2
    depth_step: float = 0.03
    entry_directions: int = 8
    pairs: int = 1000
    reach_trials: int = 24
    reach_tolerance: float = 1e-4
    unreachable_error: float = 0.03
    retry_cost: float = 0.5
    side_cost: float = 1.5
    same_distance: float = 0.02
    same_angle: float = 0.4

    def is_same(self, pose: Pose, other: Pose) -> bool:
        """Return whether two grasps or places are so close that they succeed or fail together."""
        near = np.linalg.norm(pose.pos - other.pos) < self.same_distance
        return bool(near and np.linalg.norm(rotation_between(pose.mat, other.mat)) < self.same_angle)


SEARCH = PickSearch()


def first_reachable(
    view: StateView, shapes: Shapes, plans: list[PickPlan], held: bool = False
) -> tuple[PickPlan, float]:
    """Return the first plan that the arm reaches, or the one with the smallest error; and the error.

    Args:
        shapes: Shapes of the scene, with the arm's kinematics.
        plans: Plans, best first.
        held: Whether the hand holds the object already; else it may also be rotated by half a turn.
    """
    start = joint_angles(view)
    best: tuple[float, PickPlan] | None = None
    grasped: dict[tuple[int, int], tuple[np.ndarray, float]] = {}  # grasp and flip -> angles and error there
    unreachable: set[tuple] = set()
    trials = 0
    for candidate in plans:
        for side, signs in enumerate(FLIPS[: 1 if held else 2]):
            grasp = replace(candidate.grasp, mat=candidate.grasp.mat * signs)
            key = id(candidate.grasp), side
            if held:
                grasped[key] = start, 0.0
            elif key not in grasped:
                pregrasp = Pose(grasp.pos_world - _PREGRASP_DISTANCE * grasp.mat[:, 2], grasp.mat)
                grasped[key] = shapes.arm.follow(start, [pregrasp, Pose(grasp.pos_world, grasp.mat)])
            angles, grasp_error = grasped[key]
            if best is not None and grasp_error >= best[0]:
                continue
            similar = (*key, *np.round(candidate.place.mat.ravel(), 1), *np.round(candidate.place.entry))
            if similar in unreachable:
                continue
            plan, trials = replace(candidate, grasp=grasp), trials + 1
            error = max(grasp_error, shapes.arm.follow(angles, _place_path(plan)[held:])[1])
            if error > SEARCH.unreachable_error:
                unreachable.add(similar)
            if best is None or error < best[0]:
                best = error, plan
            if error < SEARCH.reach_tolerance:
                return plan, error
        if trials > SEARCH.reach_trials:
            break
    assert best is not None
    return best[1], best[0]


def _place_path(plan: PickPlan) -> list[Pose]:
    """Return poses of the grip site on the way from the grasp to the place."""
    distance = _ENTRY_HEIGHT if plan.place.from_above else ENTRY_DISTANCE
    pos, mat = plan.release_pos, plan.release_mat
    return [
        Pose(plan.grasp.pos_world + [0.0, 0.0, _LIFT_HEIGHT], mat),
        Pose(pos - distance * plan.place.entry, mat),
        Pose(pos, mat),
    ]
