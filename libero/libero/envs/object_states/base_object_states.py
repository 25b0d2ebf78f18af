"""What predicates ask of objects, fixtures and regions; the answers are `libero_env.sim.predicates`'."""

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from libero_env.sim.predicates import evaluate
from libero_env.tasks.problem import Atom

if TYPE_CHECKING:
    from libero.libero.envs.bddl_base_domain import BDDLBaseDomain


class BaseObjectState:
    """One thing of an environment: an object, a fixture or a region.

    Attributes:
        env: the environment.
        object_name: name of the thing, for a region its address.
        parent_name: for a region the thing that it belongs to, else the thing itself.
        is_fixture: whether it (or its parent) is a fixture.
        object_state_type: `object` or `site`.
    """

    object_state_type = "object"

    def __init__(
        self,
        env: "BDDLBaseDomain",
        object_name: str,
        parent_name: str | None = None,
        is_fixture: bool = False,
    ):
        self.env, self.object_name, self.is_fixture = env, object_name, is_fixture
        self.parent_name = parent_name or object_name
        self.query_dict: dict[str, Any] = {}

    def _true(self, predicate: str, *args: str) -> bool:
        return evaluate(Atom(predicate, args), self.env.view)

    def _of_joints(self, predicate: str, without: bool) -> bool:
        """Truth of a predicate about joints; `without` any as of the empty `any` and `all`."""
        return self._true(predicate, self.object_name) if self.get_joint_state() else without

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """`pos` (3,) m and `quat` (4,) wxyz in the world frame."""
        raise NotImplementedError

    def check_contact(self, other: "BaseObjectState") -> bool:
        """Whether the two touch."""
        return self.env.view.in_contact(self.object_name, other.object_name)

    def check_contain(self, other: "BaseObjectState") -> bool:
        """Whether `other` is inside."""
        return self._true("In", other.object_name, self.object_name)

    def check_ontop(self, other: "BaseObjectState") -> bool:
        """Whether `other` stands on top."""
        return self._true("On", other.object_name, self.object_name)

    def get_joint_state(self) -> list[float]:
        """Positions of the joints that open, close or turn it, rad or m."""
        known = self.object_name in self.env.scene.joints
        return list(self.env.view.joint_positions(self.object_name).values()) if known else []

    def set_joint(self, qpos: float = 1.5) -> None:
        """Put the joints of the thing somewhere."""
        for name in self.env.view.joint_positions(self.object_name):
            self.env.sim.data.set_joint_qpos(name, qpos)
        self.env.sim.forward()

    def is_open(self) -> bool:
        """Whether any joint is as far out as open begins."""
        return self._of_joints("Open", without=False)

    def is_close(self) -> bool:
        """Whether all joints are as far in as closed begins."""
        return self._of_joints("Close", without=True)

    def turn_on(self) -> bool:
        """Whether any joint is as far as on begins."""
        return self._of_joints("Turnon", without=False)

    def turn_off(self) -> bool:
        """Whether all joints are as far back as off begins."""
        return self._of_joints("Turnoff", without=True)

    def update_state(self) -> None:
        """Nothing to do: what a state looks like follows from the state."""


class ObjectState(BaseObjectState):
    """An object or a fixture."""

    def __init__(self, env: "BDDLBaseDomain", object_name: str, is_fixture: bool = False):
        super().__init__(env, object_name, None, is_fixture)
        self.has_turnon_affordance = "turnon" in self._model().articulation

    def _model(self) -> Any:
        return self.env.scene.entities[self.object_name]

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """`pos` (3,) m and `quat` (4,) wxyz in the world frame."""
        return {
            "pos": self.env.view.body_pos(self.object_name),
            "quat": self.env.view.body_quat(self.object_name),
        }


class SiteObjectState(BaseObjectState):
    """A region: a named site of a thing, or a zone of the workspace."""

    object_state_type = "site"

    def get_geom_state(self) -> dict[str, np.ndarray]:
        """`pos` (3,) m and `quat` (4,) wxyz in the world frame."""
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, self.env.view.site_mat(self.object_name).ravel())
        return {"pos": self.env.view.site_pos(self.object_name), "quat": quat}

    def check_contact(self, other: BaseObjectState) -> bool:
        """True, as a region touches nothing."""
        return True
