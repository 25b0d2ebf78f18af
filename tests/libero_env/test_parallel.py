"""Pools of processes that hang."""

import pickle
import signal
import subprocess
import sys
import time

import pytest

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.parallel import (
    NO_PICTURE_TEXT,
    SilentWorkersError,
    as_finished,
    run_each,
    spawn_pool,
    tell_work,
)
from tests.harness.drawing import draw


def test_a_pool_that_finishes_nothing_is_ended():
    with (
        pytest.raises(SilentWorkersError, match="no worker process has finished anything"),
        spawn_pool(1) as pool,
    ):
        assert [future.result() for future in as_finished([pool.submit(abs, -3)])] == [3]
        hung = pool.submit(time.sleep, 600.0)
        list(as_finished([hung], silence=0.3))


@pytest.mark.sim
def test_a_pool_whose_first_picture_hangs_is_ended_and_says_why():
    done = []
    with (
        pytest.raises(
            LiberoError, match=r"no first picture: .*mujoco#3444.*--workers 1.*MUJOCO_GL=osmesa.*is kept"
        ),
        spawn_pool(2, picture_seconds=0.01) as pool,
    ):
        futures = [pool.submit(draw, hangs) for hangs in (True, True)]
        done = [future.result() for future in as_finished(futures)]
    assert done == []
    with spawn_pool(1, picture_seconds=100) as pool:
        assert pool.submit(draw, False).result() == 8 * 8 * 3, "the limit ends with the first picture"
        assert pool.submit(_limited).result() is False


def _tell(value: int) -> int:
    for _ in range(value):
        tell_work(0.25)
        tell_work(0.75, 1)
    return value


@pytest.mark.parametrize("workers", [1, 3])
def test_calls_tell_what_is_done_of_them(workers):
    told: list[tuple[float, int]] = []
    results = run_each(_tell, [(k,) for k in (1, 2, 3, 30)], workers, on_work=lambda *what: told.append(what))
    assert sorted(result for _, result in results) == [1, 2, 3, 30]
    assert sum(work for work, _ in told) == sum(done for _, done in told) == 36
    tell_work(1.0)  # to nobody


def _limited() -> bool:
    from libero_env import parallel

    return parallel._picture_limit is not None


def test_a_process_of_joblib_starts_processes():
    """As where a job of a sweep records demonstrations: its own method of starting processes is joblib's."""
    joblib = pytest.importorskip("joblib")
    assert joblib.Parallel(2, backend="loky")(joblib.delayed(_largest)(one) for one in (2, 5)) == [2, 5]


def _largest(value: int) -> int:
    with spawn_pool(1) as pool:
        return pool.submit(max, value, 1).result()


@pytest.mark.sim
def test_a_process_that_nobody_watches_says_so_itself():
    code = (
        "from libero_env.parallel import limit_first_picture; from tests.harness.drawing import draw; "
        "limit_first_picture(0.01, told_here=True); draw(hangs=True)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2 and done.stderr.splitlines() == [f"error: {NO_PICTURE_TEXT}"]


def test_a_signal_while_workers_start_is_heeded_when_they_have(monkeypatch):
    begun = []

    def submit(self, *args):
        signal.raise_signal(signal.SIGINT)
        begun.append(args)

    monkeypatch.setattr("libero_env.parallel.ProcessPoolExecutor.submit", submit)
    # which a shell's background job ignores
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with spawn_pool(1) as pool, pytest.raises(KeyboardInterrupt):
            pool.submit(print, 1)
        assert begun == [(print, 1)] and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, handler)


def test_errors_of_workers_keep_their_words_and_attributes():
    error = UnknownNameError("camera", "frontvew", ["frontview", "agentview"])
    error.path = "here"
    sent = pickle.loads(pickle.dumps(error))
    assert type(sent) is UnknownNameError and str(sent) == str(error) and sent.path == "here"
