"""Workers of vector environments that die, hang or are interrupted: what the others answer is never that of before."""

import itertools
import os
import random
import signal
import threading
import time

import pytest

from libero._adapters.worker import Worker
from libero._adapters.workers import CALL_TIMEOUT, WorkerError
from libero.libero.envs import DummyVectorEnv, SubprocVectorEnv
from libero_env.errors import ClosedEnvironmentError, InvalidInputError

SEED = int(os.environ.get("LIBERO_FUZZ_SEED", "0"))  # other moments of the kills


def echo(number, pause=0.005, size=3):
    """Factory of an environment whose results tell its number, its steps, and its last action.

    The class is in the function so that workers need not import this module.
    """

    def make():
        import time

        import numpy as np

        class Echo:
            steps, value = 0, 0.0

            def reset(self):
                time.sleep(pause)
                self.steps, self.value = 0, 0.0
                return {"all": np.zeros(3)}

            def seed(self, seed):
                time.sleep(pause)
                return [seed]

            def render(self):
                time.sleep(pause)
                return [number, self.steps, self.value]

            def step(self, action):
                if action == -1:
                    raise ValueError("no such action")
                time.sleep(pause)
                self.steps, self.value = self.steps + 1, float(action)
                values = np.resize([number, self.steps, self.value], size)
                return {"all": values}, float(number), False, {}

            def close(self):
                pass

        return Echo()

    return make


def call(env, method, ids, value):
    """What each environment answers, by its number, and the error of those that do not."""
    known = {"seed": [int(value)], "get_env_attr": ["value"], "step": [[value] * len(ids)]}
    arguments = known.get(method, [])
    chosen = {} if method in ("seed", "render") else {"id": ids}
    try:
        answers, error = getattr(env, method)(*arguments, **chosen), None
        answers = dict(zip(ids, zip(*answers[:2], strict=True) if method == "step" else answers, strict=True))
    except WorkerError as failure:
        answers, error = failure.results, failure
    if method == "step":
        answers = {i: (answer[0]["all"].tolist(), float(answer[1])) for i, answer in answers.items()}
    return {i: str(answer) for i, answer in answers.items()}, error


def test_an_error_is_reported_and_its_worker_goes_on():
    env = SubprocVectorEnv([echo(0), echo(1)])
    env.reset()
    with pytest.raises(WorkerError, match="no such action"):
        env.step([-1.0, 1.0])
    assert [one["all"].tolist() for one in env.step([2.0, 2.0])[0]] == [[0.0, 1.0, 2.0], [1.0, 2.0, 2.0]]
    env.close()


@pytest.mark.parametrize("methods", [("seed", "step", "reset"), ("render", "get_env_attr", "step")])
def test_survivors_of_kills_answer_as_in_a_vector_without_kills(methods):
    """Workers are killed one after the other at random moments; a twin in this process makes the calls of the rest."""
    rng, count = random.Random(SEED), len(methods) + 1
    factories = [echo(i) for i in range(count)]
    env = SubprocVectorEnv(factories, call_timeout=60)
    twin, alive, value = DummyVectorEnv(factories), list(range(count)), 0.0
    env.reset(), twin.reset()
    for method, victim in zip(methods, rng.sample(alive, len(methods)), strict=True):
        threading.Timer(rng.uniform(0.0, 0.02), env.workers[victim].process.kill).start()
        error = None
        while error is None:
            value += 1.0
            answers, error = call(env, method, alive, value)
            if error is None:
                assert answers == call(twin, method, alive, value)[0]
        alive.remove(victim)
        assert list(error.failed) == [victim] and f"environment {victim}: " in str(error)
        assert f"id={alive}" in str(error) and ("Nothing was done" in str(error)) == (not answers)
        if answers:  # of the others, which have done it
            ids = range(count) if method in ("seed", "render") else alive
            assert answers == {i: a for i, a in call(twin, method, ids, value)[0].items() if i in alive}
        for _ in range(3):
            value += 1.0
            answers, error = call(env, "step", alive, value)
            assert error is None and answers == call(twin, "step", alive, value)[0]
    with pytest.raises(WorkerError, match=rf"environment {victim}: .*exit code -9"):
        env.step([0.0] * 2, id=[victim, *alive])
    env.close()


def interrupt_answer(monkeypatch, number: int) -> None:
    """Press Ctrl-C while an answer is waited for: the first one for 0."""
    answer, count = Worker.answer, itertools.count()

    def interrupted(*args):
        if next(count) == number:
            raise KeyboardInterrupt
        return answer(*args)

    monkeypatch.setattr(Worker, "answer", interrupted)


def test_a_call_that_is_given_up_has_no_answer_later(monkeypatch):
    env = SubprocVectorEnv([echo(i) for i in range(3)])
    env.reset()
    with pytest.raises(InvalidInputError, match="cannot be sent to a worker process"):
        env.step([1.0, lambda: None, 1.0])  # environment 0 has its action
    assert [one["all"][2] for one in env.step([9.0, 9.0], id=[0, 2])[0]] == [9.0, 9.0]
    for interrupted in range(3):
        interrupt_answer(monkeypatch, interrupted)
        with pytest.raises(KeyboardInterrupt):
            env.step([5.0] * 3)
        monkeypatch.undo()
        assert [one["all"][2] for one in env.step([6.0] * 3)[0]] == [6.0] * 3
    assert [one["all"][2] for one in env.step([10.0] * 3)[0]] == [10.0] * 3
    env.close()


def test_a_worker_that_stops_within_an_answer_is_ended(monkeypatch):
    """Its answer has begun, so that a plain read would wait for the rest without limit."""
    monkeypatch.setattr("libero._adapters.worker._PIPE_TIMEOUT", 1.0)
    monkeypatch.setattr("libero._adapters.worker._JOIN_TIMEOUT", 0.2)
    env = SubprocVectorEnv([echo(0, size=1_000_000), echo(1)], call_timeout=30)
    env.reset()
    stopped = env.workers[0]
    stopped.start("step", 1.0)
    while not stopped.parent_remote.poll():
        time.sleep(0.01)
    time.sleep(0.1)
    os.kill(stopped.process.pid, signal.SIGSTOP)
    with pytest.raises(WorkerError, match="in step: it stopped within an answer"):
        stopped.recv()
    assert env.step([3.0], id=1)[0][0]["all"].tolist() == [1.0, 1.0, 3.0]
    env.close()
    assert not stopped.process.is_alive()


def test_waits_have_a_limit_by_default_and_hung_workers_are_named_together():
    env = SubprocVectorEnv([echo(i) for i in range(3)])
    assert [worker._timeout for worker in env.workers] == [CALL_TIMEOUT] * 3
    env.reset()
    for worker in env.workers[:2]:
        os.kill(worker.process.pid, signal.SIGSTOP)
        worker._timeout = 0.5
    with pytest.raises(WorkerError, match="no answer within 0.5 s, since .* raise call_timeout=") as caught:
        env.step([1.0] * 3)
    assert list(caught.value.failed) == [0, 1] and list(caught.value.results) == [2]
    env.close()


@pytest.mark.parametrize("make", [SubprocVectorEnv, DummyVectorEnv])
def test_after_close_every_call_says_so(make):
    env = make([echo(0)])
    env.reset()
    env.close()
    env.close()
    calls = [env.reset, lambda: env.step([1.0]), lambda: env.get_env_attr("value"), env.check_success]
    for use in [*calls, env.workers[0].reset, lambda: env.action_space]:
        with pytest.raises(ClosedEnvironmentError, match="closed"):
            use()


def test_arguments_are_checked_before_a_process_starts():
    for limit in (0, -1, "x", float("nan"), True):
        with pytest.raises(InvalidInputError, match="call_timeout"):
            SubprocVectorEnv([echo(0)], call_timeout=limit)
    for factories in ([], [3], [None]):
        with pytest.raises(InvalidInputError, match="env_fns"):
            SubprocVectorEnv(factories)
    env = DummyVectorEnv([echo(0)] * 2)
    env.reset()
    for chosen in (2, -3, [0, 0], 0.5, "a", [[0]], [True]):
        with pytest.raises(InvalidInputError, match="id="):
            env.reset(id=chosen)
    for actions in ([1.0], 3, [1.0] * 3, None):
        with pytest.raises(InvalidInputError, match="for 2 environments"):
            env.step(actions)
    env.close()
