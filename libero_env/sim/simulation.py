"""Closed-loop simulations of one model: physics and controller, without tasks and images.

A control step has 25 substeps at 20 Hz. Each substep runs the controller on the current kinematics, then the rest of
the step, then the kinematics. `LoopSimulations` steps one MjData after another (one simulation, or MuJoCo without
`mujoco.batch`), `BatchSimulations` steps on a thread pool, to the same bits. `libero_env.warp` steps on a GPU in
single precision.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np

from libero_env.errors import ClosedEnvironmentError, LiberoError, SimulationError
from libero_env.mujoco_compat import MASS_FIELD, log_warnings, mujoco
from libero_env.sim.backend import Backend
from libero_env.sim.controller import ControllerState, get_controller
from libero_env.sim.osc import REST, ArmIndex
from libero_env.timing import SUBSTEPS

try:
    from mujoco.batch import Batch
except ImportError:  # before MuJoCo 4
    Batch = None

# Fields of MjData that controllers and state views read.
FIELDS = (
    *("qpos", "qvel", "ctrl", "xpos", "xquat", "xanchor", "xaxis", "site_xpos", "site_xmat"),
    *(MASS_FIELD, "qfrc_bias"),
)
# Those that the controller sees of the arm, not of contacts.
_CONTROLLED = ("qpos", "qvel", "xanchor", "xaxis", "site_xpos", "site_xmat", MASS_FIELD)

INTEGRATED = -1  # between integration and kinematics of each substep; of `LoopSimulations` only


FORKED = (
    "this process was forked from the one that made the environment, and can neither step nor render it. Make "
    "environments after the fork, or start processes with multiprocessing.get_context('spawn')"
)
DIVERGED = "it has diverged: positions, velocities or accelerations are not numbers, or are huge"
_UNSTABLE = [getattr(mujoco.mjtWarning, f"mjWARN_BADQ{what}") for what in ("POS", "VEL", "ACC")]
Indices = Sequence[int] | np.ndarray
Watch = Callable[
    [int, np.ndarray], None
]  # number of substeps done or `INTEGRATED`, indices of the simulations
Inputs = tuple[np.ndarray, ...]  # fields that the kernel of a controller takes, (num, ...)


class Unusable:
    """What simulations that are closed, or of another process, have instead of their states: every use is an error."""

    def __init__(self, error: LiberoError):
        self._error = error

    def __getattr__(self, name: str) -> Any:
        raise self._error

    def __getitem__(self, key: object) -> Any:
        raise self._error


CLOSED: Any = Unusable(ClosedEnvironmentError("this simulation is closed; make another environment"))


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
        backend: Backend that steps them.
        substeps: Number of substeps of a control step; may be set.
        controller_state: Controller that runs, its goals and gripper commands; may be replaced by another.
    """

    backend = Backend()
    substeps = SUBSTEPS

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

    @property
    def watched(self) -> tuple[int, int]:
        """Substeps after which the original observes: kinematics of the first, positions of the second."""
        return self.substeps - 2, self.substeps - 1

    @abstractmethod
    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        """Clear simulations, write positions and velocities, and compute everything that depends on them."""

    @abstractmethod
    def _substeps(
        self, ids: np.ndarray, actions: np.ndarray, first: Inputs | None, watch: Watch | None
    ) -> None:
        """Run one control period with the goals that are set.

        Args:
            ids: Indices of the simulations.
            actions: Action of each simulation, (num, action_dim).
            first: What the controller sees in the first substep, where that is not the arm as it is.
            watch: See `step`.
        """

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

    @property
    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the two geoms of all contacts, (n, 2), and the simulation of each, (n,), in ascending order."""
        geoms = [self.contact_geoms(i) for i in range(self.num)]
        return np.concatenate(geoms), np.repeat(np.arange(self.num), [len(pairs) for pairs in geoms])

    def record(self) -> dict[str, str]:
        """Return the backend and what of it the numbers depend on, as plain data."""
        return {"backend": self.backend.name}

    def set_controller(self, name: str, control_delta: bool = True, rest: np.ndarray = REST) -> None:
        """Choose the controller, before the first reset.

        Args:
            name: Name in the table of `libero_env.sim.controller`.
            control_delta: Whether actions are relative.
            rest: Joints that the controller takes for the arm's rest pose, (7,) [rad].
        """
        self.controller_state = ControllerState(self.num, get_controller(name, control_delta))
        self.rest = rest

    def close(self) -> None:
        """Free the simulations. Idempotent."""
        self.fields = CLOSED

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
        pos, mat = self._grip_site(self.fields)
        self.controller_state.restart(ids, pos[ids], mat[ids])

    def outdate_controller(self, ids: Indices) -> None:
        """Let the controller take the arm to be in its rest pose until the end of the next substep.

        The original's controller does so between `reset`, which measures the arm in its rest pose, and the first
        substep after `set_init_state`, which moves it: robosuite 1.4.0, controllers/base_controller.py, `new_update`.
        The first goal is therefore relative to the rest pose.
        """
        ids = np.asarray(ids, np.int64)
        self._outdated[ids] = True
        pos, mat = (np.repeat(part, len(ids), 0) for part in self._grip_site(self._rest_fields))
        self.controller_state.restart(ids, pos, mat)

    def update_controller(self, ids: Indices) -> None:
        """Let the controller see the arm as it is, which ends `outdate_controller`; its goal stays."""
        self._outdated[np.asarray(ids, np.int64)] = False

    @cached_property
    def _rest_fields(self) -> dict[str, np.ndarray]:
        return self._fields_at_rest()

    def _fields_at_rest(self) -> dict[str, np.ndarray]:
        """Return the fields of a simulation whose arm is in its rest pose, (1, ...)."""
        data, options = mujoco.MjData(self.model), self.model.opt
        data.qpos[: len(self.rest)] = self.rest
        flags, contacts = options.disableflags, int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        options.disableflags = flags | contacts  # of objects that are all at the origin
        mujoco.mj_forward(self.model, data)
        options.disableflags = flags
        return {name: np.array(rows) for name, rows in self._views_of(data).items()}

    def _views_of(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Return views of the fields of one simulation, (1, ...)."""
        views = {name: getattr(data, name)[None] for name in FIELDS}
        return {**views, "site_xmat": data.site_xmat.reshape(1, self.model.nsite, 9)}

    def _controlled_fields(self, ids: np.ndarray) -> Mapping[str, np.ndarray]:
        """Return the fields that the controller sees, (num, ...): those of the rest pose where it is outdated."""
        if not self._outdated[ids].any():
            return self.fields
        fields = {name: self.fields[name] for name in FIELDS}
        for name in _CONTROLLED:
            fields[name] = self.fields[name].copy()
            fields[name][self._outdated] = self._rest_fields[name]
        return fields

    def pose_fixtures(self, i: int) -> None:
        """Write the poses of the fixtures of simulation i to the model."""
        self.model.body_pos[self.fixture_bodies] = self.fixtures[i, :, :3]
        self.model.body_quat[self.fixture_bodies] = self.fixtures[i, :, 3:]

    def step(self, ids: Indices, actions: np.ndarray, watch: Watch | None = None) -> None:
        """Advance simulations by one control period.

        Args:
            actions: Action of each simulation, (num, action_dim), finite; rows of other simulations are not used.
            watch: Function that is called after each substep of `watched`, with the number of substeps done and the
                indices of the simulations whose fields are of that moment; by `LoopSimulations` with `INTEGRATED`
                in each substep, too.

        Raises:
            SimulationError: Some have failed; the others have moved.
        """
        ids = np.asarray(ids, np.int64)
        before = dict(zip(ids.tolist(), self._times(ids), strict=True))
        state, fields = self.controller_state, self._controlled_fields(ids)
        pos, mat = self._grip_site(fields)
        state.controller.set_goals(ids, actions, fields["qpos"], pos, mat, state.goal, state.memory)
        self._substeps(ids, actions, None if fields is self.fields else self._inputs(fields), watch)
        self._outdated[ids] = False
        if failed := self._failures(before):
            raise SimulationError(failed)

    def _times(self, ids: np.ndarray) -> list[float]:
        return [self.time(i) for i in ids]

    def _failures(self, before: Mapping[int, float]) -> dict[int, str]:
        """Return why simulations have failed in a control period, by index: MuJoCo resets them, with a warning only.

        Args:
            before: Time of each simulation that was stepped, before it, s.
        """
        failed, step = {}, self.model.opt.timestep
        for i, time in before.items():
            is_first = abs(time) < 0.5 * step  # a reset in the first substep does not show in the time
            if abs(self.time(i) - time - self.substeps * step) > 0.5 * step or (
                is_first and any(self.data(i).warning[kind].number for kind in _UNSTABLE)
            ):
                failed[i] = DIVERGED
        return failed

    def get_state(self, i: int) -> np.ndarray:
        """Return all that the future of simulation i depends on, (state_size,).

        It consists of time, qpos, qvel, fixtures, warm start, controls, the state of the controller, and whether it is
        outdated.
        """
        parts = [self.physics_state(i), self.fixtures[i].ravel(), *self._warm_start(i)]
        return np.concatenate([*parts, self.controller_state.pack(i), self._outdated[i : i + 1]])

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore a state of `get_state`; the simulation continues from there to the same bits."""
        nq, nv, nu, nfixtures = self.model.nq, self.model.nv, self.model.nu, len(self.fixture_bodies)
        sizes = np.cumsum([1, nq, nv, 7 * nfixtures, nv, nu])
        time, qpos, qvel, fixtures, *warm_start, controller = np.split(state, sizes)
        self.reset([i], qpos[None], qvel[None], float(time[0]), fixtures.reshape(1, nfixtures, 7))
        self._set_warm_start(i, warm_start)
        self.controller_state.unpack(i, controller[:-1])
        self._outdated[i] = controller[-1]

    def physics_state(self, i: int) -> np.ndarray:
        """Return [time, qpos, qvel] of simulation i, the original's layout."""
        return np.concatenate([[self.time(i)], self.fields["qpos"][i], self.fields["qvel"][i]])

    def set_physics_state(self, i: int, state: np.ndarray) -> None:
        """Restore [time, qpos, qvel] of simulation i; the controller is reset and holds the pose."""
        nq = self.model.nq
        self.reset([i], state[None, 1 : 1 + nq], state[None, 1 + nq :], float(state[0]))

    def show_state(self, i: int, state: np.ndarray) -> None:
        """Put the bodies of simulation i where they are in [time, qpos, qvel], to be observed and not stepped.

        Contacts and forces may be those of another state.
        """
        self.set_physics_state(i, state)

    @property
    def state_size(self) -> int:
        """Length of the vector of `get_state`."""
        model, fixtures = self.model, 7 * len(self.fixture_bodies)
        warm_start = model.nv + model.nu
        return 2 + model.nq + model.nv + fixtures + warm_start + self.controller_state.controller.state_size

    def _grip_site(self, fields: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Return position (num, 3) and orientation (num, 9) of the grip site."""
        site = self.arm.site
        return fields["site_xpos"][:, site], fields["site_xmat"][:, site]

    def _inputs(self, fields: Mapping[str, np.ndarray]) -> Inputs:
        arm = (fields[name] for name in ("qpos", "qvel", "xanchor", "xaxis"))
        return *arm, *self._grip_site(fields), fields[MASS_FIELD], fields["qfrc_bias"]

    @property
    def _constants(self) -> Inputs:
        """Constants that the kernel of a controller takes."""
        arm = self.arm
        return (
            arm.mass_address, arm.torque_limit, arm.finger_range, self.rest, self.controller_state.controller.gains,
        )  # fmt: skip
