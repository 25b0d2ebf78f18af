"""One demonstration from a seed: an attempt without pictures, filmed from its states if it succeeds."""

import hashlib
import json
import zlib
from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np

from libero_env.assets.robot import robosuite_version
from libero_env.demos.observe import Filmer, Shots, model_file
from libero_env.demos.read import Pairing
from libero_env.demos.write import DemoWriter, Episode, make_header
from libero_env.envs.batch import BatchEnv
from libero_env.errors import PlacementError
from libero_env.expert import ActionNoise, Expert, MotionStyle, Shapes, UnsupportedGoalError
from libero_env.expert.rollout import MAX_STEPS, Attempt, run_experts
from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.sim.observations import DEFAULT_CAMERAS
from libero_env.sim.osc import POSITION_SCALE, ROTATION_SCALE
from libero_env.sim.scene import build_scene
from libero_env.tasks import Task, get_task, read_task
from libero_env.timing import CONTROL_HZ

GENERATOR = "scripted-expert-8"  # change it when the same seed gives other demonstrations
MAX_ATTEMPTS = 10  # of one demonstration
BATCH = 5  # demonstrations simulated together, and recorded before the next


@dataclass(frozen=True)
class Variation:
    """In what the demonstrations of a task differ from each other.

    Attributes:
        style: draw the expert's manner for each; else all have the same.
        noise: standard deviation of the smooth noise on the executed actions, in units of the action.
        push_rate: pushes started per step.
        reserved: start demonstration k from stored state k (modulo 50), which evaluation uses, instead of new ones.
    """

    style: bool = True
    noise: float = 0.12
    push_rate: float = 0.02
    reserved: bool = False

    def header(self) -> dict:
        """Attributes of a file: what is unusual."""
        changed = {key: value for key, value in vars(self).items() if value != getattr(Variation, key)}
        return {"variation": json.dumps(changed)} if changed else {}


@dataclass(frozen=True)
class Recipe:
    """What the demonstrations of a task depend on."""

    source: Task | str  # a task, its name (`libero_object/3`) or a BDDL file
    camera_size: tuple[int, int] = (128, 128)
    seed: int = 0
    pairing: Pairing = "aligned"
    disturb: bool = True
    variation: Variation = Variation()
    cameras: tuple[str, ...] = DEFAULT_CAMERAS
    pictures: tuple[str, ...] = ("rgb",)  # see `Shots`

    @property
    def task(self) -> Task:
        """The task itself."""
        if isinstance(self.source, Task):
            return self.source
        return read_task(self.source) if self.source.endswith(".bddl") else get_task(self.source)

    @property
    def shots(self) -> Shots:
        """What is drawn."""
        return Shots(self.cameras, self.camera_size, self.pictures)

    def header(self) -> dict:
        """Attributes of the file."""
        task = self.task
        versions = {
            "mujoco": metadata.version("mujoco"),
            "robosuite": robosuite_version(),
            "h5py": metadata.version("h5py"),
        }
        return make_header(
            problem_name=task.problem.name,
            language=task.language,
            bddl_name=f"{task.suite}/{task.name}.bddl",
            bddl_text=task.bddl_text,
            env_kwargs=_env_kwargs(self.shots),
            pairing=self.pairing,
            seed=self.seed,
            generator=GENERATOR,
            disturbed=self.disturb,
            model_digest=model_digest(task),
            versions=json.dumps(versions),
            **self.shots.header(),
            **self.variation.header(),
        )


@dataclass(frozen=True)
class Take(Attempt):
    """An attempt, and where the fixtures stood, (nfixtures, 7)."""

    fixtures: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))


@dataclass
class Tally:
    """What came of demonstrations that were asked for.

    Attributes:
        recorded: how many there are now.
        attempts: at them, failed ones included.
        reasons: why attempts failed -> how often.
        error: why some cannot be made, or "".
    """

    recorded: int = 0
    attempts: int = 0
    reasons: Counter[str] = field(default_factory=Counter)
    error: str = ""

    def add(self, other: "Tally") -> None:
        """Count another tally in."""
        self.recorded += other.recorded
        self.attempts += other.attempts
        self.reasons += other.reasons
        self.error = self.error or other.error


def record_chunk(recipe: Recipe, path: Path, numbers: list[int]) -> Tally:
    """Record these demonstrations as parts of a file.

    Where the expert knows no way to the goal, or fails ten times on one demonstration, the tally's `error` says so.

    Raises:
        DemoError: a part cannot be written.
    """
    writer, tally = DemoWriter(path, recipe.header()), Tally()
    studio = _studio(recipe)
    failures = dict.fromkeys(numbers, 0)
    while failures:
        try:
            takes = studio.attempt(list(failures.items()))
        except UnsupportedGoalError as error:
            tally.error = f"the expert cannot do this task: {error}"
            break
        for k, take in takes:
            tally.attempts += 1
            if take.success:
                attrs = {"seed": recipe.seed, "failed_attempts": failures.pop(k)}
                writer.write(k, studio.film(take, attrs))
                tally.recorded += 1
                continue
            tally.reasons[take.reason] += 1
            failures[k] += 1
            if failures[k] == MAX_ATTEMPTS:
                del failures[k]
                tally.error = (
                    f"the expert failed {MAX_ATTEMPTS} times on demonstration {k}, last {take.reason}"
                )
    return tally


class Studio:
    """Simulates attempts without pictures, and films those that are worth it from their states."""

    def __init__(self, recipe: Recipe):
        self.recipe, self.task = recipe, recipe.task
        self.stage = BatchEnv(self.task, BATCH, num_threads=1, cameras=(), horizon=MAX_STEPS)
        self.filmer = Filmer(self.task, recipe.shots)
        self.shapes = Shapes(self.stage.world.scene)

    def attempt(self, numbers: list[tuple[int, int]]) -> list[tuple[int, Take]]:
        """Attempts at demonstrations (k, how many attempts failed before), at most `BATCH` of them.

        Raises:
            UnsupportedGoalError: the expert has no skill for the goal.
        """
        variation, experts, noise = self.recipe.variation, [], []
        placed: list[int] = []
        failed: list[tuple[int, Take]] = []
        for k, before in numbers[:BATCH]:
            start, manner, pushes = self._seeds(k, before)
            try:
                self._place(len(placed), k, start)
            except PlacementError as error:
                empty = np.zeros((0, 7))
                failed.append((k, Take(False, empty, empty, empty, 0, f"placement: {error}")))
                continue
            placed.append(k)
            style = None if variation.style else MotionStyle()
            experts.append(Expert(self.task, np.random.default_rng(manner), shapes=self.shapes, style=style))
            disturbance = ActionNoise(np.random.default_rng(pushes), variation.noise, variation.push_rate)
            noise.append(disturbance if self.recipe.disturb else None)
        fixtures = self.stage.world.simulations.fixtures.copy()
        attempts = run_experts(self.stage, experts, noise, max_steps=MAX_STEPS)
        takes = [Take(**vars(attempt), fixtures=fixtures[slot]) for slot, attempt in enumerate(attempts)]
        return failed + list(zip(placed, takes, strict=True))

    def film(self, take: Take, attrs: dict) -> Episode:
        """The attempt with its observations."""
        shown = take.states[:-1] if self.recipe.pairing == "aligned" else take.states[1:]
        obs, robot = self.filmer.film(shown, take.fixtures)
        wanted = take.expert_actions if self.recipe.disturb else None
        xml = model_file(self.task, tuple(self.filmer.scene.fixtures), take.fixtures)
        more = {**attrs, "model_file": xml, "fixtures": take.fixtures, "retries": take.retries}
        return Episode(take.actions, take.states[: len(take)], robot, obs, wanted, True, more)

    def close(self) -> None:
        """Free simulations and GL context."""
        self.stage.close()
        self.filmer.close()

    def _place(self, slot: int, k: int, seeds: np.random.SeedSequence) -> None:
        """Put one simulation at its start; the others stay as they are."""
        mask = np.arange(BATCH) == slot
        if self.recipe.variation.reserved:
            self.stage.reset(options={"reset_mask": mask, "init_state": k % NUM_INIT_STATES})
        else:
            seed = int(seeds.generate_state(1)[0])
            self.stage.reset(seed=[seed if here else None for here in mask], options={"reset_mask": mask})

    def _seeds(self, k: int, before: int) -> list[np.random.SeedSequence]:
        name = zlib.crc32(self.task.name.encode())
        return np.random.SeedSequence([self.recipe.seed, name, k, before]).spawn(3)


_open: list[Studio] = []


def _studio(recipe: Recipe) -> Studio:
    """The studio of a recipe; the last one stays open, since a task's chunks follow each other."""
    if not _open or _open[0].recipe != recipe:
        while _open:
            _open.pop().close()
        _open.append(Studio(recipe))
    return _open[0]


@lru_cache(maxsize=16)
def model_digest(task: Task) -> str:
    """Changes when anything about the task's compiled scene does, its look included; 16 hex digits."""
    model = build_scene(task.problem).model
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()[:16]


def _env_kwargs(shots: Shots) -> dict:
    """What the original's environment would be made with."""
    height, width = shots.size
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
        "camera_names": sorted(shots.cameras, reverse=True),
        "camera_heights": height,
        "camera_widths": width,
        "camera_depths": "depth" in shots.pictures,
        "use_camera_obs": True,
        "has_renderer": False,
        "has_offscreen_renderer": True,
        "ignore_done": True,
        "reward_shaping": True,
    }
