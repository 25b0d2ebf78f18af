"""Edges of the facade's environments: closed ones, states and arguments that are none."""

import copy

import numpy as np
import pytest

from libero.libero.envs import ControlEnv
from libero_env.errors import ActionError, ClosedEnvironmentError, InvalidInputError

pytestmark = pytest.mark.sim


def test_refused_calls_change_nothing_and_closed_environments_say_so(suite):
    options = {"bddl_file_name": suite.get_task_bddl_file_path(0), "use_camera_obs": False}
    for horizon in (0, -5, "a", None, True, 1j, float("nan")):
        with pytest.raises(InvalidInputError, match="horizon is"):
            ControlEnv(**options, horizon=horizon)
    env = ControlEnv(**options, horizon=np.inf)  # as robosuite takes it
    env.seed(0)
    env.reset()
    state = env.get_sim_state()
    for bad in (state * np.nan, state[:-1], "a", None, state * 1j, state + 1e12, [[1], [2, 3]]):
        for use in (env.set_state, env.set_init_state):
            with pytest.raises(InvalidInputError, match="a state of"):
                use(bad)
    for bad in (np.zeros(7) * 1j, ["1"] * 7, None, np.zeros(8), np.full(7, np.nan)):
        with pytest.raises(ActionError):
            env.step(bad)
    np.testing.assert_array_equal(env.get_sim_state(), state)
    env.step([0, 0, 0, 1e-170, 0, 0, 0])
    with pytest.raises(InvalidInputError, match="cannot be copied"):
        copy.deepcopy(env)
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(np.zeros(7)), lambda: env.set_init_state(state), env.env.render):
        with pytest.raises(ClosedEnvironmentError, match="closed; make another"):
            use()
