"""Keeping the hand clear of what it need not touch, whatever skill moves it."""

import numpy as np

from libero_env.assets.robot import FINGER_JOINTS
from libero_env.expert.arm import DAMPING_TIME
from libero_env.geometry import Pose, rotation_between
from libero_env.mujoco_compat import mujoco
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE
from libero_env.sim.predicates import ground
from libero_env.sim.scene import ROBOT
from libero_env.sim.state import StateView
from libero_env.sim.watch import ancestors
from libero_env.tasks.expression import Expression
from libero_env.timing import CONTROL_HZ

MARGIN, TOUCH = 0.008, 0.001  # [m] that the hand keeps, and from a fixture whose part it moves
NEAR = 0.05  # [m] from which on it is watched
SWEEPS = 4  # over what is near, so that a hand in a corner keeps clear of both sides
WRIST = "robot0_link7"


class Guard:
    """Damper of the hand: the nearer to a thing, the slower towards it, and away from it within the margin.

    The limit of the speed is that of Faverjon and Tournassoud, "A local based approach for path planning of
    manipulators with a high number of degrees of freedom", ICRA 1987. Palm and wrist keep clear of all objects and
    fixtures, fingers only of the objects that the goal is not about.

    Args:
        view: State view of the simulation.
        goal: Goal of the episode.
    """

    def __init__(self, view: StateView, goal: Expression):
        scene, self._model = view.scene, view.simulations.model
        about = {scene.owner(name) for atom in ground(goal, scene).wanted() for name in atom.args}
        model, self._data = self._model, mujoco.MjData(self._model)
        wrist, fingers = model.body(WRIST).id, {int(model.joint(name).bodyid[0]) for name in FINGER_JOINTS}
        parts = {
            int(geom): ancestors(model, model.geom_bodyid[geom]) for geom in scene.collision_geoms[ROBOT]
        }
        things = [(int(geom), name) for name in scene.entities for geom in scene.collision_geoms[name]]
        self._pairs = [
            (part, geom, name)
            for part, bodies in parts.items()
            for geom, name in things
            if wrist in bodies and (not bodies & fingers or name in scene.objects and name not in about)
        ]
        self._geoms = np.array([pair[:2] for pair in self._pairs], int).reshape(-1, 2)
        self._pose: Pose | None = None  # of the grip site one step ago

    def steer(self, view: StateView, action: np.ndarray, handled: str | None) -> np.ndarray:
        """Return the action (7,) that is nearest to one and keeps the hand clear.

        Args:
            handled: Object that is carried and may be touched, or fixture whose part is moved.
        """
        pose = Pose(view.eef_pos, view.eef_mat)
        before, self._pose = self._pose or pose, pose
        moved, turned = pose.pos - before.pos, rotation_between(before.mat, pose.mat)
        spin = ROTATION_SCALE * action[3:6] + DAMPING_TIME * CONTROL_HZ * turned
        model, data, ends = self._model, self._data, np.zeros(6)
        assert isinstance(view.index, int)
        view.simulations.pose_fixtures(view.index)
        data.qpos[:] = view.simulations.fields["qpos"][view.index]
        mujoco.mj_kinematics(model, data)
        first, second = self._geoms.T
        reach = model.geom_rbound[first] + model.geom_rbound[second] + NEAR
        middles = np.linalg.norm(data.geom_xpos[first] - data.geom_xpos[second], axis=1)
        limits = []  # direction away from a thing, (3,), and least distance to go along it, [m]
        for part, geom, name in (self._pairs[k] for k in np.flatnonzero(middles < reach)):
            distance = mujoco.mj_geomDistance(model, data, part, geom, NEAR, ends)
            if distance < NEAR and distance != 0 and (name != handled or name in view.scene.fixtures):
                away = (ends[:3] - ends[3:]) / distance
                comes = DAMPING_TIME * CONTROL_HZ * moved + np.cross(spin, ends[:3] - pose.pos)
                margin = TOUCH if name == handled else MARGIN
                limits.append((away, margin - distance - float(comes @ away)))
        move = POSITION_SCALE * action[:3]
        for away, least in limits * SWEEPS:
            move = move + max(least - float(move @ away), 0.0) * away
        return np.concatenate([np.clip(move / POSITION_SCALE, -1.0, 1.0), action[3:]])
