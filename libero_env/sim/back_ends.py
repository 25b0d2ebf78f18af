"""Back ends of simulations that step with MuJoCo on the processor.

`LoopSimulations` steps one MjData after another (one simulation, or MuJoCo without `mujoco.batch`), `BatchSimulations`
steps on a thread pool, to the same bits.
"""

import weakref
from typing import Any

import numpy as np

from libero_env.errors import LiberoError
from libero_env.mujoco_compat import FORWARD_WARM_STARTS, mujoco
from libero_env.parallel import after_forks
from libero_env.sim.simulation import (
    CLOSED,
    FIELDS,
    FORKED,
    INTEGRATED,
    Batch,
    Indices,
    Inputs,
    Simulations,
    Unusable,
    Watch,
)

# The original calls mj_forward twice in each substep. Where that moves the solver's warm start we do it, too.
_SOLVES_BEFORE_STEP = 2 if FORWARD_WARM_STARTS else 0


class LoopSimulations(Simulations):
    """Simulations that are stepped one after the other in the calling thread.

    Attributes:
        ends_current: Whether kinematics and contacts are those of the state when `step` ends; otherwise of one substep
            earlier, as `mj_step` leaves them, and `mj_step1` is to be called before the next `step`.
    """

    ends_current = True

    def __init__(self, model: mujoco.MjModel, num: int = 1, fixture_bodies: Indices = ()):
        super().__init__(model, num, fixture_bodies)
        self._datas: Any = [mujoco.MjData(self.model) for _ in range(num)]
        self._views: Any = [self._views_of(data) for data in self._datas]
        # One simulation is read in place; several are copied together after each step.
        self.fields = (
            self._views[0] if num == 1 else {k: np.concatenate([v[k] for v in self._views]) for k in FIELDS}
        )
        self._inputs_of: Any = [self._inputs(view) for view in self._views]

    def _gather(self, ids: np.ndarray) -> None:
        """Copy the fields of simulations to `fields`, unless they are read in place."""
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

    def _substeps(
        self, ids: np.ndarray, actions: np.ndarray, first: Inputs | None, watch: Watch | None
    ) -> None:
        model, constants, only = self.model, self._constants, np.zeros(1, np.int64)
        kernel, state = self.controller_state.controller.kernel, self.controller_state.arrays
        for i in ids:
            data, ctrl, row = self._datas[i], self._views[i]["ctrl"], slice(i, i + 1)
            if self.num > 1:
                self.pose_fixtures(i)
            goals = [array[row] for array in state]
            for substep in range(self.substeps):
                for _ in range(_SOLVES_BEFORE_STEP):
                    mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_VEL, True)
                seen = self._inputs_of[i] if first is None or substep else [field[row] for field in first]
                kernel(only, actions[row], *seen, *goals, ctrl, *constants)
                mujoco.mj_step2(model, data)
                if watch is not None:
                    watch(INTEGRATED, np.array([i]))
                if substep + 1 == self.substeps and not self.ends_current:
                    break
                mujoco.mj_step1(model, data)
                if watch is not None and substep + 1 in self.watched:
                    self._gather(np.array([i]))
                    watch(substep + 1, np.array([i]))
        self._gather(ids)

    def show_state(self, i: int, state: np.ndarray) -> None:
        data, nq = self._datas[i], self.model.nq
        self.pose_fixtures(i)
        data.time, data.qpos[:], data.qvel[:] = state[0], state[1 : 1 + nq], state[1 + nq :]
        mujoco.mj_kinematics(self.model, data)
        self._gather(np.array([i]))

    def _warm_start(self, i: int) -> list[np.ndarray]:
        return [self._datas[i].qacc_warmstart, self._datas[i].ctrl]

    def time(self, i: int) -> float:
        return self._datas[i].time

    def data(self, i: int) -> mujoco.MjData:
        return self._datas[i]

    def close(self) -> None:
        super().close()
        self._views = self._inputs_of = self._datas = CLOSED


class BatchSimulations(Simulations):
    """Simulations that are stepped together on a thread pool; results do not depend on the number of threads.

    Args:
        model: Model to simulate; it is copied.
        num: Number of simulations.
        threads: Number of threads; 0 is one for each core.
        fixture_bodies: Indices of the fixed bodies whose pose differs between simulations.
    """

    def __init__(self, model: mujoco.MjModel, num: int, threads: int = 0, fixture_bodies: Indices = ()):
        super().__init__(model, num, fixture_bodies)
        self._batch: Any = Batch(model, num, nthread=threads, persistent=True)
        after_forks(_leave_batches)
        _batches.add(self)
        fields = {name: self._batch.bind(name) for name in FIELDS}
        self.fields = {**fields, "site_xmat": fields["site_xmat"].reshape(num, model.nsite, 9)}
        self._own_inputs = self._inputs(self.fields)
        self._time, self._qacc_warmstart = self._batch.bind("time"), self._batch.bind("qacc_warmstart")
        if self.fixture_bodies.size:  # per-simulation values of the model
            self._body_pos, self._body_quat = self._batch.expand("body_pos"), self._batch.expand("body_quat")
        self._data = mujoco.MjData(model)  # for reading one simulation at a time

    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        if self.fixture_bodies.size:
            rows = np.ix_(ids, self.fixture_bodies)
            self._body_pos[rows], self._body_quat[rows] = self.fixtures[ids, :, :3], self.fixtures[ids, :, 3:]
        self.fields["qpos"][ids], self.fields["qvel"][ids], self._time[ids] = qpos, qvel, time
        self._batch.forward(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
        self._qacc_warmstart[ids] = 0.0

    def _substeps(
        self, ids: np.ndarray, actions: np.ndarray, first: Inputs | None, watch: Watch | None
    ) -> None:
        kernel, state = self.controller_state.controller.kernel, self.controller_state.arrays
        ctrl, constants, stage = self.fields["ctrl"], self._constants, mujoco.mjtStage.mjSTAGE_VEL
        for substep in range(self.substeps):
            seen = self._own_inputs if first is None or substep else first
            kernel(ids, actions, *seen, *state, ctrl, *constants)
            self._batch.step(ids, nstep=1, stage=stage)
            if watch is not None and substep + 1 in self.watched:
                watch(substep + 1, ids)

    def _warm_start(self, i: int) -> list[np.ndarray]:
        return [self._qacc_warmstart[i], self.fields["ctrl"][i]]

    def time(self, i: int) -> float:
        return float(np.ravel(self._time[i])[0])

    def data(self, i: int) -> mujoco.MjData:
        return self._batch.get_data(i, self._data)

    def close(self) -> None:
        super().close()
        self._batch = self._time = self._qacc_warmstart = self._body_pos = self._body_quat = CLOSED
        self._own_inputs = ()


_batches: "weakref.WeakSet[BatchSimulations]" = weakref.WeakSet()


_inherited: list[Any] = []  # never freed: their threads are not in this process


def _leave_batches() -> None:
    """Let a forked process raise where it uses a batch of its parent, whose threads it would wait for without end."""
    for simulations in list(_batches):
        _inherited.append(simulations._batch)
        simulations._batch = Unusable(LiberoError(FORKED))
    _batches.clear()
