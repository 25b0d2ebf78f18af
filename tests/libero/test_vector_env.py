"""Vector environments in this process and in others."""

import os
import subprocess
import sys
from pathlib import Path

import cloudpickle
import gymnasium
import numpy as np
import pytest

from libero.libero.envs import DummyVectorEnv, OffScreenRenderEnv, SubprocVectorEnv
from libero.libero.envs.venv import CloudpickleWrapper

pytestmark = pytest.mark.sim
cloudpickle.register_pickle_by_value(sys.modules[__name__])  # workers import what they use of it alone


def test_subprocesses_give_the_results_of_one_process(suite):
    args = {"bddl_file_name": suite.get_task_bddl_file_path(0), "camera_heights": 32, "camera_widths": 32}
    rows = suite.get_task_init_states(0)[:2]
    results = []
    for make in (DummyVectorEnv, SubprocVectorEnv):
        env = make([lambda: OffScreenRenderEnv(**args) for _ in range(2)])
        assert len(env) == 2
        env.seed(5)
        env.reset()
        env.set_init_state(rows)
        for _ in range(3):
            obs, reward, done, info = env.step(np.full((2, 7), 0.1))
        assert [i["env_id"] for i in info] == [0, 1]
        assert not done.any()
        assert env.check_success() == [False, False]
        assert env.get_env_attr("problem_name") == ["libero_floor_manipulation"] * 2
        env.set_env_attr("horizon", 7, id=1)
        results.append((np.array(env.get_sim_state()), np.array([o["agentview_image"] for o in obs])))
        one = env.step(np.zeros((1, 7)), id=[1])[0]
        assert one.shape == (1,)
        env.close()
    for one, many in zip(*results, strict=True):
        assert (one == many).all()


class Wrapped(gymnasium.Env):
    """An environment of Gymnasium's interface, as QueST has it around one of the original's."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
    observation_space = gymnasium.spaces.Dict({"pos": gymnasium.spaces.Box(-np.inf, np.inf, (3,))})

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.first = seed
        return {"pos": np.zeros(3)}, {"first": seed}

    def step(self, action):
        return {"pos": action[:3]}, 0.0, False, False, {}

    def set_init_state(self, state):
        self.state = state

    def render(self):
        return np.zeros((2, 2, 3), np.uint8)


class Stacked(gymnasium.Wrapper):
    def set_init_state(self, state):
        return self.env.set_init_state(state)


@pytest.mark.parametrize("make", [DummyVectorEnv, SubprocVectorEnv])
def test_environments_of_gymnasiums_interface_are_carried(make):
    env = make([lambda: Stacked(Wrapped())] * 2)
    space = gymnasium.vector.utils.batch_space(env.action_space[0], 2)
    assert env.observation_space[1] == Wrapped.observation_space
    obs, info = env.reset()
    assert obs.shape == (2,)
    assert info == [{"first": None}] * 2
    assert env.set_init_state(np.eye(2)).tolist() == [None, None]
    assert [state.tolist() for state in env.get_env_attr("state")] == [[1.0, 0.0], [0.0, 1.0]]
    obs, reward, terminated, truncated, info = env.step(np.ones(space.shape))
    assert [o["pos"].tolist() for o in obs] == [[1.0] * 3] * 2
    assert (reward.shape, terminated.tolist(), truncated.tolist()) == ((2,), [False] * 2, [False] * 2)
    assert [i["env_id"] for i in info] == [0, 1]
    assert env.seed([3, 4]) == [[3], [4]]
    assert env.get_env_attr("first") == [3, 4]
    env.set_env_attr("mark", 5)
    assert env.get_env_attr("mark") == [5, 5]
    assert env.render()[0].shape == (2, 2, 3)
    with pytest.raises(AttributeError, match="get_env_attr"):
        env.nothing  # noqa: B018 - the access is what raises
    env.close()


def test_factories_can_be_sent():
    import pickle

    assert pickle.loads(pickle.dumps(CloudpickleWrapper(lambda: 3))).data() == 3  # noqa: S301 - our own


REGISTERED = """
import sys
from pathlib import Path

import numpy as np

from libero.libero.envs import DummyVectorEnv, OffScreenRenderEnv, SubprocVectorEnv, TASK_MAPPING, register_problem
from libero.libero.envs.base_object import OBJECTS_DICT, MujocoXMLObject
from libero.libero.envs.predicates import VALIDATE_PREDICATE_FN_DICT, UnaryAtomic, update_predicate_fn_dict
from libero_env import LiberoEnv, register_predicate
from libero_env.parallel import run_each
from libero_env.tasks import get_task

folder = Path(sys.argv[1])

@register_problem
class Libero_Floor_Manipulation(TASK_MAPPING["libero_floor_manipulation"]):
    def reward(self, action=None):
        return 5.0

class Upright(UnaryAtomic):
    def __call__(self, state):
        return True  # at the start, too, as in the original

class Can(MujocoXMLObject):
    def __init__(self, name="can"):
        super().__init__(folder / "can.xml", name)

def atspeed(state, speed, word):
    return (speed, word) == ("0.5", "slow")

update_predicate_fn_dict("upright", Upright)
VALIDATE_PREDICATE_FN_DICT["atspeed"] = atspeed
OBJECTS_DICT["red_can"] = lambda name: Can(name)
register_predicate("always", lambda view, name: view.scene.objects[name].category == "red_can")

def write(name, goal, init=""):
    text = get_task("libero_object/0").bddl_text.replace("milk_1 - milk", "milk_1 - red_can")
    text = text.replace("(:init", f"(:init {init}")
    (folder / name).write_text(text[: text.index("(:goal")] + f"(:goal {goal}))")
    return str(folder / name)

GOAL = "(And (Upright milk_1) (Not (Not (Upright milk_1))) (Atspeed milk_1 0.5 slow))"
INIT = "(Atspeed milk_1 9 fast)"  # for the problem class to read; a reset does not look at it
make = lambda: OffScreenRenderEnv(bddl_file_name=write("own.bddl", GOAL, INIT), use_camera_obs=False)

def category(name):
    from libero_env.objects import get_object
    return get_object(name).category

if __name__ == "__main__":
    (folder / "can.xml").write_text(
        "<mujoco><worldbody><body><geom type='cylinder' size='.02 .03' mass='.1'/></body></worldbody></mujoco>"
    )
    for kind in (DummyVectorEnv, SubprocVectorEnv):
        envs = kind([make])
        envs.seed(0), envs.reset()
        print(*envs.step(np.zeros((1, 7)))[1:3], envs.check_success())
        envs.close()
    task = write("always.bddl", "(Not (Always milk_1))")
    env = LiberoEnv(Path(task), cameras=())
    env.reset(seed=0), env.step(np.zeros(7))
    print(env.task.name, dict(run_each(category, [("red_can",), ("milk",)], 2)))
    env.close()
    VALIDATE_PREDICATE_FN_DICT["broken"] = lambda state, lock=__import__("threading").Lock(): True
    SubprocVectorEnv([make])
"""


def test_what_a_script_registers_is_the_same_in_every_worker(tmp_path):
    (tmp_path / "script.py").write_text(REGISTERED)
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, str(tmp_path / "script.py"), str(tmp_path)]
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    here, there, native = done.stdout.splitlines()[:3]
    assert here == there == "[5.] [ True] [True]", done.stderr
    assert native in ("always {0: 'red_can', 1: 'milk'}", "always {1: 'milk', 0: 'red_can'}")
    assert "'Broken', which was added to PREDICATES, cannot be sent" in done.stderr.splitlines()[-1]
