"""The choice of a plan that the arm reaches, by inverse kinematics."""

from dataclasses import replace

import numpy as np

from libero_env.expert.arm.kinematics import joint_angles
from libero_env.expert.planning.pick_plan import FLIPS, SEARCH, PickPlan
from libero_env.expert.shapes import Shapes
from libero_env.geometry import Pose
from libero_env.sim.state import StateView

ENTRY_DISTANCE = 0.16  # [m] before a place that is entered from a side
_ENTRY_HEIGHT = 0.08  # [m] above a place that is entered from above
_PREGRASP_DISTANCE = 0.10  # [m] before a grasp
_LIFT_HEIGHT = 0.10  # [m] above the grasp, where the hand rotates to its orientation at the place


def first_reachable(
    view: StateView, shapes: Shapes, plans: list[PickPlan], flip: bool = True
) -> tuple[PickPlan, float]:
    """Return the first plan that the arm reaches, or the one with the smallest error; and the error.

    Args:
        view: State of the simulation.
        shapes: Shapes of the scene, with the arm's kinematics.
        plans: Plans, best first.
        flip: Whether the hand may also be rotated by half a turn.
    """
    start = joint_angles(view)
    best: tuple[float, PickPlan] | None = None
    grasped: dict[tuple[int, int], tuple[np.ndarray, float]] = {}  # grasp and flip -> angles and error there
    unreachable: set[tuple] = set()
    trials = 0
    for candidate in plans:
        for side, signs in enumerate(FLIPS[: 1 + flip]):
            grasp = replace(candidate.grasp, mat=candidate.grasp.mat * signs)
            key = id(candidate.grasp), side
            if key not in grasped:
                pregrasp = Pose(grasp.pos_world - _PREGRASP_DISTANCE * grasp.mat[:, 2], grasp.mat)
                grasped[key] = shapes.arm.follow(start, [pregrasp, Pose(grasp.pos_world, grasp.mat)])
            angles, grasp_error = grasped[key]
            if best is not None and grasp_error >= best[0]:
                continue
            similar = (*key, *np.round(candidate.place.mat.ravel(), 1), *np.round(candidate.place.entry))
            if similar in unreachable:
                continue
            plan, trials = replace(candidate, grasp=grasp), trials + 1
            error = max(grasp_error, shapes.arm.follow(angles, _place_path(plan))[1])
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
