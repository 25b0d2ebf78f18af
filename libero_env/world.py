"""n simulations of one task: starts, control steps, observations and the truth of the goal.

`LiberoEnv` is a world of one simulation and `BatchEnv` one of many, so that both give the same bits.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from libero_env.errors import LiberoError
from libero_env.init_states import load_init_states, sample_settled, split_row
from libero_env.predicates import StateView, atoms_of, evaluate
from libero_env.render import Renderer
from libero_env.scene import Scene, build_scene
from libero_env.simulation import Simulations, make_simulations
from libero_env.tasks import Task, get_task

DEFAULT_CAMERAS = ("agentview", "robot0_eye_in_hand")


class World:
    """Simulations of one task, without a notion of episodes.

    Args:
        task: a `Task`, or what `get_task` takes (`libero_object/3`).
        num: number of simulations.
        threads: threads of the batched physics; 0 is one for each core.
        cameras: what is drawn for each observation; empty for none.
        camera_size: (height, width) of a frame, pixels.
    """

    def __init__(
        self,
        task: Task | str,
        num: int = 1,
        *,
        threads: int = 0,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        camera_size: tuple[int, int] = (128, 128),
    ):
        self.task = get_task(task) if isinstance(task, str) else task
        self.scene: Scene = build_scene(self.task.problem)
        self.num, self.cameras, self.camera_size = num, tuple(cameras), tuple(camera_size)
        self.renderer = Renderer(self.scene.model, *self.camera_size)
        self._camera_ids = {frame_key(name): self.renderer.camera_id(name) for name in self.cameras}
        self.simulations: Simulations = make_simulations(self.scene.model, num, threads, self.scene.fixture_bodies)
        self.views = [StateView(self.scene, self.simulations, i) for i in range(num)]
        self._picture = mujoco.MjData(self.scene.model)  # kinematics of the simulation being drawn
        self._hand = self.scene.model.body("robot0_right_hand").id
        self.atoms = atoms_of(self.task.problem.goal)

    @property
    def init_states(self) -> np.ndarray:
        """The task's stored initial states, rows as [time, qpos, qvel, 7 numbers for each fixture]."""
        return load_init_states(self.task, self.scene)

    def reset_to_init(self, ids: Sequence[int], init_states: Sequence[int]) -> None:
        """Start simulations from stored initial states.

        Raises:
            LiberoError: no such initial state.
        """
        stored = self.init_states
        wanted = np.asarray(init_states)
        if wanted.shape != (len(ids),) or not np.issubdtype(wanted.dtype, np.integer):
            raise LiberoError(f"init_state: expected {len(ids)} integers, got {init_states!r}")
        if ((wanted < 0) | (wanted >= len(stored))).any():
            raise LiberoError(f"init_state {wanted.tolist()}: {self.task.id} has 0 to {len(stored) - 1}")
        qpos, qvel, fixtures = split_row(self.scene.model, stored[wanted])
        self.simulations.reset(ids, qpos, qvel, fixtures=fixtures)

    def reset_random(self, ids: Sequence[int], generators: Sequence[np.random.Generator]) -> None:
        """Start simulations from new placements, one generator for each.

        Raises:
            PlacementError: nothing fits, or nothing comes to rest.
        """
        starts = [sample_settled(self.scene, self.simulations, i, rng) for i, rng in zip(ids, generators, strict=True)]
        qpos, fixtures = np.stack([start.qpos for start in starts]), np.stack([start.fixtures for start in starts])
        self.simulations.reset(ids, qpos, np.zeros((len(ids), self.scene.model.nv)), fixtures=fixtures)

    def step(self, ids: Sequence[int], actions: np.ndarray) -> None:
        """Advance by one control period of 50 ms; actions (num, 7), already checked."""
        self.simulations.step(ids, actions)

    def goal_reached(self, ids: Sequence[int]) -> np.ndarray:
        """Truth of the goal in each of the simulations, (len(ids),) bool."""
        return np.array([evaluate(self.task.problem.goal, self.views[i]) for i in ids], bool)

    def progress(self, i: int) -> dict[str, bool]:
        """Truth of each atom of the goal in simulation i."""
        return {f"({a.predicate} {' '.join(a.args)})": evaluate(a, self.views[i]) for a in self.atoms}

    def physics_state(self, i: int) -> np.ndarray:
        """[time, qpos, qvel] of simulation i, the original's layout."""
        f = self.simulations.fields
        return np.concatenate([[self.simulations.time(i)], f["qpos"][i], f["qvel"][i]])

    def set_physics_state(self, i: int, state: np.ndarray) -> None:
        """Restore [time, qpos, qvel]; the controller starts afresh, holding the pose."""
        nq = self.scene.model.nq
        self.simulations.reset([i], state[None, 1 : 1 + nq], state[None, 1 + nq :], float(state[0]))

    def proprioception(self) -> dict[str, np.ndarray]:
        """Joints (num, 7), fingers (num, 2), grip site (num, 3) and hand orientation as axis-angle (num, 3)."""
        f, nq = self.simulations.fields, self.scene.nq_robot
        return {
            "joint_states": f["qpos"][:, :7].copy(),
            "gripper_states": f["qpos"][:, 7:nq].copy(),
            "ee_pos": f["site_xpos"][:, self.simulations.arm.site].copy(),
            "ee_ori": axis_angle(f["xquat"][:, self._hand]),
        }

    def draw(self, ids: Sequence[int], frames: dict[str, np.ndarray]) -> None:
        """Draw the observation cameras of these simulations into `frames`: key -> (num, height, width, 3) uint8."""
        if not self._camera_ids:
            return
        for i in ids:
            self._pose_picture(i)
            out = [frames[key][i] for key in self._camera_ids]
            self.renderer.render(self._picture, list(self._camera_ids.values()), out)

    def frame(self, i: int, camera: str) -> np.ndarray:
        """One picture of any camera, (height, width, 3) uint8."""
        out = np.empty((*self.camera_size, 3), np.uint8)
        self._pose_picture(i)
        self.renderer.render(self._picture, [self.renderer.camera_id(camera)], [out])
        return out

    def empty_frames(self) -> dict[str, np.ndarray]:
        """Arrays for `draw`, black."""
        return {key: np.zeros((self.num, *self.camera_size, 3), np.uint8) for key in self._camera_ids}

    def close(self) -> None:
        """Free the GL context and the simulations. Idempotent."""
        self.renderer.close()
        self.simulations.close()

    def _pose_picture(self, i: int) -> None:
        data, model = self._picture, self.simulations.model
        self.simulations.pose_fixtures(i)
        data.qpos[:] = self.simulations.fields["qpos"][i]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)


def frame_key(camera: str) -> str:
    """Name of a camera's frames in observations: `robot0_eye_in_hand` -> `eye_in_hand_rgb`."""
    return f"{camera.removeprefix('robot0_')}_rgb"


def axis_angle(quat_wxyz: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3), rad, of unit quaternions (n, 4); angle in [0, 2 pi) as the original writes it."""
    w = np.clip(quat_wxyz[:, :1], -1.0, 1.0)
    sine = np.sqrt(1.0 - w * w)
    scale = np.where(sine < 1e-9, 0.0, 2.0 * np.arccos(w) / np.maximum(sine, 1e-9))
    return quat_wxyz[:, 1:] * scale
