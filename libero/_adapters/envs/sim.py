"""One simulation behind the interface of robosuite's `MjSim`: `sim.model`, `sim.data`, `sim.render`.

The model is the environment's own copy, so clients may write to it; where a fixture's root body is put in
`model.body_pos` and `body_quat` counts from the next `forward` on.
"""

from typing import Any, NamedTuple

import mujoco
import numpy as np

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.sim.render import Picture, Renderer
from libero_env.sim.simulation import LoopSimulations

# Kind of element, as robosuite calls it -> MuJoCo's number of its kind.
KINDS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "light": mujoco.mjtObj.mjOBJ_LIGHT,
    "camera": mujoco.mjtObj.mjOBJ_CAMERA,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "mesh": mujoco.mjtObj.mjOBJ_MESH,
}
_COUNTS = {
    kind: {"body": "nbody", "joint": "njnt", "camera": "ncam", "actuator": "nu"}.get(kind, f"n{kind}")
    for kind in KINDS
}
_FREE = mujoco.mjtJoint.mjJNT_FREE


class MjSimState(NamedTuple):
    """Time, positions (nq,) and velocities (nv,)."""

    time: float
    qpos: np.ndarray
    qvel: np.ndarray

    @classmethod
    def from_flattened(cls, array: np.ndarray, sim: "MjSim") -> "MjSimState":
        """The inverse of `flatten`; what follows the velocities is left out."""
        nq, nv = sim.model.nq, sim.model.nv
        array = np.asarray(array, np.float64)
        if array.ndim != 1 or array.size < 1 + nq + nv:
            raise LiberoError(
                f"a flat state is [time, qpos ({nq}), qvel ({nv})], got shape {array.shape}; is it of another task?"
            )
        return cls(float(array[0]), array[1 : 1 + nq], array[1 + nq : 1 + nq + nv])

    def flatten(self) -> np.ndarray:
        """[time, qpos, qvel]."""
        return np.concatenate([[self.time], self.qpos, self.qvel])


class MjModel:
    """A MuJoCo model with names: `body_name2id`, `site_id2name`, `joint_names`, ...; all else is the model's own."""

    def __init__(self, model: mujoco.MjModel, xml: Any = None):
        self.__dict__.update(_model=model, _xml=xml)

    def __getattr__(self, name: str) -> Any:
        for kind in KINDS:
            if name == f"{kind}_name2id":
                return lambda element, kind=kind: self._id(kind, element)
            if name == f"{kind}_id2name":
                return lambda index, kind=kind: mujoco.mj_id2name(self._model, KINDS[kind], index)
            if name == f"{kind}_names":
                return tuple(self._names(kind))
        return getattr(self.__dict__["_model"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._model, name, value)

    def get_xml(self) -> str:
        """The scene as MJCF."""
        return self._xml()

    def get_joint_qpos_addr(self, name: str) -> int | tuple[int, int]:
        """Index of a joint in qpos, or (start, end) of a free one."""
        return self._address(name, self._model.jnt_qposadr, 7)

    def get_joint_qvel_addr(self, name: str) -> int | tuple[int, int]:
        """Index of a joint in qvel, or (start, end) of a free one."""
        return self._address(name, self._model.jnt_dofadr, 6)

    def _address(self, name: str, addresses: np.ndarray, length: int) -> int | tuple[int, int]:
        joint = self._id("joint", name)
        start = int(addresses[joint])
        return (start, start + length) if self._model.jnt_type[joint] == _FREE else start

    def _names(self, kind: str) -> list[str]:
        count = getattr(self._model, _COUNTS[kind])
        return [mujoco.mj_id2name(self._model, KINDS[kind], i) or "" for i in range(count)]

    def _id(self, kind: str, name: str) -> int:
        index = mujoco.mj_name2id(self._model, KINDS[kind], name)
        if index < 0:
            raise UnknownNameError(kind, name, self._names(kind))
        return index


class MjData:
    """A MuJoCo state with names: `get_site_xpos`, `set_joint_qpos`, ...; all else is the data's own."""

    def __init__(self, model: MjModel, data: mujoco.MjData):
        self.__dict__.update(model=model, _data=data)

    def __getattr__(self, name: str) -> Any:
        if name in ("body_xpos", "body_xquat", "body_xmat"):
            return getattr(self._data, name.removeprefix("body_"))
        verb, _, rest = name.partition("_")
        kind, _, field = rest.partition("_")
        if verb == "get" and kind in ("body", "geom", "site", "camera", "light"):
            return lambda element: self._read(kind, field, element)
        return getattr(self.__dict__["_data"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._data, name, value)

    def get_sensor(self, name: str) -> float:
        """First number of a sensor."""
        return float(self._data.sensordata[self._data.model.sensor(name).adr[0]])

    def get_joint_qpos(self, name: str) -> Any:
        """Position of a joint: a number, or (7,) of a free one."""
        return self._data.qpos[_slice(self.model.get_joint_qpos_addr(name))]

    def set_joint_qpos(self, name: str, value: Any) -> None:
        """Put a joint somewhere; call `sim.forward` afterwards."""
        self._data.qpos[_slice(self.model.get_joint_qpos_addr(name))] = value

    def get_joint_qvel(self, name: str) -> Any:
        """Velocity of a joint: a number, or (6,) of a free one."""
        return self._data.qvel[_slice(self.model.get_joint_qvel_addr(name))]

    def set_joint_qvel(self, name: str, value: Any) -> None:
        """Set the velocity of a joint; call `sim.forward` afterwards."""
        self._data.qvel[_slice(self.model.get_joint_qvel_addr(name))] = value

    def get_mocap_pos(self, name: str) -> np.ndarray:
        """Position of a mocap body, (3,)."""
        return self._data.mocap_pos[self._mocap(name)]

    def set_mocap_pos(self, name: str, value: np.ndarray) -> None:
        """Move a mocap body."""
        self._data.mocap_pos[self._mocap(name)] = value

    def get_mocap_quat(self, name: str) -> np.ndarray:
        """Orientation of a mocap body, wxyz (4,)."""
        return self._data.mocap_quat[self._mocap(name)]

    def set_mocap_quat(self, name: str, value: np.ndarray) -> None:
        """Turn a mocap body."""
        self._data.mocap_quat[self._mocap(name)] = value

    def _mocap(self, name: str) -> int:
        index = int(self.model.body_mocapid[self.model.body_name2id(name)])
        if index < 0:
            raise LiberoError(f"body {name!r} is no mocap body")
        return index

    def _read(self, kind: str, field: str, name: str) -> np.ndarray:
        """A field of a named element in the world frame; velocities are those of its origin."""
        index, model = self.model._id(kind, name), self.model._model
        if field in ("jacp", "jacr"):
            jacobians = np.zeros((2, 3, model.nv))
            getattr(mujoco, f"mj_jac{kind.capitalize()}")(model, self._data, *jacobians, index)
            return jacobians[int(field == "jacr")]
        if field in ("xvelp", "xvelr"):
            return self._read(kind, field.replace("xvel", "jac"), name) @ self._data.qvel
        prefix = {"body": "", "geom": "geom_", "site": "site_", "camera": "cam_", "light": "light_"}[kind]
        value = getattr(self._data, prefix + field)[index]
        return value.reshape(3, 3) if field == "xmat" else value


def _slice(address: int | tuple[int, int]) -> int | slice:
    return slice(*address) if isinstance(address, tuple) else address


class MjSim:
    """The simulation of an environment: `simulations` holds one."""

    def __init__(self, simulations: LoopSimulations, xml: Any = None):
        self._simulations = simulations
        self.model = MjModel(simulations.model, xml)
        self.data = MjData(self.model, simulations.data(0))
        self.glowing: Any = lambda: ()  # which sites are to be seen
        self._renderers: dict[tuple[int, int], Renderer] = {}

    def reset(self) -> None:
        """Everything as the model says."""
        mujoco.mj_resetData(self.model._model, self.data._data)

    def forward(self) -> None:
        """Compute all that follows from positions and velocities."""
        mujoco.mj_forward(self.model._model, self.data._data)

    def step(self, with_udd: bool = True) -> None:
        """One physics step of 2 ms with the controls as they are."""
        mujoco.mj_step(self.model._model, self.data._data)

    def step1(self) -> None:
        """First half of `step`, up to the velocities."""
        mujoco.mj_step1(self.model._model, self.data._data)

    def step2(self) -> None:
        """Second half of `step`."""
        mujoco.mj_step2(self.model._model, self.data._data)

    def get_state(self) -> MjSimState:
        """A copy of time, positions and velocities."""
        data = self.data._data
        return MjSimState(data.time, data.qpos.copy(), data.qvel.copy())

    def set_state(self, value: MjSimState) -> None:
        """Write time, positions and velocities; call `forward` afterwards."""
        data = self.data._data
        data.time, data.qpos[:], data.qvel[:] = value

    def set_state_from_flattened(self, value: np.ndarray) -> None:
        """Write [time, qpos, qvel]; call `forward` afterwards."""
        self.set_state(MjSimState.from_flattened(value, self))

    def render(
        self,
        width: int | None = None,
        height: int | None = None,
        *,
        camera_name: str | None = None,
        depth: bool = False,
        mode: str = "offscreen",
        device_id: int = -1,
        segmentation: bool = False,
    ) -> Any:
        """One picture in OpenGL's order, lowest row first.

        Returns:
            (H, W, 3) uint8; with `segmentation` (H, W, 2) int32 of kind and index, -1 where nothing is; with `depth` a
            pair of it and (H, W) float32 in [0, 1], the normalised depth buffer.
        """
        height, width = height or 480, width or 640
        renderer = self._renderer(height, width)
        camera = renderer.camera_id(camera_name or "frontview")
        colours = np.empty((height, width, 3), np.uint8)
        distance = np.empty((height, width), np.float32) if depth else None
        numbers = np.empty((height, width), np.int32) if segmentation else None
        picture = Picture(camera, None if segmentation else colours, distance, numbers)
        renderer.draw(self.data._data, [picture], self.glowing())
        image = colours if numbers is None else self._elements(numbers)
        if distance is None:
            return image[::-1]
        return image[::-1], self._normalised(distance)[::-1]

    def _elements(self, numbers: np.ndarray) -> np.ndarray:
        """(H, W) numbers of elements -> (H, W, 2) kind and index."""
        ngeom = self.model.ngeom
        kind = np.where(numbers > ngeom, int(KINDS["site"]), np.where(numbers > 0, int(KINDS["geom"]), -1))
        index = np.where(numbers > ngeom, numbers - 1 - ngeom, numbers - 1)
        return np.stack([kind, index], axis=-1).astype(np.int32)

    def _normalised(self, distance: np.ndarray) -> np.ndarray:
        """Metres -> OpenGL's depth buffer, 0 at the near plane and 1 at the far plane."""
        map_, extent = self.model.vis.map, self.model.stat.extent
        near, far = map_.znear * extent, map_.zfar * extent
        return ((1.0 - near / distance.astype(np.float64)) / (1.0 - near / far)).astype(np.float32)

    def _renderer(self, height: int, width: int) -> Renderer:
        if (height, width) not in self._renderers:
            self._renderers[height, width] = Renderer(self.model._model, height, width)
        return self._renderers[height, width]

    def free(self) -> None:
        """Free GL contexts and the simulation. Idempotent."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()
        self._simulations.close()
