"""Ways to step simulations, with the same interface.

`LoopSimulations` steps one MjData after another (one simulation, or MuJoCo without `mujoco.batch`), `BatchSimulations`
steps on a thread pool, to the same bits. `libero_env.sim.mjwarp` steps on a GPU in single precision.
"""

import os
import weakref
from collections.abc import Mapping
from functools import cache
from typing import Any

import mujoco
import numpy as np

from libero_env.errors import ClosedEnvironmentError, LiberoError
from libero_env.mujoco_compat import FORWARD_WARM_STARTS
from libero_env.sim.engine import BackEnd
from libero_env.sim.simulation import FIELDS, WATCHED, Closed, Indices, KinematicsHook, Simulations, Watch
from libero_env.timing import SUBSTEPS

try:
    from mujoco.batch import Batch
except ImportError:  # before MuJoCo 4
    Batch = None

# The original calls mj_forward twice in each substep. Where that moves the solver's warm start we do it, too.
_SOLVES_BEFORE_STEP = 2 if FORWARD_WARM_STARTS else 0

FORKED = (
    "this process was forked from the one that made the environment, and can neither step nor render it. Make "
    "environments after the fork, or start processes with multiprocessing.get_context('spawn')"
)


class LoopSimulations(Simulations):
    """Simulations that are stepped one after the other in the calling thread."""

    def __init__(self, model: mujoco.MjModel, num: int = 1, fixture_bodies: Indices = ()):
        super().__init__(model, num, fixture_bodies)
        self._datas: Any = [mujoco.MjData(self.model) for _ in range(num)]
        self._views: Any = [self._view(data) for data in self._datas]
        # One simulation is read in place; several are copied together after each step.
        self.fields = (
            self._views[0] if num == 1 else {k: np.concatenate([v[k] for v in self._views]) for k in FIELDS}
        )
        self._calls: Any = [(self._inputs(v), v["ctrl"]) for v in self._views]

    def _view(self, data: mujoco.MjData) -> dict[str, np.ndarray]:
        """Return views of the fields of one simulation, (1, ...)."""
        views = {name: getattr(data, name)[None] for name in FIELDS}
        return {**views, "site_xmat": data.site_xmat.reshape(1, self.model.nsite, 9)}

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
        self,
        ids: np.ndarray,
        actions: np.ndarray,
        before_last_kinematics: KinematicsHook | None,
        believed: Mapping[str, np.ndarray],
        watch: Watch | None,
    ) -> None:
        model, constants, first = self.model, self._constants(), np.zeros(1, np.int64)
        kernel, state = self.controller_state.controller.kernel, self.controller_state.arrays
        for i in ids:
            data, (inputs, ctrl), row = self._datas[i], self._calls[i], slice(i, i + 1)
            if self.num > 1:
                self.pose_fixtures(i)
            goal, memory, gripper = (array[row] for array in state)
            for substep in range(SUBSTEPS):
                for _ in range(_SOLVES_BEFORE_STEP):
                    mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_VEL, True)
                seen = inputs
                if substep == 0 and believed is not self.fields:
                    seen = self._inputs({name: values[row] for name, values in believed.items()})
                kernel(first, actions[row], *seen, goal, memory, gripper, ctrl, *constants)
                mujoco.mj_step2(model, data)
                if before_last_kinematics is not None and substep == SUBSTEPS - 2:
                    before_last_kinematics(data)
                mujoco.mj_step1(model, data)
                if watch is not None and substep + 1 in WATCHED:
                    self._gather(np.array([i]))
                    watch(substep + 1, np.array([i]))
        self._gather(ids)

    def _warm_start(self, i: int) -> list[np.ndarray]:
        return [self._datas[i].qacc_warmstart, self._datas[i].ctrl]

    def time(self, i: int) -> float:
        return self._datas[i].time

    def data(self, i: int) -> mujoco.MjData:
        return self._datas[i]

    def close(self) -> None:
        super().close()
        self._views = self._calls = self._datas = Closed()


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
        _watch_forks()
        _batches.add(self)
        fields = {name: self._batch.bind(name) for name in FIELDS}
        self.fields = {**fields, "site_xmat": fields["site_xmat"].reshape(num, model.nsite, 9)}
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
        self,
        ids: np.ndarray,
        actions: np.ndarray,
        before_last_kinematics: KinematicsHook | None,
        believed: Mapping[str, np.ndarray],
        watch: Watch | None,
    ) -> None:
        if before_last_kinematics is not None:
            raise LiberoError("batched simulations take no before_last_kinematics hook; use LoopSimulations")
        kernel, state = self.controller_state.controller.kernel, self.controller_state.arrays
        inputs, ctrl, constants = self._inputs(believed), self.fields["ctrl"], self._constants()
        stage = mujoco.mjtStage.mjSTAGE_VEL
        for substep in range(SUBSTEPS):
            if substep == 1 and believed is not self.fields:
                inputs = self._inputs(self.fields)
            kernel(ids, actions, *inputs, *state, ctrl, *constants)
            self._batch.step(ids, nstep=1, stage=stage)
            if watch is not None and substep + 1 in WATCHED:
                watch(substep + 1, ids)

    def _warm_start(self, i: int) -> list[np.ndarray]:
        return [self._qacc_warmstart[i], self.fields["ctrl"][i]]

    def time(self, i: int) -> float:
        return float(np.ravel(self._time[i])[0])

    def data(self, i: int) -> mujoco.MjData:
        return self._batch.get_data(i, self._data)

    def close(self) -> None:
        super().close()
        self._batch = _Without("this simulation is closed; make another environment", ClosedEnvironmentError)
        self._time = self._qacc_warmstart = self._body_pos = self._body_quat = Closed()


class _Without:
    """What a batch is replaced by where it cannot be used."""

    def __init__(self, message: str, error: type[LiberoError] = LiberoError):
        self._error = error(message)

    def __getattr__(self, name: str) -> Any:
        raise self._error


_batches: "weakref.WeakSet[BatchSimulations]" = weakref.WeakSet()
_inherited: list[Any] = []  # never freed: their threads are not in this process


@cache
def _watch_forks() -> None:
    """Let a forked process raise where it uses a batch of its parent, whose threads it would wait for without end."""
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_leave_batches)


def _leave_batches() -> None:
    for simulations in list(_batches):
        _inherited.append(simulations._batch)
        simulations._batch = _Without(FORKED)
    _batches.clear()


def make_simulations(
    model: mujoco.MjModel,
    num: int,
    threads: int = 0,
    fixture_bodies: Indices = (),
    back_end: BackEnd | None = None,
) -> Simulations:
    """Return `num` simulations of a model; MuJoCo's are batched where it offers that and there are several.

    Args:
        model: Model to simulate; it is copied.
        num: Number of simulations.
        threads: Number of threads of the batch; 0 is one for each core.
        fixture_bodies: Indices of the fixed bodies whose pose differs between simulations.
        back_end: Back end of the physics; by default `mujoco`.

    Raises:
        LiberoError: The back end is not installed, has no such device, or cannot simulate the model.
    """
    if back_end is not None and back_end.is_warp:
        back_end.require_installed()
        from libero_env.sim.mjwarp.simulations import WarpSimulations  # with the extra `warp` only

        return WarpSimulations(model, num, fixture_bodies, back_end)
    if num > 1 and Batch is not None:
        return BatchSimulations(model, num, threads, fixture_bodies)
    return LoopSimulations(model, num, fixture_bodies)
