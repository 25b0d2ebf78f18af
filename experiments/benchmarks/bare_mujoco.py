"""The limit that the environments are measured against: MuJoCo alone on the same model and states."""

import time
from collections.abc import Callable

import mujoco
import numpy as np

from libero_env.envs.env import LiberoEnv
from libero_env.sim.render import open_context
from libero_env.timing import SUBSTEPS


def best(function: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


class BareMujoco:
    """MuJoCo alone on the model of an environment: no controller, no observations, no copies."""

    def __init__(self, env: LiberoEnv):
        self.model, size = env.scene.model, env.config.camera_size
        self.data = mujoco.MjData(self.model)
        self.cameras = [self.model.camera(name).id for name in env.config.cameras]
        _, self.gl = open_context(*size)
        self.gl.make_current()
        self.context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_resizeOffscreen(*size, self.context)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.context)
        self.viewport, self.pixels = mujoco.MjrRect(0, 0, *size), np.empty((*size, 3), np.uint8)
        self.options = mujoco.MjvOption()
        self.options.geomgroup[:], self.options.sitegroup[:] = [0, 1, 0, 0, 0, 0], 0
        self.scenes = [mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 100) for _ in self.cameras]
        for scene in self.scenes:
            scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0

    def step(self, env: LiberoEnv) -> float:
        """Seconds of as many steps as a control step has, from the state that `env` is in."""
        data, model = env.simulations.data(0), env.simulations.model
        self.data.qpos[:], self.data.qvel[:], self.data.ctrl[:] = data.qpos, data.qvel, data.ctrl
        self.data.qacc_warmstart[:] = data.qacc_warmstart
        mujoco.mj_forward(model, self.data)
        begin = time.perf_counter()
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, self.data)
        return time.perf_counter() - begin

    def draw(self, env: LiberoEnv) -> tuple[float, float]:
        """Seconds of drawing all cameras of the state that `env` is in: as such, and with the pixels read."""
        model, camera = env.simulations.model, mujoco.MjvCamera()
        self.data.qpos[:] = env.simulations.data(0).qpos
        mujoco.mj_forward(model, self.data)
        camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        for scene, camera.fixedcamid in zip(self.scenes, self.cameras, strict=True):
            mujoco.mjv_updateScene(
                model, self.data, self.options, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene
            )
        self.gl.make_current()
        self._render(read=True)
        return best(lambda: self._render(read=False), 2), best(lambda: self._render(read=True), 2)

    def close(self) -> None:
        """Free the context."""
        self.gl.make_current()
        self.context.free()
        self.gl.free()

    def _render(self, read: bool) -> None:
        for scene in self.scenes:
            mujoco.mjr_render(self.viewport, scene, self.context)
            if read:
                mujoco.mjr_readPixels(self.pixels, None, self.viewport, self.context)
            else:
                mujoco.mjr_finish()
