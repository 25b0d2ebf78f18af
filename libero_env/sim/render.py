"""Offscreen rendering: choice of the OpenGL backend, and a renderer of RGB, depth and segmentation images.

OpenGL contexts are opened when an image is first rendered, by the thread that renders it; nothing is shared between
processes.
"""

import importlib
import os
import re
import sys
import threading
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from libero_env.errors import RenderError
from libero_env.images import flip_rows
from libero_env.mujoco_compat import forget_opengl, mujoco
from libero_env.parallel import after_forks, first_picture
from libero_env.sim.appearance import SceneAppearance, element_index
from libero_env.sim.culling import Culling

# those of MuJoCo on this system; the last one needs a display, and is used unasked only where it is the only one
BACKENDS = {"darwin": ("cgl", "glfw"), "win32": ("glfw",)}.get(sys.platform, ("egl", "osmesa", "glfw"))
REMEDY = (
    "install a GL library (Debian and Ubuntu: apt-get install -y libegl1 libopengl0 libgl1-mesa-dri libosmesa6), or "
    f"set MUJOCO_GL to one of {', '.join(BACKENDS)}; `libero doctor` checks it"
)
FORKED = (
    "this process was forked from one that has rendered, and OpenGL does not survive that. Render first in the new "
    "process, or start processes with multiprocessing.get_context('spawn')"
)
HEADLIGHT_CAMERA = "agentview"  # so that a picture does not depend on which others are drawn with it
_opened_in: set[int] = set()  # processes, this one or those it was forked from, that have opened a context
_unreachable: list[Any] = []  # contexts of other threads and processes: to free them here would free others
_abandoned: list[Any] = []  # process, thread and contexts of renderers that were not closed


class GLContext(Protocol):
    """An OpenGL context, such as that of `mujoco.egl`."""

    def make_current(self) -> None:
        """Make this the context that OpenGL calls of the thread refer to."""

    def free(self) -> None:
        """Free the context."""


def open_context(width: int, height: int) -> tuple[str, GLContext]:
    """Open an offscreen OpenGL context.

    The environment variable `MUJOCO_GL` chooses the backend where it is set; otherwise EGL is tried, then OSMesa; on
    macOS CGL, on Windows GLFW.
    Mesa's software renderer draws in the calling thread unless `LP_NUM_THREADS` is set; images do not depend on it.

    Args:
        width: Width of the framebuffer, pixels.
        height: Height of the framebuffer, pixels.

    Returns:
        Name of the backend and the context.

    Raises:
        RenderError: No backend works here, or this process is a fork of one that has opened a context, which would
            hang; the message states what to do.
    """
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if _opened_in and os.getpid() not in _opened_in:
        raise RenderError(FORKED)
    if chosen and chosen not in BACKENDS:
        raise RenderError(f"MUJOCO_GL={chosen} is not a backend; valid: {', '.join(BACKENDS)}. Or unset it")
    # small images gain nothing from threads, which wait for each other
    os.environ.setdefault("LP_NUM_THREADS", "0")
    failures, platform = [], os.environ.get("PYOPENGL_PLATFORM")
    for name in (chosen,) if chosen else BACKENDS[:-1] or BACKENDS:
        try:
            context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
            _opened_in.add(os.getpid())
            if name == "osmesa":
                os.environ["MUJOCO_GL"] = name  # where MuJoCo's library looks for OpenGL's functions
            return name, context
        except Exception as error:  # noqa: BLE001 - each backend fails in its own way (ImportError, AttributeError, GL)
            failures.append(
                f"{name}: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            )
            forget_opengl(platform)
    device = os.environ.get("MUJOCO_EGL_DEVICE_ID")
    if device is not None and failures[0].startswith(
        ("egl: RuntimeError: The MUJOCO_EGL_DEVICE_ID", "egl: ValueError")
    ):
        valid = re.findall(r"between .*?(?= \(|,|$)", failures[0])
        raise RenderError(
            f"MUJOCO_EGL_DEVICE_ID={device} is not a GPU that EGL can draw on; valid: whole numbers "
            f"{valid[0] if valid else 'from 0'}. Or unset it"
        )
    if any("PYOPENGL_PLATFORM" in failure for failure in failures):
        expected = chosen or BACKENDS[0]
        raise RenderError(f"PYOPENGL_PLATFORM={platform} excludes {expected}; valid: {expected}. Or unset it")
    raise RenderError(f"no OpenGL backend works here ({'; '.join(failures)}). Remedy: {REMEDY}")


def renderer_name() -> tuple[str, str]:
    """Return the names of the OpenGL backend and of the renderer, such as `egl` and `llvmpipe (LLVM 15.0.6)`.

    Raises:
        RenderError: No backend works here.
    """
    backend, name, _ = _opengl()
    return backend, name


def largest_image() -> int:
    """Return the largest height and width of an image that OpenGL can draw here, pixels.

    Raises:
        RenderError: No backend works here.
    """
    return _opengl()[2]


@lru_cache(maxsize=1)
def _opengl() -> tuple[str, str, int]:
    """Return the names of OpenGL's backend and renderer, and the largest edge of a picture, pixels."""
    backend, context = open_context(64, 64)
    try:
        context.make_current()
        gl = importlib.import_module("OpenGL.GL")  # after the context, which chooses PyOpenGL's platform
        name = gl.glGetString(gl.GL_RENDERER)
        limits = [gl.glGetIntegerv(kind) for kind in (gl.GL_MAX_RENDERBUFFER_SIZE, gl.GL_MAX_VIEWPORT_DIMS)]
    finally:
        context.free()
    largest = int(min(np.min(limit) for limit in limits))
    return backend, name.decode(errors="replace") if name else "unknown", largest


@dataclass(frozen=True)
class RenderTarget:
    """Arrays that the image of one camera is written to, first row on top. Arrays that are None are not rendered.

    Attributes:
        rgb: Colours, (height, width, 3) uint8.
        depth: Distance along the optical axis, (height, width) float32, m; that of the far plane in the background.
        depth_buffer: OpenGL's depth, (height, width) float32: 0 at the near plane and 1 at the far plane.
        segmentation: Rendered elements, (height, width) int32: 1 + geom, 1 + ngeom + site, 0 for the background.
    """

    camera: int
    rgb: np.ndarray | None = None
    depth: np.ndarray | None = None
    depth_buffer: np.ndarray | None = None
    segmentation: np.ndarray | None = None


class Renderer:
    """Renderer of a model's cameras.

    Visual geoms (group 1) are rendered, and the sites that glow. The OpenGL context belongs to the thread that renders
    first; others may not render, nor close it while that thread runs. Close it, or use it as a context manager.

    Args:
        model: Model to render.
        height: Height of the images, pixels.
        width: Width of the images, pixels.
        faithful: Whether reflections are drawn, sites as the original does, and the headlight at each camera instead of
            always at `agentview`, or in a model without it at the first camera. Multisampling is the model's.
        cull: Whether what the camera cannot show is left out; images do not depend on it.

    Raises:
        RenderError: The images are larger than OpenGL can draw here.
    """

    def __init__(
        self, model: mujoco.MjModel, height: int, width: int, *, faithful: bool = False, cull: bool = True
    ):
        largest = min(model.vis.global_.offheight, model.vis.global_.offwidth)
        if max(height, width) > largest:  # the buffer is made larger
            largest = largest_image()
        if not (0 < height <= largest and 0 < width <= largest):
            raise RenderError(
                f"an image of {height}x{width} pixels is not valid; OpenGL draws heights and widths from 1 to "
                f"{largest} here"
            )
        self._model, self._height, self._width, self._faithful = model, height, width, faithful
        agent = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, HEADLIGHT_CAMERA)
        self._lit_from = None if faithful or agent < 0 else agent
        self._culling = Culling(model) if cull else None
        self._gl: GLContext | None = None
        self._owner = 0, threading.current_thread()
        self._pixels = np.empty((height, width, 3), np.uint8)
        self._depth = np.empty((height, width), np.float32)

    def camera_id(self, name: str) -> int:
        """Return the index of a camera.

        Raises:
            UnknownNameError: The model has no such camera; the message lists its cameras.
        """
        return element_index(self._model, "camera", name)

    @first_picture()
    def render(
        self,
        data: mujoco.MjData,
        targets: Sequence[RenderTarget],
        glowing_sites: Iterable[int] = (),
        appearance: SceneAppearance | None = None,
    ) -> None:
        """Render images of one state.

        Args:
            data: State whose kinematics, cameras and lights are up to date.
            targets: Cameras, and the arrays to write their images to.
            glowing_sites: Indices of the sites to show.
            appearance: What is drawn otherwise; poses of cameras are in `data` already.

        Raises:
            RenderError: No OpenGL backend works here, or the context belongs to another thread or process.
        """
        if _abandoned:
            _free_abandoned()
        if self._gl is None:
            self._gl, self._owner = self._open(), (os.getpid(), threading.current_thread())
            after_forks(_keep_contexts)
            _renderers.add(self)
        elif self._owner[1] is not threading.current_thread() or self._owner[0] != os.getpid():
            raise RenderError(self._owner_text())
        self._gl.make_current()
        all_categories = mujoco.mjtCatBit.mjCAT_ALL
        for k, target in enumerate(targets):
            if k == 0 or self._faithful:
                self._camera.fixedcamid = target.camera if self._lit_from is None else self._lit_from
                mujoco.mjv_updateScene(
                    self._model, data, self._options, None, self._camera, all_categories, self._scene
                )
                for site in glowing_sites:
                    self._add_site(data, site)
                if appearance is not None:
                    appearance.apply(self._scene, self._geoms[: self._scene.ngeom])
            if not self._faithful:  # without the headlight
                self._camera.fixedcamid = target.camera
                mujoco.mjv_updateCamera(self._model, data, self._camera, self._scene)
            fovy = None if appearance is None else appearance.apply_to_camera(self._scene, target.camera)
            left_out = []
            if self._culling is not None:
                aspect, geoms = self._width / self._height, self._geoms[: self._scene.ngeom]
                left_out = self._culling.apply(data, target.camera, aspect, geoms, self._faithful, fovy)
            if any(out is not None for out in (target.rgb, target.depth, target.depth_buffer)):
                self._render_rgb_and_depth(target)
            if target.segmentation is not None:
                self._render_segmentation(target.segmentation)
            for geom, kind in left_out:
                geom.type = kind

    def _render_rgb_and_depth(self, target: RenderTarget) -> None:
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        pixels = None if target.rgb is None else self._pixels
        depth = None if target.depth is None and target.depth_buffer is None else self._depth
        mujoco.mjr_readPixels(pixels, depth, self._viewport, self._context)
        if target.rgb is not None:
            target.rgb[:] = flip_rows(self._pixels)
        if target.depth_buffer is not None:
            target.depth_buffer[:] = 1.0 - flip_rows(self._depth)
        if target.depth is not None:
            # The buffer holds 1 at the near plane and 0 at the far plane, hyperbolic between them.
            near, far = (getattr(self._model.vis.map, n) * self._model.stat.extent for n in ("znear", "zfar"))
            target.depth[:] = near * far / (near + flip_rows(self._depth).astype(np.float64) * (far - near))

    def _render_segmentation(self, out: np.ndarray) -> None:
        flags, scene = self._scene.flags, self._scene
        kinds = {int(mujoco.mjtObj.mjOBJ_GEOM): 1, int(mujoco.mjtObj.mjOBJ_SITE): 1 + self._model.ngeom}
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            mujoco.mjr_render(self._viewport, scene, self._context)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        mujoco.mjr_readPixels(self._pixels, None, self._viewport, self._context)
        elements = np.zeros(scene.ngeom + 1, np.int32)  # by colour; 0 is the background
        for geom in scene.geoms[: scene.ngeom]:
            if geom.objtype in kinds:
                elements[geom.segid + 1] = kinds[geom.objtype] + geom.objid
        red, green, blue = np.moveaxis(flip_rows(self._pixels).astype(np.int32), 2, 0)
        out[:] = elements[red + (green << 8) + (blue << 16)]

    def _add_site(self, data: mujoco.MjData, site: int) -> None:
        """Add a site to the scene, as MuJoCo would if its group were shown."""
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
        if material >= 0:
            geom.emission = model.mat_emission[material]
        elif not self._faithful:
            geom.emission = 1.0
        geom.objtype, geom.objid, geom.segid = mujoco.mjtObj.mjOBJ_SITE, site, scene.ngeom
        geom.category = mujoco.mjtCatBit.mjCAT_DYNAMIC
        scene.ngeom += 1

    def close(self) -> None:
        """Free the OpenGL context; the renderer opens a new one when it is used again.

        That of a thread that has ended, or of the process that this one was forked from, cannot be freed.

        Raises:
            RenderError: It belongs to another thread, which runs; nothing has changed.
        """
        if self._gl is None:
            return
        pid, thread = self._owner
        if pid == os.getpid() and thread is threading.current_thread():
            self._gl.make_current()
            self._context.free()
            self._gl.free()
        elif pid == os.getpid() and thread.is_alive():
            raise RenderError(self._owner_text())
        else:
            _unreachable.append((self._gl, self._context))
        self._gl = None

    def __del__(self) -> None:
        """Leave the context to the next picture of its thread: MuJoCo would free it in the one that is current."""
        if getattr(self, "_gl", None) is not None:
            _abandoned.append((self._owner, self._gl, self._context))

    def _owner_text(self) -> str:
        """Return why this thread cannot use the context."""
        pid, thread = self._owner
        if pid != os.getpid():
            return FORKED
        ended = "" if thread.is_alive() else ", which has ended"
        return (
            f"the images of this environment are rendered by thread {thread.name!r}{ended}; this is thread "
            f"{threading.current_thread().name!r}. Render and close it there, or make an environment in each thread"
        )

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _open(self) -> GLContext:
        backend, gl = open_context(self._width, self._height)
        gl.make_current()
        try:
            self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_50)
        except mujoco.FatalError as error:
            gl.free()
            raise RenderError(f"{backend} opens, but renders nothing ({error}). Remedy: {REMEDY}") from error
        try:
            mujoco.mjr_resizeOffscreen(self._width, self._height, self._context)
        except mujoco.FatalError as error:
            self._context.free()
            gl.free()
            size = f"{self._height}x{self._width}"
            raise RenderError(f"OpenGL cannot draw an image of {size} pixels here: {error}") from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(self._model, maxgeom=self._model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = int(self._faithful)
        self._geoms = self._scene.geoms
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = 0
        self._options.geomgroup[1] = 1
        self._options.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._viewport = mujoco.MjrRect(0, 0, self._width, self._height)
        return gl


def _free_abandoned() -> None:
    """Free the contexts of this thread whose renderers are gone."""
    here = os.getpid(), threading.current_thread()
    for entry in [entry for entry in _abandoned if entry[0] == here]:
        _abandoned.remove(entry)
        entry[1].make_current()
        entry[2].free()
        entry[1].free()


_renderers: "weakref.WeakSet[Renderer]" = weakref.WeakSet()  # that have had a context


def _keep_contexts() -> None:
    """Keep the contexts of the parent in a forked process, where freeing them would hang."""
    _unreachable.extend((renderer._gl, renderer._context) for renderer in _renderers)
