"""Windows and terminals of a teleoperation session: input goes to the device, images go to the user."""

import importlib
import os
import select
import shutil
import sys
import time
from typing import Any

import numpy as np
from PIL import Image

from libero_env.envs.batch import BatchEnv
from libero_env.envs.env import require_display
from libero_env.errors import LiberoError, RenderError, require_known
from libero_env.mujoco_compat import mujoco
from libero_env.objects.model import GLOW_GROUP
from libero_env.sim.predicates import glowing_sites
from libero_env.teleop.session import (
    GRIPPER,
    HELP,
    MOTIONS,
    QUIT,
    RESET,
    Keyboard,
    Screen,
    SpaceMouse,
    Status,
)
from libero_env.timing import CONTROL_HZ

SCREENS = ("auto", "window", "terminal")
_ESCAPE = "\x1b"
_ESCAPE_KEY = 256  # number of the key in GLFW
_MAX_GEOMS = 2000  # geoms that the window can show
_STEPS_PER_IMAGE = 4  # [control steps] between two images in a terminal


def open_screen(kind: str, keyboard: Keyboard, camera: str = "agentview") -> Screen:
    """Open a window, or use the terminal if no window can be opened.

    Args:
        kind: `window`, `terminal`, or `auto` for the first of them that works.
        keyboard: Device that receives the keys.
        camera: Camera whose image is shown.

    Raises:
        RenderError: No screen of this kind works here; the message states why.
    """
    problems = []
    for name, screen in (("window", Window), ("terminal", Terminal)):
        if kind in ("auto", name):
            try:
                return screen(keyboard, camera)
            except RenderError as error:
                problems.append(str(error))
    raise RenderError("; ".join(problems) or f"screen {kind!r}; valid: {', '.join(SCREENS)}")


class MouseReader(SpaceMouse):
    """A 3D mouse that is read through the package hidapi.

    Args:
        sensitivity: Factors on translations and rotations, as of `SpaceMouse`.
        vendor_id: USB vendor of the mouse.
        product_id: USB product of the mouse.

    Raises:
        LiberoError: hidapi is not installed, or the mouse cannot be opened.
    """

    def __init__(self, *sensitivity: float, vendor_id: int = 9583, product_id: int = 50741):
        super().__init__(*sensitivity)
        try:
            hid: Any = importlib.import_module("hid")
        except ImportError as error:
            raise LiberoError("a 3D mouse is read with hidapi: pip install hidapi") from error
        self.device = hid.device()
        try:
            self.device.open(vendor_id, product_id)
        except OSError as error:
            raise LiberoError(
                f"the 3D mouse {vendor_id}:{product_id} cannot be opened ({error}); choose another with --vendor-id "
                "and --product-id, and check that you have permission to read it"
            ) from error
        self.device.set_nonblocking(True)

    def poll(self) -> None:
        """Handle all pending reports."""
        while data := self.device.read(13):
            self.report(bytes(data))


class _Timed(Screen):
    """What screens share: the keys, and a control step that lasts as long as on the robot."""

    def __init__(self, keyboard: Keyboard, camera: str):
        self.keyboard, self.camera = keyboard, camera
        self._next = time.monotonic()

    def _wait(self) -> None:
        self._next = max(self._next + 1.0 / CONTROL_HZ, time.monotonic())
        time.sleep(max(self._next - time.monotonic(), 0.0))


class Window(_Timed):
    """A GLFW window into which MuJoCo renders.

    Args:
        keyboard: Device that receives the keys.
        camera: Camera whose image is shown.
        size: Width and height of the window, pixels.

    Raises:
        RenderError: No window can be opened here.
    """

    def __init__(self, keyboard: Keyboard, camera: str, size: int = 640):
        require_display()
        try:
            self.glfw: Any = importlib.import_module("glfw")
        except ImportError as error:
            raise RenderError(f"no window: {error}; pip install glfw") from error
        if not self.glfw.init():
            raise RenderError("no window: GLFW found no screen")
        self.window = self.glfw.create_window(size, size, "libero teleop", None, None)
        if not self.window:
            self.glfw.terminate()
            raise RenderError("no window: GLFW cannot open a window with OpenGL")
        super().__init__(keyboard, camera)
        self.glfw.set_key_callback(self.window, self._on_key)
        self.context: mujoco.MjrContext | None = None

    def poll(self, env: BatchEnv) -> None:
        """See `Screen`."""
        self.glfw.poll_events()
        if self.glfw.window_should_close(self.window):
            self.keyboard.press(QUIT)

    def show(self, env: BatchEnv, status: Status) -> None:
        """See `Screen`."""
        model, data = env.simulations.model, env.simulations.data(0)
        self.glfw.make_context_current(self.window)
        if self.context is None:
            self.context = self._make_context(model)
        area = mujoco.MjrRect(0, 0, *self.glfw.get_framebuffer_size(self.window))
        mujoco.mj_camlight(model, data)
        self.option.sitegroup[GLOW_GROUP] = bool(glowing_sites(env.views[0]))  # glows while a stove is on
        mujoco.mjv_updateScene(
            model, data, self.option, None, self.view, mujoco.mjtCatBit.mjCAT_ALL, self.scene
        )
        mujoco.mjr_render(area, self.scene, self.context)
        corner = mujoco.mjtGridPos.mjGRID_BOTTOMLEFT
        mujoco.mjr_overlay(
            mujoco.mjtFont.mjFONT_NORMAL, corner, area, str(status).replace(" | ", "\n"), "", self.context
        )
        self.glfw.swap_buffers(self.window)
        self._wait()

    def _make_context(self, model: mujoco.MjModel) -> mujoco.MjrContext:
        self.scene, self.option = mujoco.MjvScene(model, _MAX_GEOMS), mujoco.MjvOption()
        self.option.geomgroup[0] = 0  # collision shapes are hidden
        self.view = mujoco.MjvCamera()
        self.view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        cameras = [model.camera(i).name for i in range(model.ncam)]
        require_known("camera", self.camera, cameras)
        self.view.fixedcamid = cameras.index(self.camera)
        return mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)

    def close(self) -> None:
        """Close the window."""
        if self.context is not None:
            self.glfw.make_context_current(self.window)
            self.context.free()
            self.context = None
        self.glfw.terminate()

    def _on_key(self, _: Any, code: int, scancode: int, action: int, mods: int) -> None:
        if (key := key_name(code)) is None:
            return
        if action == self.glfw.PRESS:
            self.keyboard.press(key, held=True)
        elif action == self.glfw.RELEASE:
            self.keyboard.release(key)


def key_name(code: int) -> str | None:
    """Return the name of a key in `Keyboard` from its number in GLFW; None for a key without a function."""
    if code == _ESCAPE_KEY:
        return QUIT
    name = chr(code).lower() if 0 <= code < 128 else ""
    return name if name in MOTIONS or name in (GRIPPER, RESET) else None


class Terminal(_Timed):
    """Reads keys from a terminal and shows images as coloured characters, for machines without a screen.

    Args:
        keyboard: Device that receives the keys.
        camera: Camera whose image is shown.

    Raises:
        RenderError: Standard input is not a terminal.
    """

    def __init__(self, keyboard: Keyboard, camera: str):
        if not sys.stdin.isatty():
            raise RenderError("no terminal: standard input is not one")
        try:
            self.termios: Any = importlib.import_module("termios")
            tty: Any = importlib.import_module("tty")
        except ImportError as error:
            raise RenderError(f"no terminal: {error}") from error
        self.settings = self.termios.tcgetattr(sys.stdin)
        tty.setcbreak(sys.stdin)
        super().__init__(keyboard, camera)
        print(f"\x1b[2J{HELP}")

    def poll(self, env: BatchEnv) -> None:
        """See `Screen`."""
        while select.select([sys.stdin], [], [], 0.0)[0]:
            press_typed(self.keyboard, os.read(sys.stdin.fileno(), 64).decode(errors="ignore"))

    def show(self, env: BatchEnv, status: Status) -> None:
        """See `Screen`; every fourth state is shown."""
        if status.step % _STEPS_PER_IMAGE == 1:
            columns, lines = shutil.get_terminal_size()
            edge = max(min(columns, 2 * (lines - 6)) // 2 * 2, 8)
            image = Image.fromarray(env.observer.render(0, self.camera)).resize((edge, edge))
            print(f"\x1b[4;1H{as_text(np.asarray(image))}\n\x1b[K{status}", flush=True)
        self._wait()

    def close(self) -> None:
        """Restore the settings of the terminal."""
        self.termios.tcsetattr(sys.stdin, self.termios.TCSADRAIN, self.settings)


def press_typed(keyboard: Keyboard, typed: str) -> None:
    """Press the keys that a terminal has sent as characters.

    The escape key alone stops the session; escape sequences, such as those of arrow keys, have no effect.
    """
    if typed == _ESCAPE:
        keyboard.press(QUIT)
    elif not typed.startswith(_ESCAPE):
        for key in typed:
            keyboard.press(key)


def as_text(image: np.ndarray) -> str:
    """Return an image (H, W, 3), H even, as lines of half blocks in 24-bit colour."""
    lines = []
    for upper, lower in zip(image[::2].tolist(), image[1::2].tolist(), strict=True):
        pairs = zip(upper, lower, strict=True)
        cells = ["\x1b[38;2;{};{};{}m\x1b[48;2;{};{};{}m▀".format(*above, *below) for above, below in pairs]
        lines.append("".join(cells) + "\x1b[0m")
    return "\n".join(lines)
