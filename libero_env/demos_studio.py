"""One demonstration from a seed: an attempt without pictures, filmed from its states if it succeeds."""

import hashlib
import json
import re
import zlib
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np

from libero_env.control import POSITION_SCALE, ROTATION_SCALE
from libero_env.demos import Pairing
from libero_env.demos_write import DemoWriter, Episode, make_header
from libero_env.env import CONTROL_HZ, LiberoEnv
from libero_env.errors import DemoError, PlacementError
from libero_env.expert import Disturbance, Expert, Shapes
from libero_env.expert.driver import Attempt, run_experts
from libero_env.mjspec import delete
from libero_env.scene import build_scene, scene_spec
from libero_env.tasks import Task, get_task
from libero_env.vector import BatchEnv

GENERATOR = "scripted-expert-3"  # change it when the same seed gives other demonstrations
MAX_ATTEMPTS = 10  # of one demonstration
MAX_STEPS = 250  # of one attempt
BATCH = 5  # demonstrations simulated together, and recorded before the next


@dataclass(frozen=True)
class Recipe:
    """What the demonstrations of a task depend on."""

    task_id: str  # `libero_object/3`
    camera_size: tuple[int, int] = (128, 128)
    seed: int = 0
    pairing: Pairing = "aligned"
    disturb: bool = True

    @property
    def task(self) -> Task:
        """The task itself."""
        return get_task(self.task_id)

    def header(self) -> dict:
        """Attributes of the file."""
        task, (height, width) = self.task, self.camera_size
        versions = {name: metadata.version(name) for name in ("mujoco", "robosuite", "h5py")}
        return make_header(
            problem_name=task.problem.name,
            language=task.language,
            bddl_name=f"{task.suite}/{task.name}.bddl",
            bddl_text=task.bddl_text,
            env_kwargs=_env_kwargs(height, width),
            pairing=self.pairing,
            seed=self.seed,
            camera_size=[height, width],
            generator=GENERATOR,
            disturbed=self.disturb,
            model_digest=model_digest(task),
            versions=json.dumps(versions),
        )


def record_chunk(recipe: Recipe, path: Path, numbers: list[int]) -> int:
    """Record these demonstrations as parts of a file; returns how many.

    Raises:
        DemoError: the expert failed ten times on the same one, or a part cannot be written.
    """
    writer = DemoWriter(path, recipe.header())
    studio = _studio(recipe)
    failures = dict.fromkeys(numbers, 0)
    while failures:
        for k, attempt in studio.attempt(list(failures.items())):
            if attempt.success:
                writer.write(
                    k, studio.film(attempt, {"seed": recipe.seed, "failed_attempts": failures.pop(k)})
                )
                continue
            failures[k] += 1
            if failures[k] == MAX_ATTEMPTS:
                raise DemoError(
                    f"{recipe.task_id}: the expert failed {MAX_ATTEMPTS} times on demonstration {k}, "
                    f"last {attempt.reason}"
                )
    return len(numbers)


class Studio:
    """Simulates attempts without pictures, and films those that are worth it from their states."""

    def __init__(self, recipe: Recipe):
        self.recipe, self.task = recipe, recipe.task
        self.stage = BatchEnv(self.task, BATCH, num_threads=1, cameras=(), horizon=MAX_STEPS)
        self.camera = LiberoEnv(self.task, camera_size=recipe.camera_size)
        self.shapes = Shapes(self.stage.world.scene)
        self.hand = self.stage.world.scene.model.body("robot0_right_hand").id

    def attempt(self, numbers: list[tuple[int, int]]) -> list[tuple[int, Attempt]]:
        """Attempts at demonstrations (k, how many attempts failed before), at most `BATCH` of them."""
        experts, noise = [], []
        placed: list[int] = []
        failed: list[tuple[int, Attempt]] = []
        for k, before in numbers[:BATCH]:
            start, manner, pushes = self._seeds(k, before)
            slot = len(placed)
            try:
                seeds = [int(start.generate_state(1)[0]) if i == slot else None for i in range(BATCH)]
                self.stage.reset(seed=seeds, options={"reset_mask": np.arange(BATCH) == slot})
            except PlacementError as error:
                empty = np.zeros((0, 7))
                failed.append((k, Attempt(False, empty, empty, empty, 0, str(error))))
                continue
            placed.append(k)
            experts.append(Expert(self.task, np.random.default_rng(manner), shapes=self.shapes))
            noise.append(Disturbance(np.random.default_rng(pushes)) if self.recipe.disturb else None)
        return failed + list(
            zip(placed, run_experts(self.stage, experts, noise, max_steps=MAX_STEPS), strict=True)
        )

    def film(self, attempt: Attempt, attrs: dict) -> Episode:
        """The attempt with its observations."""
        steps = len(attempt)
        shown = attempt.states[:-1] if self.recipe.pairing == "aligned" else attempt.states[1:]
        seen, quats = [], []
        for state in shown:
            seen.append(self.camera.set_state(state))
            quats.append(self.camera.world.simulations.fields["xquat"][0, self.hand][[1, 2, 3, 0]])
        obs = {key: np.stack([frame[key] for frame in seen]) for key in seen[0]}
        robot = np.concatenate([obs["gripper_states"], obs["ee_pos"], np.array(quats)], axis=1)
        wanted = attempt.expert_actions if self.recipe.disturb else None
        more = {**attrs, "model_file": _model_file(self.task), "retries": attempt.retries}
        return Episode(attempt.actions, attempt.states[:steps], robot, obs, wanted, True, more)

    def close(self) -> None:
        """Free simulations and GL context."""
        self.stage.close()
        self.camera.close()

    def _seeds(self, k: int, before: int) -> list[np.random.SeedSequence]:
        name = zlib.crc32(self.task.name.encode())
        return np.random.SeedSequence([self.recipe.seed, name, k, before]).spawn(3)


@lru_cache(maxsize=1)
def _studio(recipe: Recipe) -> Studio:
    return Studio(recipe)


@lru_cache(maxsize=16)
def model_digest(task: Task) -> str:
    """Changes when anything about the task's compiled scene does, its look included; 16 hex digits."""
    model = build_scene(task.problem).model
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer).hexdigest()[:16]


@lru_cache(maxsize=4)
def _model_file(task: Task) -> str:
    """The scene as MJCF, whole but for its textures, which are made in memory; the robot's meshes by their path."""
    spec = scene_spec(task.problem)
    for material in spec.materials:
        material.textures = [""] * len(list(material.textures))
    for texture in list(spec.textures):
        delete(spec, texture)
    spec.compile()
    return re.sub(r'file="[^"]*?(robosuite/models/assets/)', r'file="\1', spec.to_xml())


def _env_kwargs(height: int, width: int) -> dict:
    """What the original's environment would be made with."""
    controller = {
        "type": "OSC_POSE",
        "input_max": 1,
        "input_min": -1,
        "output_max": [POSITION_SCALE] * 3 + [ROTATION_SCALE] * 3,
        "output_min": [-POSITION_SCALE] * 3 + [-ROTATION_SCALE] * 3,
        "kp": 150,
        "damping_ratio": 1,
        "impedance_mode": "fixed",
        "control_delta": True,
        "uncouple_pos_ori": True,
        "interpolation": None,
    }
    return {
        "robots": ["Panda"],
        "controller_configs": controller,
        "control_freq": CONTROL_HZ,
        "camera_names": ["robot0_eye_in_hand", "agentview"],
        "camera_heights": height,
        "camera_widths": width,
        "camera_depths": False,
        "use_camera_obs": True,
        "has_renderer": False,
        "has_offscreen_renderer": True,
        "ignore_done": True,
        "reward_shaping": True,
    }
