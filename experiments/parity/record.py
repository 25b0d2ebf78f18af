"""Record wide random motion of the original stack, for `replay.py`.

Runs in an environment of the original (hf-libero, robosuite 1.4.0 or 1.4.1), not in this project's; see README.md.

    python record.py --out FOLDER [--suites libero_goal ...] [--motions reach ...] [--steps 300] [--seed 0]

The hand is driven towards random places by saturated actions: out of reach (`reach`), onto its own shoulder (`fold`),
onto the table and what stands on it (`press`), through large rotations (`spin`), or smoothly through all of it
(`wander`). The gripper opens and closes all the time. Actions are multiples of 1/64, so that a byte holds them exactly.
"""

import argparse
import json
import os
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np

from libero.libero import benchmark, get_libero_path
from libero.libero.envs.env_wrapper import ControlEnv

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_90", "libero_10")
MOTIONS = ("reach", "fold", "press", "spin", "wander")
TOUCHES = ("self", "link7", "table", "objects")  # bits of `touches`
STRIDE = 10  # control steps between two moments of a file


def make_env(suite: str, task_id: int, seed: int) -> ControlEnv:
    """Return an environment without images, reset with a seed."""
    task = benchmark.get_benchmark_dict()[suite]().get_task(task_id)
    bddl = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
    env = ControlEnv(
        bddl_file_name=bddl,
        use_camera_obs=False,
        has_offscreen_renderer=False,
        has_renderer=False,
        ignore_done=True,
    )
    env.seed(seed)
    env.reset()
    return env


def robosuite_version() -> str:
    """Return the version of robosuite; empty where there is none, as with this project's facade."""
    if find_spec("robosuite") is None:
        return ""
    import robosuite

    return robosuite.__version__


def fixture_poses(env: ControlEnv) -> dict[str, list[float]]:
    """Return the pose of each fixture, which the original samples into its model: position, quaternion wxyz."""
    model, poses = env.sim.model, {}
    for name, fixture in env.env.fixtures_dict.items():
        if getattr(fixture, "root_body", None) in model.body_names:
            body = model.body_name2id(fixture.root_body)
            poses[name] = [*model.body_pos[body], *model.body_quat[body]]
    return poses


def start_afresh(env: ControlEnv, state: np.ndarray) -> None:
    """Write a state; the controller holds its pose, the gripper command is neutral, the solver starts cold."""
    env.sim.set_state_from_flattened(state)
    env.sim.forward()
    robot = env.env.robots[0]
    robot.controller.update(force=True)
    robot.controller.reset_goal()
    robot.gripper.current_action = np.zeros(2)
    env.sim.data._data.qacc_warmstart[:] = 0.0


def moment(env: ControlEnv) -> np.ndarray:
    """Return all that the rest of an episode depends on.

    It consists of time, qpos, qvel, the solver's warm start, controls, goal position and orientation, gripper command.
    """
    data, robot = env.sim.data._data, env.env.robots[0]
    state = [[data.time], data.qpos, data.qvel, data.qacc_warmstart, data.ctrl]
    controller = robot.controller
    return np.concatenate(
        [*state, controller.goal_pos, np.ravel(controller.goal_ori), robot.gripper.current_action]
    )


class TouchCounter:
    """Finds out at each physics step what the robot touches.

    Args:
        env: Environment whose physics steps are watched.
    """

    def __init__(self, env: ControlEnv):
        self._model, self._data = env.sim.model._model, env.sim.data._data
        names = [self._model.body(b).name for b in self._model.geom_bodyid]
        self._robot = np.array([n.startswith(("robot0_", "gripper0_")) for n in names])
        self._wrist = np.array([n == "robot0_link7" for n in names])
        self._gripper = np.array([n.startswith("gripper0_") for n in names])
        free = {int(b) for b in self._model.jnt_bodyid[9:]}
        self._moving = np.array([bool(free & set(self._ancestors(b))) for b in self._model.geom_bodyid])
        self.found = 0
        step = env.sim.step
        env.sim.step = lambda *args, **kwargs: (step(*args, **kwargs), self._look())[0]

    def _ancestors(self, body: int) -> list[int]:
        chain = [int(body)]
        while chain[-1]:
            chain.append(int(self._model.body_parentid[chain[-1]]))
        return chain

    def _look(self) -> None:
        for a, b in self._data.contact.geom[: self._data.ncon]:
            if not self._robot[a] and not self._robot[b] or self._gripper[a] and self._gripper[b]:
                continue
            is_self = self._robot[a] and self._robot[b]
            is_object = not is_self and (self._moving[a] or self._moving[b])
            bits = (is_self, self._wrist[a] or self._wrist[b], not is_self and not is_object, is_object)
            self.found |= sum(1 << i for i, bit in enumerate(bits) if bit)

    def take(self) -> int:
        """Return the bits of `TOUCHES` that were found since the last call."""
        found, self.found = self.found, 0
        return found


class Motion:
    """Source of actions of one kind of motion.

    Args:
        kind: One of `MOTIONS`.
        base: Position of the arm's base, (3,), m.
        rng: Random generator.
    """

    def __init__(self, kind: str, base: np.ndarray, rng: np.random.Generator):
        self._kind, self._base, self._rng = kind, base, rng
        self._left, self._gripper_left, self._gripper = 0, 0, -1.0
        self._smooth = np.zeros(6)

    def action(self, hand: np.ndarray) -> np.ndarray:
        """Return the next action, (7,), for the position of the hand, (3,), m."""
        rng = self._rng
        if self._left == 0:
            self._left = int(rng.integers(15, 45))
            self._target = self._base + self._place()
            self._turn = rng.uniform(-1, 1, 3) * (1.0 if self._kind in ("spin", "fold", "press") else 0.3)
            self._turn = np.sign(self._turn) if self._kind == "spin" and rng.random() < 0.5 else self._turn
        if self._gripper_left == 0:
            self._gripper_left, self._gripper = int(rng.integers(8, 40)), -self._gripper
        self._left, self._gripper_left = self._left - 1, self._gripper_left - 1
        self._smooth = 0.9 * self._smooth + 0.45 * rng.standard_normal(6)
        move = np.concatenate([8.0 * (self._target - hand), self._turn])
        if self._kind == "wander":
            move = 0.5 * move + 1.5 * self._smooth
        else:
            move += 0.1 * self._smooth
        return np.append(np.round(np.clip(move, -1, 1) * 64) / 64, self._gripper)

    def _place(self) -> np.ndarray:
        """Return a place relative to the base, (3,), m."""
        rng, angle = self._rng, self._rng.uniform(-2.4, 2.4)
        around = np.array([np.cos(angle), np.sin(angle), 0.0])
        if self._kind == "reach":
            return rng.uniform(0.8, 1.2) * around + (0, 0, rng.uniform(-0.1, 1.1))
        if self._kind == "fold":
            return rng.uniform(0.0, 0.2) * around + (0, 0, rng.uniform(0.05, 0.7))
        if self._kind == "press":
            return np.array([rng.uniform(0.35, 0.8), rng.uniform(-0.35, 0.35), rng.uniform(-0.3, 0.05)])
        return rng.uniform(0.3, 0.8) * around + (0, 0, rng.uniform(-0.05, 0.8))


def record(suite: str, task_id: int, kind: str, steps: int, seed: int) -> dict[str, np.ndarray]:
    """Return the arrays of one recording."""
    env = make_env(suite, task_id, seed)
    sim, rng = env.sim, np.random.default_rng(seed)
    start = np.array(sim.get_state().flatten())
    start_afresh(env, start)
    touches = TouchCounter(env)
    hand = sim.model.site_name2id("gripper0_grip_site")
    motion = Motion(kind, np.array(sim.data.get_body_xpos("robot0_base")), rng)
    actions, robot, moments, touched = [], [], [], []
    for t in range(steps):
        if t % STRIDE == 0:
            moments.append(moment(env))
        actions.append(motion.action(np.array(sim.data.site_xpos[hand])))
        env.step(actions[-1])
        state = np.array(sim.get_state().flatten())
        robot.append(state[1:10])
        touched.append(touches.take())
    poses = fixture_poses(env)
    env.close()
    return {
        "suite": np.array(suite),
        "task_id": np.array(task_id),
        "motion": np.array(kind),
        "robosuite": np.array(robosuite_version()),
        "mujoco": np.array(mujoco.__version__),
        "fixtures": np.array(json.dumps(poses)),
        "actions": np.round(np.array(actions) * 64).astype(np.int8),
        "robot_qpos": np.array(robot),
        "moments": np.array(moments),
        "touches": np.array(touched, np.uint8),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--suites", nargs="+", default=SUITES)
    parser.add_argument("--motions", nargs="+", default=MOTIONS)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    for suite in args.suites:
        tasks = benchmark.get_benchmark_dict()[suite]().n_tasks
        for kind in args.motions:
            seed = 1000 * args.seed + 10 * SUITES.index(suite) + MOTIONS.index(kind)
            task_id = int(np.random.default_rng(seed).integers(tasks))
            path = args.out / f"{suite}-{task_id:02d}-{kind}-{robosuite_version()}.npz"
            if path.exists():
                continue
            found = record(suite, task_id, kind, args.steps, seed)
            np.savez_compressed(path, **found)
            counts = {n: int(((found["touches"] >> i) & 1).sum()) for i, n in enumerate(TOUCHES)}
            print(path.name, path.stat().st_size, "steps with touch of", counts, flush=True)


if __name__ == "__main__":
    main()
