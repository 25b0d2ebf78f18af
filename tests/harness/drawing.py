"""A worker's first picture, with a driver that hangs or one that draws."""

import time

import numpy as np
import pytest

from libero_env.mujoco_compat import mujoco
from libero_env.sim.render import Renderer, RenderTarget


def draw(hangs: bool) -> int:
    """Draw a picture with a driver that hangs, or does not; return the number of bright pixels."""
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><light pos='0 0 2'/><geom type='plane' size='1 1 1' group='1'/>"
        "<camera name='above' pos='0 0 2'/></worldbody></mujoco>"
    )
    data, picture = mujoco.MjData(model), np.zeros((8, 8, 3), np.uint8)
    mujoco.mj_forward(model, data)
    with pytest.MonkeyPatch.context() as patch, Renderer(model, 8, 8) as renderer:
        if hangs:
            patch.setattr(mujoco, "mjr_readPixels", lambda *_: time.sleep(600))
        renderer.render(data, [RenderTarget(0, picture)])
    return int((picture > 0).sum())
