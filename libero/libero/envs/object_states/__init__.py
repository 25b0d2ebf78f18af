"""States of objects, fixtures and regions, which predicates ask; `libero_env.sim.predicates` answers."""

from typing import Any

import numpy as np

from libero._adapters.lookup import alias_modules
from libero._adapters.observations import quat_xyzw
from libero_env.sim.predicates import evaluate
from libero_env.tasks.expression import Atom


class BaseObjectState:
    """One object, fixture or region of an environment.

    Attributes:
        env: The environment.
        object_name: Name of the object or fixture, or address of the region.
        parent_name: For a region the object or fixture that it belongs to, or None; otherwise `object_name`.
        is_fixture: Whether it, or its parent, is a fixture.
        query_dict: All objects or all fixtures, by name.
        object_state_type: `object` or `site`.
    """

    object_state_type = "object"

    def __init__(self, env: Any, object_name: str, parent_name: str | None = None, is_fixture: bool = False):
        self.env, self.object_name, self.is_fixture = env, object_name, is_fixture
        self.parent_name: str | None = parent_name or object_name
        self.query_dict: dict[str, Any] = env.fixtures_dict if is_fixture else env.objects_dict

    def _holds(self, predicate: str, *names: str) -> bool:
        return evaluate(Atom(predicate, names), self.env.view)

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """Return `pos` (3,), m, and `quat` (4,), wxyz, in the world frame."""
        raise NotImplementedError

    def check_contact(self, other: "BaseObjectState") -> bool:
        """Return whether the two touch."""
        return self.env.view.in_contact(self.object_name, other.object_name)

    def check_contain(self, other: "BaseObjectState") -> bool:
        """Return whether `other` is inside."""
        return self._holds("In", other.object_name, self.object_name)

    def check_ontop(self, other: "BaseObjectState") -> bool:
        """Return whether `other` is on top."""
        return self._holds("On", other.object_name, self.object_name)

    def get_joint_state(self) -> list[float]:
        """Return the positions of its joints, rad or m; empty for an object without joints."""
        has_joints = self.object_name in self.env.scene.joints
        return list(self.env.view.joint_positions(self.object_name).values()) if has_joints else []

    def set_joint(self, qpos: float = 1.5) -> None:
        """Set the positions of its joints, rad or m."""
        for name in self.env.view.joint_positions(self.object_name):
            self.env.sim.data.set_joint_qpos(name, qpos)
        self.env.sim.forward()

    def is_open(self) -> bool:
        """Return whether any joint is in the open range."""
        return bool(self.get_joint_state()) and self._holds("Open", self.object_name)

    def is_close(self) -> bool:
        """Return whether all joints are in the closed range; true without joints."""
        return not self.get_joint_state() or self._holds("Close", self.object_name)

    def turn_on(self) -> bool:
        """Return whether any joint is in the range of on."""
        return bool(self.get_joint_state()) and self._holds("Turnon", self.object_name)

    def turn_off(self) -> bool:
        """Return whether all joints are in the range of off; true without joints."""
        return not self.get_joint_state() or self._holds("Turnoff", self.object_name)

    def update_state(self) -> None:
        """Do nothing: the appearance of an object follows from the state."""


class ObjectState(BaseObjectState):
    """An object or a fixture."""

    def __init__(self, env: Any, object_name: str, is_fixture: bool = False):
        super().__init__(env, object_name, None, is_fixture)
        self.has_turnon_affordance = "turnon" in env.scene.entities[object_name].articulation

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """Return `pos` (3,), m, and `quat` (4,), wxyz, in the world frame."""
        view, name = self.env.view, self.object_name
        return {"pos": view.body_pos(name), "quat": view.body_quat(name)}


class SiteObjectState(BaseObjectState):
    """A region: a named site of an object or fixture, or a zone of the workspace."""

    object_state_type = "site"

    def __init__(self, env: Any, object_name: str, parent_name: str | None, is_fixture: bool = False):
        super().__init__(env, object_name, parent_name, parent_name in env.fixtures_dict)
        self.parent_name = parent_name

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """Return `pos` (3,), m, and `quat` (4,), xyzw as in the original, in the world frame."""
        view, name = self.env.view, self.object_name
        return {"pos": view.site_pos(name), "quat": quat_xyzw(view.site_mat(name))}

    def check_contact(self, other: BaseObjectState) -> bool:
        """Return True: contact does not matter for a region."""
        return True


alias_modules(__name__, "base_object_states")
