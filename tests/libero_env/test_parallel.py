"""Pools of processes that hang."""

import time

import pytest

from libero_env.parallel import SilentWorkersError, as_finished, spawn_pool

pytestmark = pytest.mark.unit


def test_a_pool_that_finishes_nothing_is_ended():
    with (
        pytest.raises(SilentWorkersError, match="no worker process has finished anything"),
        spawn_pool(1) as pool,
    ):
        assert [future.result() for future in as_finished([pool.submit(abs, -3)])] == [3]
        hung = pool.submit(time.sleep, 600.0)
        list(as_finished([hung], silence=0.3))
