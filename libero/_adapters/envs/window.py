"""The window of `has_renderer=True`."""

import os
import sys
import warnings
from typing import Any

import mujoco


class Window:
    """MuJoCo's viewer of a simulation, opened at the first `show`.

    Without a screen, `show` warns once and does nothing, so a script with `has_renderer=True` also runs on a server.

    Args:
        camera: Camera of the first view.
    """

    def __init__(self, camera: str):
        self.camera = camera
        self._viewer: Any = None
        self._tried = False

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Show the present state; a window that the user closed stays closed."""
        if self._viewer is None and not self._tried:
            self._viewer = self._opened(model, data)
        if self._viewer is not None and self._viewer.is_running():
            self._viewer.sync()

    def close(self) -> None:
        """Close the window. Idempotent."""
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None

    def _opened(self, model: mujoco.MjModel, data: mujoco.MjData) -> Any:
        self._tried = True
        if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
            message = "has_renderer=True: there is no screen; use camera observations or sim.render"
            warnings.warn(message, stacklevel=4)
            return None
        from mujoco import viewer  # it loads a GL library

        window = viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        window.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
        window.cam.fixedcamid = model.camera(self.camera).id
        return window
