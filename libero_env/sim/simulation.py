"""Closed-loop simulations of one model: physics and controller, without tasks and images.

A control step has 25 substeps. Each substep runs the controller on the current kinematics, then the rest of the step,
then the kinematics. How the physics is stepped is a matter of `libero_env.sim.back_ends`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from libero_env.errors import ClosedEnvironmentError
from libero_env.mujoco_compat import MASS_FIELD, log_warnings
from libero_env.sim.controller import ControllerState, get_controller
from libero_env.sim.engine import BackEnd
from libero_env.sim.osc import REST, ArmIndex
from libero_env.timing import SUBSTEPS

# Fields of MjData that controllers and state views read.
FIELDS = (
    "qpos",
    "qvel",
    "ctrl",
    "xpos",
    "xquat",
    "xanchor",
    "xaxis",
    "site_xpos",
    "site_xmat",
    MASS_FIELD,
    "qfrc_bias",
)

# Substeps after which the original observes: kinematics of the first, positions of the second
WATCHED = (SUBSTEPS - 2, SUBSTEPS - 1)
Indices = Sequence[int] | np.ndarray
KinematicsHook = Callable[[mujoco.MjData], None]
Watch = Callable[[int, np.ndarray], None]  # number of substeps done, indices of the simulations


class Closed(dict[Any, Any]):
    """What closed simulations have instead of their fields and states."""

    def __missing__(self, key: object) -> None:
        raise ClosedEnvironmentError("this simulation is closed; make another environment")


class Simulations(ABC):
    """Simulations of one model.

    Args:
        model: Model to simulate; it is copied.
        num: Number of simulations.
        fixture_bodies: Indices of the fixed bodies whose pose differs between simulations.

    Attributes:
        model: The copy; its fixtures have the poses of the simulation that was used last.
        rest: Joints of the arm's rest pose, (7,) [rad], as the controller has it; may be set before the first reset.
        num: Number of simulations.
        fixtures: Pose of each fixed body of `fixture_bodies`, (num, nfixtures, 7): position, quaternion wxyz.
        arm: Indices of the arm in the model.
        fields: Field of MjData by name, (num, ...), for reading. Kinematics are those of the current state.
        back_end: Back end that steps them.
        controller_state: Controller that runs, its goals and gripper commands; may be replaced by another.
    """

    back_end = BackEnd()

    def __init__(self, model: mujoco.MjModel, num: int, fixture_bodies: Indices = ()):
        log_warnings()
        self.model, self.num = copy(model), num
        self.fixture_bodies = np.asarray(fixture_bodies, np.int64)
        poses = np.concatenate([model.body_pos, model.body_quat], axis=1)[self.fixture_bodies]
        self.fixtures = np.tile(poses, (num, 1, 1))
        self.arm = ArmIndex.from_model(model)
        self.controller_state = ControllerState(num)
        self.fields: Mapping[str, np.ndarray] = {}
        self.rest = REST
        self._outdated = np.zeros(num, bool)

    @abstractmethod
    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        """Clear simulations, write positions and velocities, and compute everything that depends on them."""

    @abstractmethod
    def _substeps(
        self,
        ids: np.ndarray,
        actions: np.ndarray,
        before_last_kinematics: KinematicsHook | None,
        believed: Mapping[str, np.ndarray],
        watch: Watch | None,
    ) -> None:
        """Run one control period with the goals that are set; in its first substep the controller sees `believed`."""

    @abstractmethod
    def _warm_start(self, i: int) -> list[np.ndarray]:
        """Return what the next step depends on beside the state: [qacc_warmstart (nv,), ctrl (nu,)]."""

    def _set_warm_start(self, i: int, values: list[np.ndarray]) -> None:
        """Write what `_warm_start` returns; where that are views of the simulation, they are written to."""
        for view, value in zip(self._warm_start(i), values, strict=True):
            view[:] = value

    @abstractmethod
    def time(self, i: int) -> float:
        """Return the simulated time since the reset of simulation i, s."""

    @abstractmethod
    def data(self, i: int) -> mujoco.MjData:
        """Return MjData of simulation i, for reading what `fields` does not have."""

    def contact_geoms(self, i: int) -> np.ndarray:
        """Return the indices of the two geoms of each contact of simulation i, (ncontacts, 2)."""
        data = self.data(i)
        return data.contact.geom[: data.ncon]

    def record(self) -> dict[str, str]:
        """Return the back end and what of it the numbers depend on, as plain data."""
        return {"backend": self.back_end.name}

    def set_controller(self, name: str, control_delta: bool = True, rest: np.ndarray = REST) -> None:
        """Choose the controller, before the first reset.

        Args:
            name: Name in the table of `libero_env.sim.controller`.
            control_delta: Whether actions are relative.
            rest: Joints that the controller takes for the arm's rest pose, (7,) [rad].
        """
        self.controller_state, self.rest = (
            ControllerState(self.num, get_controller(name, control_delta)),
            rest,
        )

    def close(self) -> None:
        """Free the simulations. Idempotent."""
        self.fields = Closed()

    def reset(
        self,
        ids: Indices,
        qpos: np.ndarray,
        qvel: np.ndarray,
        time: float = 0.0,
        fixtures: np.ndarray | None = None,
    ) -> None:
        """Start simulations from given states; the controller holds the pose.

        Args:
            ids: Indices of the simulations, (k,).
            qpos: Positions, (k, nq).
            qvel: Velocities, (k, nv).
            time: Simulated time, s.
            fixtures: Pose of each fixture, (k, nfixtures, 7): position, quaternion wxyz; None keeps their poses.
        """
        ids = np.asarray(ids, np.int64)
        if fixtures is not None:
            self.fixtures[ids] = fixtures
        self._start(ids, qpos, qvel, time)
        self._outdated[ids] = False
        pos, mat = self._grip_site()
        self.controller_state.restart(ids, pos[ids], mat[ids])

    def outdate_controller(self, ids: Indices) -> None:
        """Let the controller take the arm to be in its rest pose until the end of the next substep.

        The original's controller does so between `reset`, which measures the arm in its rest pose, and the first
        substep after `set_init_state`, which moves it: robosuite 1.4.0, controllers/base_controller.py, `new_update`.
        The first goal is therefore relative to the rest pose.

        Args:
            ids: Indices of the simulations.
        """
        ids = np.asarray(ids, np.int64)
        self._outdated[ids] = True
        site, rest = self.arm.site, self._rest_fields
        pos, mat = (np.repeat(rest[name][:, site], len(ids), 0) for name in ("site_xpos", "site_xmat"))
        self.controller_state.restart(ids, pos, mat)

    def update_controller(self, ids: Indices) -> None:
        """Let the controller see the arm as it is, which ends `outdate_controller`; its goal stays."""
        self._outdated[np.asarray(ids, np.int64)] = False

    @cached_property
    def _rest_fields(self) -> dict[str, np.ndarray]:
        """Fields of a simulation whose arm is in its rest pose, (1, ...)."""
        data = mujoco.MjData(self.model)
        data.qpos[: len(self.rest)] = self.rest
        mujoco.mj_forward(self.model, data)
        found = {name: np.array(getattr(data, name))[None] for name in FIELDS}
        return {**found, "site_xmat": found["site_xmat"].reshape(1, self.model.nsite, 9)}

    def _believed(self, ids: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the fields that the controller believes, (num, ...): those of the rest pose where it is outdated."""
        if not self._outdated[ids].any():
            return self.fields
        believed = dict(self.fields)
        for name in ("qpos", "qvel", "xanchor", "xaxis", "site_xpos", "site_xmat", MASS_FIELD):
            believed[name] = self.fields[name].copy()
            believed[name][self._outdated] = self._rest_fields[name]
        return believed

    def pose_fixtures(self, i: int) -> None:
        """Write the poses of the fixtures of simulation i to the model."""
        self.model.body_pos[self.fixture_bodies] = self.fixtures[i, :, :3]
        self.model.body_quat[self.fixture_bodies] = self.fixtures[i, :, 3:]

    def step(
        self,
        ids: Indices,
        actions: np.ndarray,
        before_last_kinematics: KinematicsHook | None = None,
        watch: Watch | None = None,
    ) -> None:
        """Advance simulations by one control period.

        Args:
            ids: Indices of the simulations.
            actions: Action of each simulation, (num, action_dim); rows of other simulations are not used.
            before_last_kinematics: Function that is called with each MjData in the last but one substep, after its
                integration and before its kinematics; there the original LIBERO observes. `LoopSimulations` only.
            watch: Function that is called after each substep of `WATCHED`, with the number of substeps done
                and the indices of the simulations whose fields are of that moment.
        """
        ids = np.asarray(ids, np.int64)
        state, believed, site = self.controller_state, self._believed(ids), self.arm.site
        pos, mat = believed["site_xpos"][:, site], believed["site_xmat"][:, site]
        state.controller.set_goals(ids, actions, believed["qpos"], pos, mat, state.goal, state.memory)
        self._substeps(ids, actions, before_last_kinematics, believed, watch)
        self._outdated[ids] = False

    def get_state(self, i: int) -> np.ndarray:
        """Return all that the future of simulation i depends on, (state_size,).

        It consists of time, qpos, qvel, fixtures, warm start, controls and the state of the controller.
        """
        parts = [[self.time(i)], self.fields["qpos"][i], self.fields["qvel"][i], self.fixtures[i].ravel()]
        return np.concatenate([*parts, *self._warm_start(i), self.controller_state.pack(i)])

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state of `get_state`; the simulation continues from there to the same bits."""
        nq, nv, nu, nfixtures = self.model.nq, self.model.nv, self.model.nu, len(self.fixture_bodies)
        sizes = np.cumsum([1, nq, nv, 7 * nfixtures, nv, nu])
        time, qpos, qvel, fixtures, *warm_start, controller = np.split(state, sizes)
        self.reset([i], qpos[None], qvel[None], float(time[0]), fixtures.reshape(1, nfixtures, 7))
        self._set_warm_start(i, warm_start)
        self.controller_state.unpack(i, controller)

    def physics_state(self, i: int) -> np.ndarray:
        """Return [time, qpos, qvel] of simulation i, the original's layout."""
        return np.concatenate([[self.time(i)], self.fields["qpos"][i], self.fields["qvel"][i]])

    def set_physics_state(self, i: int, state: np.ndarray) -> None:
        """Restore [time, qpos, qvel] of simulation i; the controller is reset and holds the pose."""
        nq = self.model.nq
        self.reset([i], state[None, 1 : 1 + nq], state[None, 1 + nq :], float(state[0]))

    @property
    def state_size(self) -> int:
        """Length of the vector of `get_state`."""
        model, fixtures = self.model, 7 * len(self.fixture_bodies)
        warm_start = model.nv + model.nu
        return 1 + model.nq + model.nv + fixtures + warm_start + self.controller_state.controller.state_size

    def _grip_site(self) -> tuple[np.ndarray, np.ndarray]:
        """Return position (num, 3) and orientation (num, 9) of the grip site."""
        site = self.arm.site
        return self.fields["site_xpos"][:, site], self.fields["site_xmat"][:, site]

    def _inputs(self, fields: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """Return the fields that the kernel of a controller takes."""
        site = self.arm.site
        names = ("qpos", "qvel", "xanchor", "xaxis")
        return (
            *(fields[n] for n in names),
            fields["site_xpos"][:, site],
            fields["site_xmat"][:, site],
            fields[MASS_FIELD],
            fields["qfrc_bias"],
        )

    def _constants(self) -> tuple[np.ndarray, ...]:
        """Return the constants that the kernel of a controller takes."""
        return self.arm.mass_address, self.arm.torque_limit, self.arm.finger_range, self.rest
