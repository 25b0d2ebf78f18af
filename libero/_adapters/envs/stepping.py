"""One simulation for a client that reaches into its model."""

import numpy as np

from libero_env.sim.simulation import LoopSimulations


class ObservedSimulations(LoopSimulations):
    """A simulation in whose model clients may move fixtures."""

    def read_fixtures(self) -> None:
        """Take the fixtures' poses from the model."""
        bodies = self.fixture_bodies
        self.fixtures[0] = np.concatenate([self.model.body_pos[bodies], self.model.body_quat[bodies]], axis=1)
