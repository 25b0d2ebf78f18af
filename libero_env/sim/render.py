"""Pictures without a screen: GL backend choice and a renderer that draws upright frames, depth and segmentation.

OpenGL contexts are opened lazily, by the thread that draws; nothing is shared between processes.
"""

import importlib
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np

from libero_env.errors import RenderError, UnknownNameError

BACKENDS = ("egl", "osmesa", "glfw")
REMEDY = (
    "install a GL library (Debian and Ubuntu: apt-get install -y libegl1 libgl1-mesa-dri libosmesa6), or set "
    "MUJOCO_GL to one of egl, osmesa, glfw; `libero doctor` checks it"
)


def open_context(width: int, height: int) -> tuple[str, object]:
    """Open an offscreen OpenGL context: (backend name, context with make_current and free).

    `MUJOCO_GL` chooses the backend where it is set; otherwise EGL is tried, then OSMesa.

    Raises:
        RenderError: none works here; the message says why and what to install.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted and wanted not in BACKENDS:
        raise RenderError(f"MUJOCO_GL={wanted} is not a backend; valid: {', '.join(BACKENDS)}. Or unset it")
    failures = []
    for name in (wanted,) if wanted else ("egl", "osmesa"):
        try:
            return name, importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        except Exception as error:  # noqa: BLE001 - each backend fails in its own way (ImportError, AttributeError, GL)
            failures.append(
                f"{name}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            )
    raise RenderError(f"no OpenGL backend works here ({'; '.join(failures)}). Remedy: {REMEDY}")


@lru_cache(maxsize=1)
def choose_backend() -> str:
    """Name of the backend that works here; opens a small context to find out.

    Raises:
        RenderError: none does.
    """
    name, context = open_context(64, 64)
    context.free()
    return name


@dataclass(frozen=True)
class Picture:
    """Where one camera is drawn to; what is None is not drawn. First row on top.

    Attributes:
        camera: index in the model.
        rgb: (height, width, 3) uint8.
        depth: (height, width) float32, metres along the optical axis; the far plane where nothing is.
        segmentation: (height, width) int32: 1 + geom, 1 + ngeom + site, and 0 where nothing is.
    """

    camera: int
    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    segmentation: np.ndarray | None = None


class Renderer:
    """Draws a model's cameras.

    Visual geoms (group 1) are drawn, and the sites that are said to glow. Use from one thread; close it, or use it as
    a context manager.
    """

    def __init__(self, model: mujoco.MjModel, height: int, width: int):
        largest = min(model.vis.global_.offheight, model.vis.global_.offwidth)
        if not (0 < height <= largest and 0 < width <= largest):
            raise RenderError(
                f"a frame of {height}x{width} pixels is not between 1 and {largest} on each side"
            )
        self._model, self._height, self._width = model, height, width
        self._gl: object | None = None
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)

    def camera_id(self, name: str) -> int:
        """Index of a camera.

        Raises:
            UnknownNameError: the model has no such camera; the message lists them.
        """
        index = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_CAMERA, name)
        if index < 0:
            raise UnknownNameError(
                "camera", name, [self._model.camera(i).name for i in range(self._model.ncam)]
            )
        return index

    def render(self, data: mujoco.MjData, cameras: list[int], out: list[np.ndarray]) -> None:
        """Draw the cameras of one state into the arrays of `out`, each (height, width, 3) uint8."""
        self.draw(data, [Picture(camera, frame) for camera, frame in zip(cameras, out, strict=True)])

    def draw(self, data: mujoco.MjData, pictures: Sequence[Picture], glowing: Iterable[int] = ()) -> None:
        """Draw pictures of one state.

        Args:
            data: kinematics, cameras and lights are up to date.
            pictures: what to draw.
            glowing: indices of the sites to show.
        """
        if self._gl is None:
            self._open()
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        for k, picture in enumerate(pictures):
            self._camera.fixedcamid = picture.camera
            if k == 0:
                mujoco.mjv_updateScene(
                    self._model, data, self._options, None, self._camera, everything, self._scene
                )
                for site in glowing:
                    self._add_site(data, site)
            else:
                mujoco.mjv_updateCamera(self._model, data, self._camera, self._scene)
            if picture.rgb is not None or picture.depth is not None:
                self._draw_colours(picture)
            if picture.segmentation is not None:
                self._draw_segmentation(picture.segmentation)

    def _draw_colours(self, picture: Picture) -> None:
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        depth = None if picture.depth is None else self._depth
        mujoco.mjr_readPixels(
            None if picture.rgb is None else self._pixels, depth, self._viewport, self._context
        )
        if picture.rgb is not None:
            picture.rgb[:] = self._pixels[::-1]  # OpenGL's first row is the lowest
        if picture.depth is not None:
            # The buffer holds 1 at the near plane and 0 at the far plane, hyperbolic between them.
            near, far = (getattr(self._model.vis.map, n) * self._model.stat.extent for n in ("znear", "zfar"))
            picture.depth[:] = near * far / (near + depth[::-1].astype(np.float64) * (far - near))

    def _draw_segmentation(self, out: np.ndarray) -> None:
        flags, scene = self._scene.flags, self._scene
        kinds = {int(mujoco.mjtObj.mjOBJ_GEOM): 1, int(mujoco.mjtObj.mjOBJ_SITE): 1 + self._model.ngeom}
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            mujoco.mjr_render(self._viewport, scene, self._context)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._context)
        names = np.zeros(scene.ngeom + 1, np.int32)  # colour -> name; 0 is the background
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objtype in kinds:
                names[geom.segid + 1] = kinds[geom.objtype] + geom.objid
        red, green, blue = np.moveaxis(self._pixels[::-1].astype(np.int32), 2, 0)
        out[:] = names[red + (green << 8) + (blue << 16)]

    def _add_site(self, data: mujoco.MjData, site: int) -> None:
        """Append a site to the scene, as it would be drawn if its group were shown."""
        model, scene = self._model, self._scene
        geom = scene.geoms[scene.ngeom]
        material = model.site_matid[site]
        rgba = model.site_rgba[site] if material < 0 else model.mat_rgba[material]
        mujoco.mjv_initGeom(
            geom,
            model.site_type[site],
            model.site_size[site],
            data.site_xpos[site],
            data.site_xmat[site],
            rgba.astype(np.float32),
        )
        geom.emission = 1.0 if material < 0 else model.mat_emission[material]
        geom.objtype, geom.objid, geom.segid = mujoco.mjtObj.mjOBJ_SITE, site, scene.ngeom
        geom.category = mujoco.mjtCatBit.mjCAT_DYNAMIC
        scene.ngeom += 1

    def close(self) -> None:
        """Free the context. Idempotent."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> None:
        backend, gl = open_context(self._width, self._height)
        gl.make_current()
        try:
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_50)
        except mujoco.FatalError as error:
            gl.free()
            raise RenderError(f"{backend} opens, but draws nothing ({error}). Remedy: {REMEDY}") from error
        self._gl = gl
        mujoco.mjr_resizeOffscreen(self._width, self._height, self._context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[1] = 1
        self._options.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._viewport = mujoco.MjrRect(0, 0, self._width, self._height)
