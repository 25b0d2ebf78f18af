"""Environments in worker processes: the same results, and recovery when a worker fails."""

import multiprocessing as mp
import os
import time

import numpy as np
import pytest

from libero_env.envs.env import LiberoEnv
from libero_env.envs.subproc import SubprocEnv, WorkerError
from libero_env.errors import ActionError, LiberoError


def counter(fault="", at=3, size=2):
    """Factory of an environment that counts its steps and fails at one of them."""

    def make():
        import gymnasium
        import numpy as np
        from gymnasium import spaces

        class Counter(gymnasium.Env):
            observation_space = spaces.Dict(
                {
                    "count": spaces.Box(0, 1e6, (), np.float64),
                    "own": spaces.Box(-1e6, 1e6, (size,), np.float64),
                }
            )
            action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
            count = 0

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                self.count = 0
                return self.observe(), {"seed": seed}

            def step(self, action):
                self.count += 1
                if self.count == at and fault == "raise":
                    raise ValueError("a step too far")
                if self.count == at and fault == "die":
                    os._exit(3)
                if self.count == at and fault == "hang":
                    time.sleep(600)
                return self.observe(), float(action.sum()), self.count >= 6, False, {}

            def observe(self):
                seen = {"count": np.array(float(self.count)), "own": np.full(size, float(self.count))}
                return seen if fault != "lack" or self.count < at else {"count": seen["count"]}

            def pid(self):
                return os.getpid()

        return Counter()

    return make


@pytest.fixture
def envs():
    made = []
    yield lambda *args, **kwargs: made.append(SubprocEnv(*args, **kwargs)) or made[-1]
    for env in made:
        env.close()


@pytest.mark.sim
def test_workers_give_the_results_of_single_environments(envs):
    kwargs = {"camera_size": (16, 24), "horizon": 4, "perturb": "robot=0.3,gain=0.5@step2"}
    tasks = ["libero_object/0", "libero_object/3"]
    both = envs([{"task": task, **kwargs} for task in tasks])
    singles = [LiberoEnv(task, **kwargs) for task in tasks]
    for how in ({"seed": 5}, {"options": {"init_state": [1, 2]}}):
        seen, _ = both.reset(**how)
        assert both.observation_space.contains(seen)
        commands = np.random.default_rng(0).uniform(-1, 1, (4, 2, 7))
        expected = [
            env.reset(seed=5 + i) if "seed" in how else env.reset(options={"init_state": i + 1})
            for i, env in enumerate(singles)
        ]
        for key in seen:
            np.testing.assert_array_equal(seen[key], [observation[key] for observation, _ in expected])
        for command in commands:
            seen, rewards, terminated, truncated, info = both.step(command)
            for i, env in enumerate(singles):
                observation, *rest, own = env.step(command[i])
                assert rest == [rewards[i], terminated[i], truncated[i]]
                assert {*info} == {*own}
                for key, told in own.items():
                    np.testing.assert_array_equal(info[key][i], told, err_msg=key)
                for key in seen:
                    np.testing.assert_array_equal(seen[key][i], observation[key])
        np.testing.assert_array_equal(both.get_state(1), singles[1].get_state())
        assert not both.running.any()
    for env in singles:
        env.close()


def test_finished_environments_do_not_move_until_reset(envs):
    env = envs([counter(), counter()])
    env.reset()
    for _ in range(3):
        env.step(np.zeros((2, 2)))
    seen, _ = env.reset(options={"reset_mask": [True, False]})
    assert seen["count"].tolist() == [0, 3]
    for _ in range(4):
        seen, rewards, terminated, _, _ = env.step(np.ones((2, 2)))
    assert seen["count"].tolist() == [4, 6] and rewards.tolist() == [2, 0]
    assert env.running.tolist() == [True, False] and not terminated.any()
    with pytest.raises(ActionError):
        env.step(np.full((2, 2), np.nan))
    with pytest.raises(LiberoError, match="reset_mask"):
        env.reset(options={"reset_mask": [True]})


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("die", "exit code 3"),
        ("hang", "no answer within 1 s"),
        ("raise", "a step too far"),
        ("lack", "its observation has no own, which its observation_space has; it has count"),
    ],
)
def test_the_others_continue_when_a_worker_fails(envs, fault, says):
    env = envs([counter(), counter(fault), counter()])
    env.reset()
    env.step(np.zeros((3, 2)))
    env.step(np.zeros((3, 2)))
    env.timeout = 1.0 if fault == "hang" else 60.0
    with pytest.raises(WorkerError, match=says) as caught:
        env.step(np.ones((3, 2)))
    assert "worker 1 (make)" in str(caught.value) and "True at [1] in options={'reset_mask'" in str(
        caught.value
    )
    seen, rewards, _, truncated, _ = caught.value.outcome
    assert list(caught.value.failed) == [1]
    assert seen["count"].tolist() == [3, 0, 3] and rewards.tolist() == [2, 0, 2]
    assert truncated.tolist() == [False, True, False]
    seen, *_ = env.step(np.zeros((3, 2)))
    assert seen["count"].tolist() == [4, 0, 4]
    env.timeout = 60.0
    seen, _ = env.reset(options={"reset_mask": caught.value.outcome[3]})
    assert seen["count"].tolist() == [4, 0, 4]
    assert env.step(np.zeros((3, 2)))[0]["count"].tolist() == [5, 1, 5]


def test_a_worker_killed_from_outside_is_replaced(envs):
    env = envs([counter(), counter()])
    env.reset()
    first = env.call("pid")
    os.kill(first[0], 9)
    with pytest.raises(WorkerError, match="exit code -9"):
        env.step(np.zeros((2, 2)))
    env.reset()
    second = env.call("pid")
    assert second[0] != first[0] and second[1] == first[1]
    assert env.call("count", indices=[1]) == [0]


def test_entries_of_different_shapes_are_in_the_info(envs):
    env = envs([counter(size=2), counter(size=3)])
    seen, info = env.reset()
    assert list(seen) == ["count"] and env.observation_space.contains(seen)
    assert [own["own"].shape for own in info["own"]] == [(2,), (3,)]


def test_environments_that_cannot_be_made_are_errors():
    def broken():
        raise RuntimeError("no such thing")

    before = set(mp.active_children())
    with pytest.raises(WorkerError, match="no such thing"):
        SubprocEnv([counter(), broken])
    with pytest.raises(LiberoError, match="'task'"):
        SubprocEnv([{"suite": "libero_object"}])
    assert set(mp.active_children()) <= before


def test_no_process_is_left():
    processes = set(mp.active_children())
    env = SubprocEnv([counter(), counter("hang", at=1)], timeout=1.0)
    env.reset()
    with pytest.raises(WorkerError):
        env.step(np.zeros((2, 2)))
    env.close()
    env.close()
    assert set(mp.active_children()) <= processes
    forgotten = SubprocEnv([counter()])
    forgotten.reset()
    del forgotten
    assert set(mp.active_children()) <= processes
