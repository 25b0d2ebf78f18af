"""One simulation behind the interface of robosuite's `MjSim`: `sim.model`, `sim.data`, `sim.render`.

The model is the environment's own copy, so clients may write to it; a new pose of a fixture in `model.body_pos` and
`body_quat` takes effect with the next `forward`.
"""

import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from libero_env.envs.env import require_display
from libero_env.errors import LiberoError, RenderError, UnknownNameError
from libero_env.images import flip_rows
from libero_env.mujoco_compat import mujoco
from libero_env.sim.back_ends import LoopSimulations
from libero_env.sim.render import Renderer, RenderTarget

# Kind of element in robosuite -> kind in MuJoCo.
_NAMES = ("body", "joint", "geom", "site", "light", "camera", "actuator", "sensor", "tendon", "mesh")
KINDS = {kind: getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}") for kind in _NAMES}
_COUNTS = {"body": "nbody", "joint": "njnt", "camera": "ncam", "actuator": "nu"}  # the others are `n<kind>`
_FREE = mujoco.mjtJoint.mjJNT_FREE
_SHOWN_SITE_GROUPS = 3  # groups 0 to 2
_LARGE = 100_000  # [bytes] of arrays of meshes and textures


class MjSimState(NamedTuple):
    """Time, positions (nq,) and velocities (nv,)."""

    time: float
    qpos: np.ndarray
    qvel: np.ndarray

    @classmethod
    def from_flattened(cls, array: np.ndarray, sim: "MjSim") -> "MjSimState":
        """Return a state from `[time, qpos, qvel, ...]`; numbers after the velocities are left out."""
        nq, nv = sim.model.nq, sim.model.nv
        array = np.asarray(array, np.float64)
        if array.ndim != 1 or array.size < 1 + nq + nv:
            raise LiberoError(
                f"a flat state is [time, qpos ({nq}), qvel ({nv})], got shape {array.shape}; is it of another task?"
            )
        return cls(float(array[0]), array[1 : 1 + nq], array[1 + nq : 1 + nq + nv])

    def flatten(self) -> np.ndarray:
        """Return [time, qpos, qvel]."""
        return np.concatenate([[self.time], self.qpos, self.qvel])


class MjModel:
    """A MuJoCo model with names: `body_name2id`, `site_id2name`, `joint_names`, ...

    Other attributes are those of `mujoco.MjModel`.
    """

    def __init__(self, model: mujoco.MjModel, xml: Any = None):
        self.__dict__.update(_model=model, _xml=xml, _is_drawn_otherwise=False)

    def __getattr__(self, name: str) -> Any:
        if name.startswith(("tex", "mesh")):  # what clients asked for, they may have changed
            self.__dict__["_is_drawn_otherwise"] = True
        for kind in KINDS:
            if name == f"{kind}_name2id":
                return partial(self._id, kind)
            if name == f"{kind}_id2name":
                return partial(mujoco.mj_id2name, self._model, KINDS[kind])
            if name == f"{kind}_names":
                return tuple(self._names(kind))
        return getattr(self.__dict__["_model"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._model, name, value)

    def get_xml(self) -> str:
        """Return the scene as MJCF."""
        return self._xml()

    def get_joint_qpos_addr(self, name: str) -> int | tuple[int, int]:
        """Return the index of a joint in qpos, or (start, end) of a free joint."""
        return self._address(name, self._model.jnt_qposadr, 7)

    def get_joint_qvel_addr(self, name: str) -> int | tuple[int, int]:
        """Return the index of a joint in qvel, or (start, end) of a free joint."""
        return self._address(name, self._model.jnt_dofadr, 6)

    def _address(self, name: str, addresses: np.ndarray, length: int) -> int | tuple[int, int]:
        joint = self._id("joint", name)
        start = int(addresses[joint])
        return (start, start + length) if self._model.jnt_type[joint] == _FREE else start

    def _names(self, kind: str) -> list[str]:
        count = getattr(self._model, _COUNTS.get(kind, f"n{kind}"))
        return [mujoco.mj_id2name(self._model, KINDS[kind], i) or "" for i in range(count)]

    def _id(self, kind: str, name: str) -> int:
        index = mujoco.mj_name2id(self._model, KINDS[kind], name)
        if index < 0:
            raise UnknownNameError(kind, name, self._names(kind))
        return index


class MjData:
    """A MuJoCo state with names; other attributes are those of `mujoco.MjData`.

    `get_body_xpos(name)` and its like read `xpos`, `xquat`, `xmat`, `xvelp`, `xvelr`, `jacp` and `jacr` of bodies,
    geoms, sites, cameras and lights. `get_joint_qpos(name)` and `set_joint_qpos(name, value)` do so with `qpos` and
    `qvel` of joints, and `pos` and `quat` of mocap bodies; call `sim.forward` after a change.
    """

    def __init__(self, model: MjModel, data: mujoco.MjData):
        self.__dict__.update(model=model, _data=data)

    def __getattr__(self, name: str) -> Any:
        if name in ("body_xpos", "body_xquat", "body_xmat"):
            return getattr(self._data, name.removeprefix("body_"))
        verb, _, rest = name.partition("_")
        kind, _, field = rest.partition("_")
        if kind in ("joint", "mocap") and verb in ("get", "set"):
            return partial(self._get if verb == "get" else self._set, kind, field)
        if verb == "get" and kind in ("body", "geom", "site", "camera", "light"):
            return partial(self._read, kind, field)
        return getattr(self.__dict__["_data"], name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._data, name, value)

    def get_sensor(self, name: str) -> float:
        """Return the first number of a sensor."""
        return float(self._data.sensordata[self._data.model.sensor(name).adr[0]])

    def _get(self, kind: str, field: str, name: str) -> Any:
        rows, index = self._address(kind, field, name)
        return rows[index]

    def _set(self, kind: str, field: str, name: str, value: Any) -> None:
        rows, index = self._address(kind, field, name)
        rows[index] = value

    def _address(self, kind: str, field: str, name: str) -> tuple[np.ndarray, int | slice]:
        """Return the array and the index of `qpos` or `qvel` of a joint, or `pos` or `quat` of a mocap body."""
        if kind == "joint":
            address = getattr(self.model, f"get_joint_{field}_addr")(name)
            return getattr(self._data, field), slice(*address) if isinstance(address, tuple) else address
        index = int(self.model.body_mocapid[self.model.body_name2id(name)])
        if index < 0:
            raise LiberoError(f"body {name!r} is not a mocap body")
        return getattr(self._data, f"mocap_{field}"), index

    def _read(self, kind: str, field: str, name: str) -> np.ndarray:
        """Return a field of a named element in the world frame; velocities are those of its origin."""
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


class ClientSimulations(LoopSimulations):
    """A simulation in whose model clients may move fixtures.

    Attributes:
        domain: Weak reference to the environment that it belongs to.
    """

    domain: Any = None

    def read_fixtures(self) -> np.ndarray:
        """Return the poses of the fixtures in the model, (nfixtures, 7)."""
        bodies = self.fixture_bodies
        return np.concatenate([self.model.body_pos[bodies], self.model.body_quat[bodies]], axis=1)

    def set_rest(self, joints: np.ndarray) -> None:
        """Let the controller take these joints, (7,) rad, for the arm's rest pose, as the model is now."""
        self.rest = joints
        vars(self)["_rest_fields"] = self._fields_at_rest()


def restore(part: Any, built: Any, large: bool) -> None:
    """Undo all changes of a model, or of a structure in it.

    Args:
        part: The model that is simulated, which clients change.
        built: Another one, as it was built, which nobody changes.
        large: Whether those of meshes and textures are undone, too.
    """
    for name in dir(built):
        value = getattr(built, name)
        if name.startswith("_") or callable(value):
            continue
        if isinstance(value, np.ndarray):
            if large or value.nbytes < _LARGE:
                np.copyto(getattr(part, name), value)
        elif type(value).__module__.startswith("mujoco"):  # opt, stat, vis and what it consists of
            restore(getattr(part, name), value, large)
        elif not isinstance(part, mujoco.MjModel):  # whose sizes and names cannot change
            setattr(part, name, value)


class MjSim:
    """The simulation of an environment.

    Attributes:
        model, data: Model and state with names.
        draws_sites: Whether sites are drawn, those whose alpha is above 0.

    Args:
        simulations: One simulation.
        built: Its model as it was built, which nobody changes.
        xml: Function that returns the scene as MJCF.
        faithful: Whether images are drawn as `libero_env.sim.render.Renderer` describes.
    """

    draws_sites = True

    def __init__(
        self,
        simulations: LoopSimulations,
        built: mujoco.MjModel,
        xml: Callable[[], str] | None = None,
        *,
        faithful: bool = True,
    ):
        self._simulations, self._origin = simulations, built
        self.model = MjModel(simulations.model, xml)
        self.data = MjData(self.model, simulations.data(0))
        self._renderers: dict[tuple[int, int], Renderer] = {}
        self._faithful = faithful

    def reset(self) -> None:
        """Set the state to the initial state of the model."""
        mujoco.mj_resetData(self.model._model, self.data._data)

    def restore_model(self) -> None:
        """Undo all changes of the model."""
        large = self.model._is_drawn_otherwise
        restore(self.model._model, self._origin, large)
        if large:  # renderers hold the textures
            self._free_renderers()
            self.model.__dict__["_is_drawn_otherwise"] = False

    def forward(self) -> None:
        """Compute everything that follows from positions and velocities."""
        mujoco.mj_forward(self.model._model, self.data._data)

    def step(self, with_udd: bool = True) -> None:
        """Take one physics step of 2 ms with the present controls."""
        mujoco.mj_step(self.model._model, self.data._data)

    def step1(self) -> None:
        """Take the first half of `step`, up to the velocities."""
        mujoco.mj_step1(self.model._model, self.data._data)

    def step2(self) -> None:
        """Take the second half of `step`."""
        mujoco.mj_step2(self.model._model, self.data._data)

    def get_state(self) -> MjSimState:
        """Return a copy of time, positions and velocities."""
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
        """Draw one picture in OpenGL's order, lowest row first.

        Segmentations contain sites that are hidden from pictures, such as those of the gripper, as in the original,
        where robosuite hides them by a negative alpha.

        Returns:
            (H, W, 3) uint8; with `segmentation` (H, W, 2) int32 of kind and index, -1 for the background; with `depth`
            a pair of it and (H, W) float32 in [0, 1], the normalised depth buffer.
        """
        height, width = height or 480, width or 640
        channels, dtype = ((), np.int32) if segmentation else ((3,), np.uint8)
        image = np.empty((height, width, *channels), dtype)
        buffer = np.empty((height, width), np.float32) if depth else None
        renderer = self._renderer(height, width)
        camera = renderer.camera_id(camera_name or "frontview")
        target = RenderTarget(
            camera, depth_buffer=buffer, **{"segmentation" if segmentation else "rgb": image}
        )
        sites = self._sites(segmentation) if self.draws_sites else ()
        renderer.render(self.data._data, [target], sites)
        if segmentation:
            image = self._elements(image)
        return flip_rows(image) if buffer is None else (flip_rows(image), flip_rows(buffer))

    def _elements(self, numbers: np.ndarray) -> np.ndarray:
        """Return kind and index (H, W, 2) of the elements whose numbers (H, W) were drawn."""
        ngeom = self.model.ngeom
        kind = np.where(numbers > ngeom, int(KINDS["site"]), np.where(numbers > 0, int(KINDS["geom"]), -1))
        index = np.where(numbers > ngeom, numbers - 1 - ngeom, numbers - 1)
        return np.stack([kind, index], axis=-1).astype(np.int32)

    def _sites(self, hidden: bool) -> list[int]:
        """Return the sites that are shown, or those that are not transparent, of the groups that the original shows."""
        alpha = self.model.site_rgba[:, 3]
        seen = (alpha != 0) if hidden else (alpha > 0)
        return np.flatnonzero(seen & (self.model.site_group < _SHOWN_SITE_GROUPS)).tolist()

    def show_sites(self, names: Iterable[str], visible: bool) -> None:
        """Show or hide sites: as in robosuite, the alpha of a hidden one is negative."""
        for name in names:
            rgba = self.model.site_rgba[self.model.site_name2id(name)]
            rgba[3] = abs(rgba[3]) if visible else -abs(rgba[3])

    def _renderer(self, height: int, width: int) -> Renderer:
        if (height, width) not in self._renderers:
            self._renderers[height, width] = Renderer(
                self.model._model, height, width, faithful=self._faithful
            )
        return self._renderers[height, width]

    def _free_renderers(self) -> None:
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def free(self) -> None:
        """Free GL contexts and the simulation. Idempotent."""
        self._free_renderers()
        self._simulations.close()


class Window:
    """MuJoCo's viewer of a simulation, opened at the first `show`.

    Without a screen, `show` warns once and does nothing, so a script with `has_renderer=True` also runs on a server.

    Args:
        camera: Camera of the first view.
    """

    def __init__(self, camera: str):
        self.camera = camera
        self._viewer: list[Any] = []

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Show the present state; a window that the user closed stays closed."""
        self._viewer = self._viewer or [self._opened(model, data)]
        if self._viewer[0] is not None and self._viewer[0].is_running():
            self._viewer[0].sync()

    def close(self) -> None:
        """Close the window. Idempotent."""
        for viewer in filter(None, self._viewer):
            viewer.close()
        self._viewer = [None]

    def _opened(self, model: mujoco.MjModel, data: mujoco.MjData) -> Any:
        try:
            require_display()
        except RenderError:
            message = "has_renderer=True: there is no screen; use camera observations or sim.render"
            warnings.warn(message, stacklevel=4)
            return None
        from mujoco import viewer  # it loads a GL library

        window = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        window.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        window.cam.fixedcamid = model.camera(self.camera).id
        return window
