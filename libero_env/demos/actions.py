"""Recorded actions as those of another controller: what the arm was asked for, as poses or as joint angles.

Recordings hold actions of `osc_pose` relative to the present pose. Each is executed in simulation for its control
period, from the state that was recorded before it, and expressed anew:

| kind | controller | the numbers |
|---|---|---|
| `delta` | `osc_pose` | as recorded |
| `absolute` | `osc_pose`, `control_delta=False` | goal of the grip site: position, m, rotation vector, rad; gripper |
| `joint` | `joint_position`, `control_delta=False` | goals of the seven joints, rad; gripper |

A pose is the goal that the controller had. Of the rotation vectors that mean one orientation, the first of a
demonstration is that whose largest entry is positive, and each later one that next to its predecessor: the hand points
down, where the shortest vectors change their sign.

`osc_pose` has no goals of joints. The goals q* here are those under which `joint_position` accelerates the joints in
the control period as `osc_pose` did, on average over its substeps: kp (q* - q) - kd dq = M^-1 (torque - bias). Where
the arm pushes, the goals lie beyond what is pushed. They are clipped to the joints' limits.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from libero_env.assets.pack import Pack
from libero_env.demos.agreement import require_default_control
from libero_env.demos.config import RenderConfig
from libero_env.demos.observe import StateRenderer
from libero_env.demos.read import Episode
from libero_env.errors import require_known
from libero_env.geometry import rotation_between
from libero_env.mujoco_compat import MASS_FIELD
from libero_env.sim.controller import get_controller
from libero_env.sim.simulation import INTEGRATED
from libero_env.tasks import Task

# kind of action -> name of its controller, and whether its actions are relative
KINDS: Mapping[str, tuple[str, bool]] = MappingProxyType(
    {"delta": ("osc_pose", True), "absolute": ("osc_pose", False), "joint": ("joint_position", False)}
)


class ActionConverter:
    """Converts the actions of a file's demonstrations.

    Args:
        file: Demonstration file, which states scene and robot.
        kind: One of `KINDS`.
        task: Task that was recorded; None for the one that the file states.
        assets: Where models come from, as for `LiberoEnv`.

    Raises:
        UnknownNameError: No such kind of action is known.
        DemoError: It is not a demonstration file, names no task, or has actions of another controller.
    """

    def __init__(
        self, file: Path, kind: str, task: Task | None = None, assets: Pack | str | Path | None = None
    ):
        require_known("kind of actions", kind, KINDS)
        require_default_control(file, "a replay or a conversion", any_frequency=True)
        self.kind, self._file = kind, file
        is_needed = kind != "delta" or task is not None  # which the states have to be of
        self._renderer = (
            StateRenderer.of_file(file, RenderConfig(()), assets, task=task) if is_needed else None
        )

    def convert(self, episode: Episode) -> Episode:
        """Return an episode with its actions converted; each must stand with the state before it.

        Raises:
            DemoError: The states do not fit the scene.
        """
        if self._renderer is None:
            return episode
        self._renderer.prepare(episode, f"{self._file}: {episode.name}")
        if self.kind == "delta":
            return episode
        simulations, controller = self._renderer.env.simulations, get_controller(*KINDS[self.kind])
        kept, goals = None, []
        for state, action in zip(episode.states, episode.actions, strict=True):
            simulations.set_physics_state(0, state)
            if kept is not None:
                simulations.controller_state.unpack(0, kept)  # a goal of the rotation outlives its step
            joints = self._step(action)
            kept = simulations.controller_state.pack(0)
            goals.append(joints if self.kind == "joint" else kept[:12])
        numbers = np.array(goals) if self.kind == "joint" else _poses(np.array(goals))
        numbers = np.column_stack([numbers, episode.actions[:, 6]])
        return replace(episode, actions=np.clip(numbers, controller.low, controller.high))

    def _step(self, action: np.ndarray) -> np.ndarray:
        """Execute an action; return the goals of the joints, (7,), that move the arm as it does."""
        assert self._renderer is not None
        simulations = self._renderer.env.simulations
        data, address = simulations.data(0), simulations.arm.mass_address
        before, seen = [data.qpos[:7].copy(), data.qvel[:7].copy()], []

        def watch(moment: int, ids: np.ndarray) -> None:
            if moment == INTEGRATED:
                mass = getattr(data, MASS_FIELD)[address]
                pull = np.linalg.solve(mass, data.ctrl[:7] - data.qfrc_bias[:7])
                seen.append([*before, pull])
                before[:] = data.qpos[:7].copy(), data.qvel[:7].copy()

        simulations.step([0], action[None], watch)
        qpos, qvel, pull = np.mean(seen, axis=0)
        stiffness, damping = get_controller(*KINDS["joint"]).gains
        return qpos + (pull + damping * qvel) / stiffness

    def close(self) -> None:
        """Free the simulation."""
        if self._renderer is not None:
            self._renderer.close()


def _poses(goals: np.ndarray) -> np.ndarray:
    """Return positions and continuous rotation vectors (T, 6) of positions and rotation matrices (T, 3 + 9)."""
    rotations: list[np.ndarray] = []
    for goal in goals:
        shortest = rotation_between(np.eye(3), goal[3:].reshape(3, 3))
        turn = shortest / max(np.linalg.norm(shortest), 1e-9) * 2.0 * np.pi
        candidates = np.array([shortest, shortest - turn, shortest + turn])
        if rotations:
            distance = np.linalg.norm(candidates - rotations[-1], axis=1)
        else:
            largest = candidates[np.arange(3), np.abs(candidates).argmax(axis=1)]
            distance = np.where(largest > 0, np.linalg.norm(candidates, axis=1), np.inf)
        rotations.append(candidates[distance.argmin()])
    return np.column_stack([goals[:, :3], rotations])
