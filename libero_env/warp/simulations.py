"""Simulations of one model that MuJoCo Warp steps together, on a GPU or on the processor."""

import gc
import logging
from collections import Counter
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import mujoco_warp as mjw
import numpy as np
import warp as wp

from libero_env.errors import InvalidInputError, LiberoError, SimulationError
from libero_env.mujoco_compat import mujoco
from libero_env.sim.backend import Backend
from libero_env.sim.osc import REST, osc_torques
from libero_env.sim.simulation import CLOSED, DIVERGED, Indices, Inputs, Simulations, Watch
from libero_env.warp import kernels
from libero_env.warp.device import DeviceFields, allocate, can_capture, choose_device, room_for

_log = logging.getLogger(__name__)
_ROWS_PER_CONTACT = 4  # of constraints; contacts with rolling friction, which have 6, are few
_FULL = (
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
)


class WarpSimulations(Simulations):
    """Simulations that are stepped together by MuJoCo Warp, all of them at the cost of all.

    A control step is one graph. Simulations that are not to be stepped are stepped and held, so that
    they do not move. Numbers are of single precision.

    Args:
        model: Model to simulate; it is copied.
        num: Number of simulations.
        fixture_bodies: Indices of the fixed bodies whose pose differs between simulations.
        backend: Device, and the largest number of contacts of a simulation.

    Attributes:
        device: Device of Warp.
        device_model: The model on the device, with the poses of fixtures of each simulation.
        device_data: The state of all simulations on the device.
        limits_reached: How often a simulation reached a limit of the solver without an error, by the limit's name.
        uses_graphs: Whether the kernels of a control step are launched as one graph. Without, a step of one simulation
            on the processor takes fifteen times as long.

    Raises:
        LiberoError: There is no such device, or MuJoCo Warp has not a feature that the model uses.
    """

    def __init__(
        self, model: mujoco.MjModel, num: int, fixture_bodies: Indices = (), backend: Backend | None = None
    ):
        super().__init__(model, num, fixture_bodies)
        self.backend = backend or Backend("warp")
        self.device = choose_device(self.backend.device)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)  # nothing reads them
        contacts = self.backend.contacts
        # constraints that are not contacts, at most: friction and limits of joints
        other_rows = int((self.model.dof_frictionloss > 0).sum() + self.model.jnt_limited.sum())
        with wp.ScopedDevice(self.device):
            try:
                self.device_model = mjw.put_model(self.model, {"body_pos": num, "body_quat": num})
            except (NotImplementedError, ValueError) as error:
                raise LiberoError(
                    f"backend=warp cannot simulate this model: {error}; backend=mujoco can"
                ) from error
            self.device_model.opt.warn_overflow = 0  # raised instead, see _failures
            with room_for(num, self.backend):
                self.device_data = mjw.make_data(
                    self.model,
                    nworld=num,
                    nconmax=contacts,
                    njmax=_ROWS_PER_CONTACT * contacts + other_rows,
                )
                self._control: Any = allocate(self.model, self.arm, num, self.fixture_bodies)
        self._copies: Any = DeviceFields(self.device_data, self._control.arm)
        self.fields = self._copies
        self.uses_graphs, self._graphs = can_capture(self.device), dict[int, Any]()
        self.limits_reached = Counter[str]()
        self._actions_seen = np.zeros(num)
        self._unplaced = np.ones(num, bool)  # not started yet: all things at one place
        self._no_start = dict[int, str]()  # why a start was not possible, which the next step tells

    def record(self) -> dict[str, str]:
        versions = {name: metadata.version(name) for name in ("mujoco-warp", "warp-lang")}
        return {"backend": self.backend.name, "backend_device": self.device.name, **versions}

    def set_controller(self, name: str, control_delta: bool = True, rest: np.ndarray = REST) -> None:
        super().set_controller(name, control_delta, rest)
        if self.controller_state.controller.kernel is not osc_torques:
            raise InvalidInputError(
                f"backend=warp has no controller {name}, only osc_pose and osc_position; backend=mujoco has"
            )

    def contact_geoms(self, i: int) -> np.ndarray:
        geoms, worlds = self.contacts
        start, end = np.searchsorted(worlds, (i, i + 1))
        return geoms[start:end]

    @property
    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        if "contacts" not in self._copies:
            data = self.device_data
            count = int(data.nacon.numpy()[0])
            worlds = data.contact.worldid.numpy()[:count]
            order = np.argsort(worlds, kind="stable")
            self._copies["contacts"] = data.contact.geom.numpy()[:count][order], worlds[order]
        return self._copies["contacts"]

    def time(self, i: int) -> float:
        return float(self.device_data.time.numpy()[i])

    def data(self, i: int) -> mujoco.MjData:
        found = mujoco.MjData(self.model)
        self.pose_fixtures(i)
        mjw.get_data_into(found, self.model, self.device_data, world_id=i)
        return found

    def close(self) -> None:
        super().close()
        self._graphs = {}
        self.device_data = self.device_model = self._control = self._copies = CLOSED

    def _start(self, ids: np.ndarray, qpos: np.ndarray, qvel: np.ndarray, time: float) -> None:
        model, data, control = self.device_model, self.device_data, self._control
        if not len(ids):
            return
        started, starts, speeds = ids, qpos, qvel
        self._unplaced[ids] = False
        self._no_start = {i: why for i, why in self._no_start.items() if i not in ids}
        # the others take the first state: their contacts would fill all memory
        unplaced = np.flatnonzero(self._unplaced)
        source = np.append(np.arange(len(ids)), np.zeros(len(unplaced), np.int64))
        poses = self.fixtures[ids[source]]
        ids, qpos, qvel = np.append(ids, unplaced), qpos[source], qvel[source]
        with wp.ScopedDevice(self.device):
            _write(data.time, ids, time)
            _write(data.qpos, ids, qpos)
            _write(data.qvel, ids, qvel)
            _write(data.qacc_warmstart, ids, 0.0)
            _write(data.ctrl, ids, 0.0)
            _write(control.arm, ids, qpos[:, :7])
            if self.fixture_bodies.size:
                rows = np.ix_(ids, self.fixture_bodies)
                _write(model.body_pos, rows, poses[..., :3])
                _write(model.body_quat, rows, poses[..., 3:])
            if control.static_geoms.size:
                mjw.kinematics(model, data)
                wp.launch(
                    kernels.pose_static_geoms,
                    (self.num, control.static_geoms.size),
                    inputs=[control, model.geom_bodyid, model.geom_pos, model.geom_quat],
                    outputs=[data.xpos, data.xquat, data.geom_xpos, data.geom_xmat],
                )
            data.overflow.zero_()
            mjw.step1(model, data)
        self._copies.clear()
        if data.nacon.numpy()[0] <= data.naconmax:
            return
        # some contacts are lost, of which simulations is not known; those that fill their share do not start
        shares = np.bincount(data.contact.worldid.numpy(), minlength=self.num)
        fits = shares[started] < self.backend.contacts
        full = started if fits.all() else started[~fits]
        failed = {int(i): self._no_room(mjw.OverflowType.NARROWPHASE) for i in full}
        self._unplaced[full] = True
        if len(full) == len(started):
            raise SimulationError(failed)
        self._start(started[fits], starts[fits], speeds[fits], time)
        self._no_start |= failed

    def _substeps(
        self, ids: np.ndarray, actions: np.ndarray, first: Inputs | None, watch: Watch | None
    ) -> None:
        self._upload(ids, actions)
        done = 0
        with wp.ScopedDevice(self.device):
            if first is not None:
                self._control_on_host(ids, actions, first)
                self._physics()
                done = 1
            for until in (*self.watched, self.substeps) if watch is not None else (self.substeps,):
                if until > done:
                    self._run(until - done)
                    done = until
                    self._copies.clear()
                    if watch is not None and done in self.watched:
                        watch(done, ids)
        self.controller_state.gripper[:] = self._control.gripper.numpy()

    def _upload(self, ids: np.ndarray, actions: np.ndarray) -> None:
        """Send the goals, and which simulations are to be stepped, to the device."""
        control, state, data = self._control, self.controller_state, self.device_data
        self._actions_seen[ids] = actions[ids, -1]
        with wp.ScopedDevice(self.device):
            for array, values in (
                (control.grip, self._actions_seen),
                (control.goal_pos, state.goal),
                (control.goal_mat, state.memory),
                (control.gripper, state.gripper),
                (control.rest, self.rest),
            ):
                array.assign(np.ascontiguousarray(values, np.float64))
            for kept, present in zip(
                (control.qpos, control.qvel, control.warm_start, control.time), self._moved, strict=True
            ):
                wp.copy(kept, present)
            if self.uses_graphs and not self._graphs:  # nothing is compiled while a graph is captured
                control.active.zero_()
                self._substep()
            control.active.assign(np.isin(np.arange(self.num), ids))
            data.overflow.zero_()

    def _control_on_host(self, ids: np.ndarray, actions: np.ndarray, inputs: Inputs) -> None:
        """Compute the controls of a substep in which the controller takes the arm to be elsewhere than it is."""
        state, ctrl = self.controller_state, self.fields["ctrl"].copy()
        state.controller.kernel(ids, actions, *inputs, *state.arrays, ctrl, *self._constants)
        self.device_data.ctrl.assign(ctrl.astype(np.float32))
        self._control.gripper.assign(state.gripper)

    def _run(self, substeps: int) -> None:
        """Run substeps: as a graph, which is captured the first time, or one kernel after the other."""
        if not self.uses_graphs:
            for _ in range(substeps):
                self._substep()
            return
        if substeps not in self._graphs:
            gc.collect()  # a graph that is freed meanwhile would become part of this one
            enabled = gc.isenabled()
            gc.disable()
            try:
                with wp.ScopedCapture(self.device) as capture:
                    for _ in range(substeps):
                        self._substep()
            finally:
                if enabled:
                    gc.enable()
            self._graphs[substeps] = capture.graph
        wp.capture_launch(self._graphs[substeps])

    def _substep(self) -> None:
        data = self.device_data
        names = ("qpos", "qvel", "xanchor", "xaxis", "site_xpos", "site_xmat", "M", "qfrc_bias")
        seen = [getattr(data, name) for name in names]
        wp.launch(kernels.osc_substep, self.num, inputs=[self._control, *seen], outputs=[data.ctrl])
        self._physics()

    @property
    def _moved(self) -> list[Any]:
        """What a step changes and holding a simulation undoes."""
        data = self.device_data
        return [data.qpos, data.qvel, data.qacc_warmstart, data.time]

    def _physics(self) -> None:
        """Step the physics with the present controls, and hold the simulations that are not active."""
        model, data, step = self.device_model, self.device_data, wp.float64(self.model.opt.timestep)
        mjw.step2(model, data)
        wp.launch(kernels.finish_substep, self.num, inputs=[self._control, step], outputs=self._moved)
        mjw.step1(model, data)

    def _overflows(self) -> dict[int, str]:
        """Return which simulations had more contacts or constraints than room, by index; count the other flags."""
        flags = self.device_data.overflow.numpy()
        for flag in mjw.OverflowType:
            if not flag & _FULL and (count := int(np.count_nonzero(flags & int(flag)))):
                if flag.name not in self.limits_reached:
                    _log.warning(
                        "backend=warp: a limit of the solver was reached (%s); it goes on", flag.name
                    )
                self.limits_reached[str(flag.name)] += count
        full = flags & int(_FULL)
        return {int(i): self._no_room(mjw.OverflowType(int(full[i]))) for i in np.flatnonzero(full)}

    def _no_room(self, flags: mjw.OverflowType) -> str:
        contacts = self.backend.contacts
        return (
            f"it has more contacts or constraints than there is room for ({flags.name}); set "
            f"backend='warp,contacts={2 * contacts}' (now {contacts})"
        )

    def _times(self, ids: np.ndarray) -> list[float]:
        return [0.0] * len(ids)  # not asked for: values that are not finite stay so

    def _failures(self, before: Mapping[int, float]) -> dict[int, str]:
        finite = np.isfinite(self.fields["qpos"]).all(axis=1) & np.isfinite(self.fields["qvel"]).all(axis=1)
        failed = {i: DIVERGED for i in before if not finite[i]} | self._overflows() | self._no_start
        return {i: reason for i, reason in failed.items() if i in before}

    def _warm_start(self, i: int) -> list[np.ndarray]:
        return [self.device_data.qacc_warmstart.numpy()[i], self.device_data.ctrl.numpy()[i]]

    def _set_warm_start(self, i: int, values: list[np.ndarray]) -> None:
        for array, value in zip(
            (self.device_data.qacc_warmstart, self.device_data.ctrl), values, strict=True
        ):
            _write(array, i, value)
        self._copies.clear()


def _write(array: Any, where: Any, values: Any) -> None:
    """Write to a part of an array on the device, by way of the host."""
    rows = array.numpy()
    rows[where] = values
    array.assign(rows)
