"""One simulation that is observed where the original observes it."""

from collections.abc import Callable

import mujoco
import numpy as np

from libero_env.control import SUBSTEPS
from libero_env.simulation import LoopSimulations


class ObservedSimulations(LoopSimulations):
    """A simulation whose tap is called one substep before the end, and in whose model clients may move fixtures."""

    def read_fixtures(self) -> None:
        """Take the fixtures' poses from the model."""
        bodies = self.fixture_bodies
        self.fixtures[0] = np.concatenate([self.model.body_pos[bodies], self.model.body_quat[bodies]], axis=1)

    def _substeps(
        self, ids: np.ndarray, actions: np.ndarray, tap: Callable[[mujoco.MjData], None] | None
    ) -> None:
        model, c, constants = self.model, self.controller, self._constants()
        data, (inputs, ctrl) = self._datas[0], self._calls[0]
        for substep in range(SUBSTEPS):
            c.kind.kernel(ids, actions, *inputs, *c.arrays, ctrl, *constants)
            mujoco.mj_step2(model, data)
            if tap is not None and substep == SUBSTEPS - 2:
                tap(data)
            mujoco.mj_step1(model, data)
