"""Many closed-loop simulations of one model: physics and controller, no tasks, no pictures.

Two ways to step with the same interface and the same bits: `LoopSimulations`, one MjData after another (one simulation,
or MuJoCo without `mujoco.batch`), and `BatchSimulations` on a thread pool. A control step is 25 substeps, and each
substep is one pass: controller on the current kinematics, then the rest of the step, then the next kinematics.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import copy

import mujoco
import numpy as np

from libero_env.errors import LiberoError
from libero_env.mujoco_compat import MASS_FIELD
from libero_env.sim.controllers import ControllerState
from libero_env.sim.osc import REST, ArmIndex
from libero_env.timing import SUBSTEPS

try:
    from mujoco.batch import Batch
except ImportError:  # before MuJoCo 4
    Batch = None

# What the controller and the views of the state read, as arrays (n, ...).
_FIELDS = (
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


Tap = Callable[[mujoco.MjData], None]


class Simulations(ABC):
    """n simulations of one model.

    Attributes:
        model: a copy of the given one; fixtures stand in it where those of the last simulation touched do.
        num: number of simulations.
        fixtures: (num, nfixtures, 7) pos, quat wxyz of the fixed bodies whose pose differs between simulations.
        fields: name of an MjData field -> array (num, ...), for reading. Kinematics are those of the current state.
        controller: which controller runs, its goals and gripper commands; may be replaced by another.
    """

    def __init__(self, model: mujoco.MjModel, num: int, fixture_bodies: Sequence[int] = ()):
        self.model, self.num = copy(model), num
        self.fixture_bodies = np.asarray(fixture_bodies, np.int64)
        poses = np.concatenate([model.body_pos, model.body_quat], axis=1)[self.fixture_bodies]
        self.fixtures = np.tile(poses, (num, 1, 1))
        self.arm = ArmIndex.of(model)
        self.controller = ControllerState(num)
        self.fields: dict[str, np.ndarray] = {}

    @abstractmethod
    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        """Clear these simulations, write positions and velocities, and compute all that follows from them."""

    @abstractmethod
    def _substeps(self, ids: np.ndarray, actions: np.ndarray, tap: Tap | None) -> None:
        """Run one control period; the goals are set."""

    @abstractmethod
    def _remembered(self, i: int) -> list[np.ndarray]:
        """Live views of what a step leaves behind beside positions: [qacc_warmstart (nv,), ctrl (nu,)]."""

    @abstractmethod
    def time(self, i: int) -> float:
        """Simulated seconds since the reset of simulation i."""

    @abstractmethod
    def data(self, i: int) -> mujoco.MjData:
        """Simulation i's MjData, for reading what `fields` does not hold, such as contacts."""

    def close(self) -> None:
        """Let go of the simulations."""
        self.fields = {}

    def reset(
        self,
        ids: Sequence[int],
        qpos: np.ndarray,
        qvel: np.ndarray,
        time: float = 0.0,
        fixtures: np.ndarray | None = None,
    ) -> None:
        """Start simulations afresh; the controller holds the pose.

        Args:
            ids: (k,) which.
            qpos, qvel: (k, nq), (k, nv).
            time: simulated seconds.
            fixtures: (k, nfixtures, 7) pos, quat wxyz; without it they stay where they are.
        """
        ids = np.asarray(ids, np.int64)
        if fixtures is not None:
            self.fixtures[ids] = fixtures
        self._start(ids, qpos, qvel, time)
        pos, mat = self._grip()
        self.controller.restart(ids, pos[ids], mat[ids])

    def pose_fixtures(self, i: int) -> None:
        """Put the fixtures of simulation i into the model."""
        self.model.body_pos[self.fixture_bodies] = self.fixtures[i, :, :3]
        self.model.body_quat[self.fixture_bodies] = self.fixtures[i, :, 3:]

    def step(self, ids: Sequence[int], actions: np.ndarray, tap: Tap | None = None) -> None:
        """Advance the simulations `ids` by one control period; actions (num, action_dim), rows of others unused.

        `tap` sees each MjData one substep before the end, after that substep's integration and before kinematics follow
        it: there the original observes (measured). `LoopSimulations` only.
        """
        ids = np.asarray(ids, np.int64)
        self.controller.set_goals(ids, actions, self.fields["qpos"], *self._grip())
        self._substeps(ids, actions, tap)

    def get_state(self, i: int) -> np.ndarray:
        """All that the future of i depends on: time, qpos, qvel, fixtures, warm start, controls, controller."""
        parts = [[self.time(i)], self.fields["qpos"][i], self.fields["qvel"][i], self.fixtures[i].ravel()]
        return np.concatenate([*parts, *self._remembered(i), self.controller.pack(i)])

    def set_state(self, i: int, state: np.ndarray) -> None:
        """Restore what `get_state` gave; the simulation goes on to the same bits."""
        nq, nv, nu, nfixtures = self.model.nq, self.model.nv, self.model.nu, len(self.fixture_bodies)
        sizes = np.cumsum([1, nq, nv, 7 * nfixtures, nv, nu])
        time, qpos, qvel, fixtures, *remembered, goal = np.split(state, sizes)
        self.reset([i], qpos[None], qvel[None], float(time[0]), fixtures.reshape(1, nfixtures, 7))
        for view, value in zip(self._remembered(i), remembered, strict=True):
            view[:] = value
        self.controller.unpack(i, goal)

    @property
    def state_size(self) -> int:
        """Length of the vector of `get_state`."""
        model = self.model
        remembered = model.nv + model.nu + self.controller.kind.state_size
        return 1 + model.nq + model.nv + 7 * len(self.fixture_bodies) + remembered

    def _grip(self) -> tuple[np.ndarray, np.ndarray]:
        site = self.arm.site
        return self.fields["site_xpos"][:, site], self.fields["site_xmat"][:, site]

    def _inputs(self, fields: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        """The kernel's view of MjData."""
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
        return self.arm.mass_address, self.arm.torque_limit, self.arm.finger_range, REST


class LoopSimulations(Simulations):
    """Simulations stepped one after the other in the calling thread."""

    def __init__(self, model: mujoco.MjModel, num: int = 1, fixture_bodies: Sequence[int] = ()):
        super().__init__(model, num, fixture_bodies)
        self._datas = [mujoco.MjData(self.model) for _ in range(num)]
        self._views = [self._view(data) for data in self._datas]
        # One simulation is read in place; several are copied together after each step.
        self.fields = (
            self._views[0] if num == 1 else {k: np.concatenate([v[k] for v in self._views]) for k in _FIELDS}
        )
        self._calls = [(self._inputs(v), v["ctrl"]) for v in self._views]

    def _view(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        views = {name: getattr(data, name)[None] for name in _FIELDS}
        return {**views, "site_xmat": data.site_xmat.reshape(1, self.model.nsite, 9)}

    def _gather(self, ids: np.ndarray) -> None:
        if self.num > 1:
            for i in ids:
                for name, array in self.fields.items():
                    array[i] = self._views[i][name][0]

    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        for k, i in enumerate(ids):
            data = self._datas[i]
            self.pose_fixtures(i)
            mujoco.mj_resetData(self.model, data)
            data.qpos[:], data.qvel[:], data.time = qpos[k], qvel[k], time
            mujoco.mj_forward(self.model, data)
            data.qacc_warmstart[:] = 0.0
        self._gather(ids)

    def _substeps(self, ids: np.ndarray, actions: np.ndarray, tap: Tap | None) -> None:
        model, c, constants, first = self.model, self.controller, self._constants(), np.zeros(1, np.int64)
        for i in ids:
            data, (inputs, ctrl), own = self._datas[i], self._calls[i], slice(i, i + 1)
            if self.num > 1:
                self.pose_fixtures(i)
            kernel, state = c.kind.kernel, [array[own] for array in c.arrays]
            for substep in range(SUBSTEPS):
                kernel(first, actions[own], *inputs, *state, ctrl, *constants)
                mujoco.mj_step2(model, data)
                if tap is not None and substep == SUBSTEPS - 2:
                    tap(data)
                mujoco.mj_step1(model, data)
        self._gather(ids)

    def _remembered(self, i: int) -> list[np.ndarray]:
        return [self._datas[i].qacc_warmstart, self._datas[i].ctrl]

    def time(self, i: int) -> float:
        return self._datas[i].time

    def data(self, i: int) -> mujoco.MjData:
        return self._datas[i]

    def close(self) -> None:
        super().close()
        self._views, self._calls, self._datas = [], [], []


class BatchSimulations(Simulations):
    """Simulations stepped together on a thread pool; the same bits as the loop, whatever the number of threads."""

    def __init__(self, model: mujoco.MjModel, num: int, threads: int = 0, fixture_bodies: Sequence[int] = ()):
        super().__init__(model, num, fixture_bodies)
        self._batch = Batch(model, num, nthread=threads, persistent=True)
        self.fields = {name: self._batch.bind(name) for name in _FIELDS}
        self.fields["site_xmat"] = self.fields["site_xmat"].reshape(num, model.nsite, 9)
        self._time, self._warmstart = self._batch.bind("time"), self._batch.bind("qacc_warmstart")
        if self.fixture_bodies.size:  # per-simulation values of the model
            self._body_pos, self._body_quat = self._batch.expand("body_pos"), self._batch.expand("body_quat")
        self._data = mujoco.MjData(model)  # for reading one simulation at a time

    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if self.fixture_bodies.size:
            each = np.ix_(ids, self.fixture_bodies)
            self._body_pos[each], self._body_quat[each] = self.fixtures[ids, :, :3], self.fixtures[ids, :, 3:]
        self.fields["qpos"][ids], self.fields["qvel"][ids], self._time[ids] = qpos, qvel, time
        self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._warmstart[ids] = 0.0

    def _substeps(self, ids: np.ndarray, actions: np.ndarray, tap: Tap | None) -> None:
        if tap is not None:
            raise LiberoError("batched simulations cannot be tapped; use LoopSimulations")
        c, constants, ctrl = self.controller, self._constants(), self.fields["ctrl"]
        inputs, kernel = self._inputs(self.fields), c.kind.kernel
        stage = mujoco.mjtStage.mjSTAGE_VEL
        for _ in range(SUBSTEPS):
            kernel(ids, actions, *inputs, *c.arrays, ctrl, *constants)
            self._batch.step(ids, nstep=1, stage=stage)

    def _remembered(self, i: int) -> list[np.ndarray]:
        return [self._warmstart[i], self.fields["ctrl"][i]]

    def time(self, i: int) -> float:
        return float(np.ravel(self._time[i])[0])

    def data(self, i: int) -> mujoco.MjData:
        return self._batch.get_data(i, self._data)

    def close(self) -> None:
        super().close()
        self._batch = self._time = self._warmstart = self._body_pos = self._body_quat = None


def make_simulations(
    model: mujoco.MjModel, num: int, threads: int = 0, fixture_bodies: Sequence[int] = ()
) -> Simulations:
    """The fastest way to run `num` simulations here: batched where MuJoCo offers it and there are several.

    Args:
        model: copied.
        num: number of simulations.
        threads: of the batch; 0 is one for each core.
        fixture_bodies: ids of fixed bodies that stand elsewhere in each simulation.
    """
    if num > 1 and Batch is not None:
        return BatchSimulations(model, num, threads, fixture_bodies)
    return LoopSimulations(model, num, fixture_bodies)
