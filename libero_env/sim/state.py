"""The read-only state of one simulation, for predicates, rewards and experts."""

from dataclasses import dataclass

import numpy as np

from libero_env.assets.robot import FINGER_JOINTS
from libero_env.errors import UnknownNameError
from libero_env.geometry import quat_to_mat
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.osc import ArmIndex
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Simulations


@dataclass(frozen=True)
class StateView:
    """Read-only view of the state of one simulation. Positions are in the world frame, m.

    Attributes:
        scene: Scene that is simulated.
        simulations: Simulations of the scene.
        index: Index of the simulation.
    """

    scene: Scene
    simulations: Simulations
    index: int = 0

    def is_entity(self, name: str) -> bool:
        """Return whether the scene has an object or a fixture of this name."""
        return name in self.scene.objects or name in self.scene.fixtures

    def body_pos(self, name: str) -> np.ndarray:
        """Return the origin of the root body of an object or fixture, (3,)."""
        return self._field("xpos")[self._body(name)].copy()

    def body_quat(self, name: str) -> np.ndarray:
        """Return the orientation of the root body of an object or fixture, wxyz (4,)."""
        return self._field("xquat")[self._body(name)].copy()

    def site_pos(self, name: str) -> np.ndarray:
        """Return the position of a site, (3,)."""
        return self._field("site_xpos")[self.scene.model.site(name).id].copy()

    def site_mat(self, name: str) -> np.ndarray:
        """Return the orientation of a site, site to world (3, 3)."""
        return self._field("site_xmat")[self.scene.model.site(name).id].reshape(3, 3).copy()

    def joint_positions(self, address: str) -> dict[str, float]:
        """Return the positions of articulated joints: name -> rad or m.

        Args:
            address: Name of an object, a fixture, or a region, which stands for the part that it is on.

        Raises:
            UnknownNameError: The object, fixture or region does not exist.
        """
        scene = self.scene
        if address not in scene.joints:
            raise UnknownNameError("object, fixture or region", address, scene.joints)
        qpos = self._field("qpos")
        return {
            scene.model.joint(j).name: float(qpos[scene.model.jnt_qposadr[j]]) for j in scene.joints[address]
        }

    @property
    def eef_pos(self) -> np.ndarray:
        """Position of the point between the fingertips, (3,)."""
        return self._field("site_xpos")[self._arm.site].copy()

    @property
    def eef_mat(self) -> np.ndarray:
        """Orientation of the gripper, grip site to world (3, 3); the fingers open along its x axis."""
        return self._field("site_xmat")[self._arm.site].reshape(3, 3).copy()

    @property
    def finger_pos(self) -> np.ndarray:
        """Positions of the two fingers, (2,); 0 when closed, +0.04 and -0.04 when open."""
        addresses = [self.scene.model.joint(name).qposadr[0] for name in FINGER_JOINTS]
        return self._field("qpos")[addresses]

    def in_contact(self, first: str, second: str) -> bool:
        """Return whether geoms of two entities touch.

        Args:
            first: Name of an object or fixture, of the workspace (the whole room), or `robot`.
            second: As `first`.

        Raises:
            UnknownNameError: A name does not exist.
        """
        pairs = self.scene.model.geom_bodyid[self.simulations.contact_geoms(self.index)]
        bodies = [self._bodies(first), self._bodies(second)]
        for a, b in ((0, 1), (1, 0)):
            if (np.isin(pairs[:, 0], bodies[a]) & np.isin(pairs[:, 1], bodies[b])).any():
                return True
        return False

    def bounds(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and the high corner (3,) of an entity's collision geoms along the world axes."""
        model, corners = self.scene.model, []
        self._bodies(name)  # or it does not exist
        for geom in self.scene.collision_geoms[name]:
            body = model.geom_bodyid[geom]
            mat = quat_to_mat(self._field("xquat")[body])
            geom_mat = mat @ quat_to_mat(model.geom_quat[geom])
            origin = self._field("xpos")[body] + mat @ model.geom_pos[geom]
            centre = origin + geom_mat @ model.geom_aabb[geom, :3]
            half = np.abs(geom_mat) @ model.geom_aabb[geom, 3:]
            corners.append((centre - half, centre + half))
        low, high = zip(*corners, strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def _bodies(self, name: str) -> np.ndarray:
        if name not in self.scene.bodies:
            raise UnknownNameError("object or fixture", name, self.scene.bodies)
        return self.scene.bodies[name]

    @property
    def _arm(self) -> ArmIndex:
        return self.simulations.arm

    def _field(self, name: str) -> np.ndarray:
        return self.simulations.fields[name][self.index]

    def _body(self, name: str) -> int:
        if not self.is_entity(name):
            raise UnknownNameError("object or fixture", name, self.scene.entities)
        return self.scene.model.body(f"{name}_{ROOT_BODY}").id
