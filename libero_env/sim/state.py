"""The read-only state of one simulation, or of all, for predicates, rewards and experts."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from libero_env.assets.robot import FINGER_JOINTS
from libero_env.errors import UnknownNameError, require_known
from libero_env.geometry import quat_to_mat
from libero_env.objects.model import ROOT_BODY
from libero_env.sim.scene import Scene
from libero_env.sim.simulation import Simulations


@dataclass(frozen=True)
class StateView:
    """Read-only view of the state of one simulation, or of all: values of all have a leading axis (num,).

    Positions are in the world frame, m.

    Attributes:
        scene: Scene that is simulated.
        index: Index of the simulation; `slice(None)` stands for all.
    """

    scene: Scene
    simulations: Simulations
    index: int | slice = 0

    def is_entity(self, name: str) -> bool:
        """Return whether the scene has an object or a fixture of this name."""
        return name in self.scene.objects or name in self.scene.fixtures

    def body_pos(self, name: str) -> np.ndarray:
        """Return the origin of the root body of an object or fixture, (3,)."""
        return self._entry("xpos", self._body(name))

    def body_quat(self, name: str) -> np.ndarray:
        """Return the orientation of the root body of an object or fixture, wxyz (4,)."""
        return self._entry("xquat", self._body(name))

    def site_pos(self, name: str) -> np.ndarray:
        """Return the position of a site, (3,)."""
        return self._entry("site_xpos", self.scene.model.site(name).id)

    def site_mat(self, name: str) -> np.ndarray:
        """Return the orientation of a site, site to world (3, 3)."""
        mat = self._entry("site_xmat", self.scene.model.site(name).id)
        return mat.reshape(*mat.shape[:-1], 3, 3)

    def joint_positions(self, address: str) -> dict[str, Any]:
        """Return the positions of articulated joints: name -> rad or m.

        Args:
            address: Name of an object, a fixture, or a region, which stands for the part that it is on.

        Raises:
            UnknownNameError: The object, fixture or region does not exist.
        """
        scene, model = self.scene, self.scene.model
        require_known("object, fixture or region", address, scene.joints)
        return {model.joint(j).name: self._entry("qpos", model.jnt_qposadr[j]) for j in scene.joints[address]}

    @property
    def eef_pos(self) -> np.ndarray:
        """Position of the point between the fingertips, (3,)."""
        return self._entry("site_xpos", self.simulations.arm.site)

    @property
    def eef_mat(self) -> np.ndarray:
        """Orientation of the gripper, grip site to world (3, 3); the fingers open along its x axis."""
        return self._entry("site_xmat", self.simulations.arm.site).reshape(3, 3)

    @property
    def finger_pos(self) -> np.ndarray:
        """Positions of the two fingers, (2,); 0 when closed, +0.04 and -0.04 when open."""
        addresses = [self.scene.model.joint(name).qposadr[0] for name in FINGER_JOINTS]
        return self._entry("qpos", addresses)

    def in_contact(self, first: str, second: str) -> Any:
        """Return whether geoms of two entities touch.

        Args:
            first: Name of an object or fixture, of the workspace (the whole room), or `robot`.
            second: As `first`.

        Raises:
            UnknownNameError: A name does not exist.
        """
        one, other = self._bodies(first), self._bodies(second)
        if isinstance(self.index, slice):
            geoms, owners = self.simulations.contacts
        else:
            geoms, owners = self.simulations.contact_geoms(self.index), None
        pairs = self.scene.model.geom_bodyid[geoms]
        touching = (np.isin(pairs, one) & np.isin(pairs[:, ::-1], other)).any(axis=1)
        if owners is None:
            return bool(touching.any())
        return np.bincount(owners[touching], minlength=self.simulations.num) > 0

    def bounds(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the low and the high corner (3,) of an entity's collision geoms along the world axes."""
        model, corners = self.scene.model, []
        self._bodies(name)  # or it does not exist
        for geom in self.scene.collision_geoms[name]:
            body = model.geom_bodyid[geom]
            mat = quat_to_mat(self._entry("xquat", body))
            geom_mat = mat @ quat_to_mat(model.geom_quat[geom])
            origin = self._entry("xpos", body) + mat @ model.geom_pos[geom]
            centre = origin + geom_mat @ model.geom_aabb[geom, :3]
            half = np.abs(geom_mat) @ model.geom_aabb[geom, 3:]
            corners.append((centre - half, centre + half))
        low, high = zip(*corners, strict=True)
        return np.min(low, axis=0), np.max(high, axis=0)

    def _bodies(self, name: str) -> np.ndarray:
        require_known("object or fixture", name, self.scene.bodies)
        return self.scene.bodies[name]

    def _entry(self, field: str, index: Any) -> Any:
        """Return a copy of an entry of a field, such as the position of a body."""
        return self.simulations.fields[field][self.index, index].copy()

    def _body(self, name: str) -> int:
        if not self.is_entity(name):
            raise UnknownNameError("object or fixture", name, self.scene.entities)
        return self.scene.model.body(f"{name}_{ROOT_BODY}").id
