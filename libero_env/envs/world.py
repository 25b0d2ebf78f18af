"""n simulations of one task: starts, control steps, observations and the truth of the goal.

`LiberoEnv` is a world of one simulation and `BatchEnv` one of many, so that both give the same bits.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from gymnasium import spaces

from libero_env.assets.pack import Pack, select_pack
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.init_states.settle import sample_settled
from libero_env.init_states.store import load_init_states, split_row
from libero_env.sim.controllers import ControllerState, get_controller
from libero_env.sim.observations import DEFAULT_CAMERAS, DEFAULT_OBSERVATIONS, Observer
from libero_env.sim.predicates import SEMANTICS, atoms_of, evaluate
from libero_env.sim.scene import Scene, build_scene
from libero_env.sim.simulation import Simulations, make_simulations
from libero_env.sim.state import StateView
from libero_env.tasks import Task, get_task
from libero_env.tasks.problem import And


class World:
    """Simulations of one task, without a notion of episodes.

    Args:
        task: a `Task`, or what `get_task` takes (`libero_object/3`).
        num: number of simulations.
        threads: threads of the batched physics; 0 is one for each core.
        cameras: what is drawn for each observation; empty for none.
        camera_size: (height, width) of a frame, pixels.
        observations: what is observed, by the names of `libero_env.sim.observations`.
        controller, control_delta: what an action means; see `libero_env.sim.controllers`.
        assets: where the models come from, a `Pack` or what `select_pack` takes.
        semantics: of the predicates, `original` or `strict`; see `libero_env.sim.predicates`.
    """

    def __init__(
        self,
        task: Task | str,
        num: int = 1,
        *,
        threads: int = 0,
        cameras: Sequence[str] = DEFAULT_CAMERAS,
        camera_size: tuple[int, int] = (128, 128),
        observations: Sequence[str] = DEFAULT_OBSERVATIONS,
        controller: str = "osc_pose",
        control_delta: bool = True,
        assets: Pack | str | Path | None = None,
        semantics: str = "original",
    ):
        if semantics not in SEMANTICS:
            raise UnknownNameError("semantics", semantics, SEMANTICS)
        self.semantics = semantics
        self.controller = get_controller(controller, control_delta)
        self.task = get_task(task) if isinstance(task, str) else task
        pack = select_pack(assets) if assets is None or isinstance(assets, str | Path) else assets
        self.scene: Scene = build_scene(self.task.problem, pack)
        self.num, self.cameras, self.camera_size = (
            num,
            tuple(cameras),
            (int(camera_size[0]), int(camera_size[1])),
        )
        self.simulations: Simulations = make_simulations(
            self.scene.model, num, threads, self.scene.fixture_bodies.tolist()
        )
        self.simulations.controller = ControllerState(num, self.controller)
        self.views = [StateView(self.scene, self.simulations, i) for i in range(num)]
        self.observer = Observer(
            self.scene,
            self.simulations,
            self.views,
            observations=observations,
            cameras=self.cameras,
            camera_size=self.camera_size,
        )
        # without those of quantifiers, whose variables stand for several things
        self.atoms = tuple(a for a in atoms_of(self.task.problem.goal) if all(map(self._exists, a.args)))

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
        simulations, own = self.simulations, self.simulations.controller
        simulations.controller = ControllerState(
            self.num
        )  # settling holds the pose, whatever an action means
        try:
            starts = [
                sample_settled(self.scene, simulations, i, rng)
                for i, rng in zip(ids, generators, strict=True)
            ]
        finally:
            simulations.controller = own
        qpos, fixtures = (
            np.stack([start.qpos for start in starts]),
            np.stack([start.fixtures for start in starts]),
        )
        self.simulations.reset(ids, qpos, np.zeros((len(ids), self.scene.model.nv)), fixtures=fixtures)

    def step(self, ids: Sequence[int], actions: np.ndarray) -> None:
        """Advance by one control period of 50 ms; actions (num, action_dim), already checked."""
        self.simulations.step(ids, actions)

    def goal_reached(self, ids: Sequence[int]) -> np.ndarray:
        """Truth of the goal in each of the simulations, (len(ids),) bool."""
        return np.array([evaluate(self.task.problem.goal, self.views[i], self.semantics) for i in ids], bool)

    def progress(self, i: int) -> dict[str, bool]:
        """Truth of each atom of the goal in simulation i."""
        return {
            f"({a.predicate} {' '.join(a.args)})": evaluate(a, self.views[i], self.semantics)
            for a in self.atoms
        }

    def judge(self, i: int) -> tuple[bool, dict[str, bool]]:
        """Truth of the goal in simulation i and of each of its atoms; none is evaluated twice in a conjunction."""
        goal, progress = self.task.problem.goal, self.progress(i)
        parts = goal.parts if isinstance(goal, And) else (goal,)
        if all(part in self.atoms for part in parts):
            return all(progress.values()), progress
        return evaluate(goal, self.views[i], self.semantics), progress

    def physics_state(self, i: int) -> np.ndarray:
        """[time, qpos, qvel] of simulation i, the original's layout."""
        f = self.simulations.fields
        return np.concatenate([[self.simulations.time(i)], f["qpos"][i], f["qvel"][i]])

    def set_physics_state(self, i: int, state: np.ndarray) -> None:
        """Restore [time, qpos, qvel]; the controller starts afresh, holding the pose."""
        nq = self.scene.model.nq
        self.simulations.reset([i], state[None, 1 : 1 + nq], state[None, 1 + nq :], float(state[0]))

    def observation_space(self) -> spaces.Dict:
        """The space of one simulation's observations."""
        return self.observer.space()

    def action_space(self) -> spaces.Box:
        """The space of one simulation's actions."""
        return spaces.Box(self.controller.low.astype(np.float32), self.controller.high.astype(np.float32))

    def proprioception(self) -> dict[str, np.ndarray]:
        """All that is observed but pictures: name -> (num, length) float64."""
        return self.observer.state()

    def draw(self, ids: Sequence[int], frames: dict[str, np.ndarray]) -> None:
        """Draw what is observed of these simulations into rows of `frames`, which `empty_frames` made."""
        self.observer.draw(ids, frames)

    def frame(self, i: int, camera: str, kind: str = "rgb") -> np.ndarray:
        """One picture of any camera; see `Observer.picture`."""
        return self.observer.picture(i, camera, kind)

    def empty_frames(self) -> dict[str, np.ndarray]:
        """Arrays for `draw`, zero: name -> (num, height, width, ...)."""
        return self.observer.empty_frames()

    def close(self) -> None:
        """Free the GL context and the simulations. Idempotent."""
        self.observer.close()
        self.simulations.close()

    def _exists(self, name: str) -> bool:
        return name in self.scene.entities or self.task.problem.region(name) is not None
