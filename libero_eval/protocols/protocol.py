"""Protocol cards: everything that decides what a policy sees and how its episodes are judged.

A card is a YAML file; `libero_eval.protocols.files` reads it. The dataclasses below are its sections. A value of
null means that the source of the protocol does not state it: it is never guessed, and a card is run only when all that
a run needs is stated.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from typing import Any, Literal

from libero_env.tasks import Task
from libero_eval.protocols.checks import contradictions, type_errors
from lifelong.errors import ProtocolError, ProtocolMismatchError

Steps = int | Mapping[str, int]


@dataclass(frozen=True)
class World:
    """What is simulated.

    Attributes:
        models: Models of the scene: `original`, `builtin`, or `any`, those that the user has chosen.
        models_digest: Digest that the models must have, as `libero assets info` prints it.
        drawing: How images are drawn, see `libero_env.sim.scene`.
        robot: Model of the arm, see `libero_env.assets.robot`.
        task_files: Digest of the task files; null: those of the benchmark, whose digests each result has.
        init_states: `original`: the 50 states of each task that LIBERO publishes, where the user has them; `builtin`:
            those that this package made for its models.
        environments: Whether one environment is `reused` for a task's episodes, or `rebuilt` for each.
        fixture_poses: `drawn`: as the original's resets draw them before the initial state is set; `stored`: as stored
            with the initial state.
        env_seed: Seed given to the environment.
        seeding: When the seed is given: `once` for a task, so that poses drift from reset to reset, or `every_reset`.
        seed_per_start: With `every_reset`: what is added to the seed for each initial state.
        seed_per_task: With `every_reset`: what is added to the seed for each task of the suite.
        loads: Number of times the original had loaded the task before the first counted reset.
        control_freq: Control steps per second, [Hz].
        controller: Name of the controller, see `libero_env.sim.controller`.
        delta: Whether actions are relative to the present pose.
        predicates: Semantics of the goals, see `libero_env.sim.predicates`.
        perturb: Perturbations, such as `camera=0.3,light=0.5`, see `libero_env.perturbations`; empty for none. A card
            without it has none.
        backend: Back end of the physics and the pictures, see `libero_env.sim.backend`. A card without it has `mujoco`.
    """

    models: Literal["original", "builtin", "any"]
    models_digest: str | None
    drawing: Literal["faithful", "fast"]
    robot: Literal["libero", "robosuite-1.4.1"] | None
    task_files: str | None
    init_states: Literal["original", "builtin"]
    environments: Literal["reused", "rebuilt"] | None
    fixture_poses: Literal["drawn", "stored"]
    env_seed: int | None
    seeding: Literal["once", "every_reset"] | None
    seed_per_start: int | None
    seed_per_task: int | None
    loads: int | None
    control_freq: int
    controller: Literal["osc_pose"]
    delta: bool
    predicates: Literal["original", "strict"]
    perturb: str = ""
    backend: Literal["mujoco", "warp"] = "mujoco"


@dataclass(frozen=True)
class Rules:
    """How an episode runs and ends.

    Attributes:
        reset_order: Calls that start an episode, in order.
        settle_steps: Number of steps before the policy acts.
        settle_action: Action of these steps.
        settle_counted: Whether these steps count towards the horizon.
        horizon: Maximum number of the policy's steps, for all suites or for each.
        success: `first_hit`: the episode ends when the goal holds; `accumulated`: the goal must have held at any time;
            `final`: the goal must hold at the end, which no run offers yet.
        errors: What an error of the policy does: `failure`, the episode counts as one; `stop`, the evaluation ends.
        observed: When observations are taken: `substep`, as the original does, before the last of the 25 physics steps
            of a control step; `after`, after it.
    """

    reset_order: tuple[Literal["seed", "reset", "set_init_state", "settle"], ...]
    settle_steps: int | None
    settle_action: tuple[float, ...] | None
    settle_counted: bool
    horizon: Steps | None
    success: Literal["first_hit", "accumulated", "final"]
    errors: Literal["failure", "stop"] | None
    observed: Literal["substep", "after"]


@dataclass(frozen=True)
class Pixels:
    """Images.

    Attributes:
        cameras: Cameras, in the order in which the policy receives them.
        render_size: Height and width that are drawn, [pixels].
        orientation: `upright`; `bottom_up`, as the original's environments return images; or `rotated`, those turned by
            180 degrees: upright and mirrored.
        resize: How images are resized, see `libero_eval.protocols.preprocessing`.
        resize_size: Height and width after it, [pixels].
        crop: Share of the area that is cut out of the middle and resized back; 1 for all of it.
    """

    cameras: tuple[Literal["agentview", "robot0_eye_in_hand"], ...]
    render_size: tuple[int, int] | None
    orientation: Literal["upright", "bottom_up", "rotated"] | None
    resize: Literal["none", "pil_bilinear_pad", "jpeg_lanczos3", "torch_bilinear"] | None
    resize_size: tuple[int, int] | None
    crop: float | None


@dataclass(frozen=True)
class Proprioception:
    """The vector of the robot's state.

    Attributes:
        source: `observation`, the environment's observation; `none`: the policy receives no state.
        order: Parts of the vector.
        rotation: Representation of the orientation: `axis_angle`, robosuite's, which keeps the quaternion's sign;
            `axis_angle_float32`, the same in single precision, as LeRobot computes it; `axis_angle_positive`, of the
            quaternion with w >= 0; `quat_xyzw`.
        dtype: Type of the numbers.
    """

    source: Literal["observation", "none"] | None
    order: tuple[Literal["ee_pos", "ee_rotation", "gripper_qpos"], ...] | None
    rotation: Literal["axis_angle", "axis_angle_float32", "axis_angle_positive", "quat_xyzw"] | None
    dtype: Literal["float32", "float64"] | None


@dataclass(frozen=True)
class Language:
    """The instruction.

    Attributes:
        source: `file_name`, words of the task's name, or `bddl`, the task file's `:language`.
        template: Text with `{instruction}`.
    """

    source: Literal["file_name", "bddl"]
    template: str


@dataclass(frozen=True)
class Actions:
    """What a policy's answers mean.

    Attributes:
        unnorm_key: Name of the statistics that undo the policy's normalisation.
        unnorm_statistic: Statistic that does, such as `q01_q99`, or `policy` where the policy's server does it.
        unnorm_mask: Which values are not normalised.
        unnorm_clip: Whether normalised values are clipped.
        gripper: What the last number means: `as_predicted`, -1 opens and +1 closes; `sign`, likewise, but open if it is
            negative and else closed; `open_sign`, 1 is open and 0 closed, by the sign of 1 - 2x; `open_cut`, open over
            0.5.
        chunk: Number of actions that the policy predicts at once.
        replan: Number of them that are executed before it is asked again.
        ensembling: How overlapping predictions are combined.
    """

    unnorm_key: str | None
    unnorm_statistic: str | None
    unnorm_mask: str | None
    unnorm_clip: bool | None
    gripper: Literal["as_predicted", "sign", "open_sign", "open_cut"] | None
    chunk: int | None
    replan: int | None
    ensembling: str | None


@dataclass(frozen=True)
class Sampling:
    """Chance and arithmetic of the policy; recorded and checked against what it announces.

    Attributes:
        seed: Seed of the policy, or of the evaluating process.
        denoising_steps: Number of denoising steps.
        temperature: Temperature of sampling.
        precision: Floating-point type.
        batch: Number of observations in a request.
    """

    seed: int | None
    denoising_steps: int | None
    temperature: float | None
    precision: str | None
    batch: int | None


@dataclass(frozen=True)
class Counting:
    """What the reported number is a mean of.

    Attributes:
        tasks: Number of tasks of a suite; null: all.
        trials: Number of episodes of a task, from its first initial state on.
        interval: Method of the confidence interval; `none`: the source reports none.
        checkpoint: Revision of the weights.
        dataset: Revision of the data they were trained on.
    """

    tasks: int | None
    trials: int | None
    interval: str | None
    checkpoint: str | None
    dataset: str | None


# What a run cannot do without
NEEDED = (
    "episode.settle_steps",
    "episode.horizon",
    "pixels.render_size",
    "pixels.orientation",
    "pixels.resize",
    "proprioception.source",
    "action.gripper",
)


@dataclass(frozen=True)
class Card:
    """A protocol.

    Attributes:
        name: Name, that of its file.
        title: What it is, in one line.
        world: What is simulated.
        episode: How an episode runs and ends.
        pixels: Images.
        proprioception: The vector of the robot's state.
        language: The instruction.
        action: What a policy's answers mean.
        sampling: Chance and arithmetic of the policy.
        counting: What the reported number is a mean of.
        sources: Section or field, such as `world.env_seed` -> where its values stand.

    Raises:
        ProtocolError: A value has the wrong type, or two contradict each other.
    """

    name: str
    title: str
    world: World
    episode: Rules
    pixels: Pixels
    proprioception: Proprioception
    language: Language
    action: Actions
    sampling: Sampling
    counting: Counting
    sources: Mapping[str, str]

    def __post_init__(self) -> None:
        problems = type_errors(self) or contradictions(self.flat())
        if problems:
            raise ProtocolError(f"protocol {self.name}: " + "; ".join(problems))

    def flat(self) -> dict[str, Any]:
        """Return all values by dotted name, such as `world.env_seed`."""
        return dict(_flat(self))

    def resolved(self) -> dict[str, Any]:
        """Return the card as plain data, with a digest of everything that decides a result."""
        return {**asdict(self), "digest": self.digest}

    @property
    def digest(self) -> str:
        """Digest of all values, 16 hex digits; names and sources are not part of it."""
        values = {k: v for k, v in self.flat().items() if "." in k and not k.startswith("sources")}
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    def steps(self, task: Task) -> int:
        """Return the maximum number of the policy's steps on a task.

        Raises:
            ProtocolError: The card states none for the task's suite.
        """
        horizon = self.episode.horizon
        found = horizon.get(task.origin.suite) if isinstance(horizon, Mapping) else horizon
        if found is None and isinstance(horizon, Mapping) and not task.suite.startswith("libero_"):
            found = max(horizon.values())  # a user's own suite
        if found is None:
            raise ProtocolError(f"protocol {self.name} states no episode.horizon for {task.suite}")
        return found - self.settle_steps * self.episode.settle_counted

    @property
    def settle_steps(self) -> int:
        """Number of steps before the policy acts."""
        return self.episode.settle_steps or 0

    @property
    def settle_action(self) -> tuple[float, ...] | None:
        """Action of these steps."""
        return self.episode.settle_action

    def prompt(self, task: Task) -> str:
        """Return the instruction of a task that a policy receives."""
        text = task.problem.language if self.language.source == "bddl" else task.language
        return self.language.template.replace("{instruction}", text)

    def env_seed(self, task: Task, start: int) -> int | None:
        """Return the seed that the environment gets for an initial state; None where the poses are stored."""
        world = self.world
        if world.fixture_poses == "stored" or world.env_seed is None:
            return None
        if world.seeding == "once":
            return world.env_seed
        return world.env_seed + (world.seed_per_start or 0) * start + (world.seed_per_task or 0) * task.index

    def require(self) -> None:
        """Check that the card states all that a run needs.

        Raises:
            ProtocolError: It does not, or states what no run offers; the message names the fields.
        """
        if self.episode.success == "final":
            raise ProtocolError(f"protocol {self.name} cannot be run: episodes end at success, not `final`")
        values = self.flat()
        needed = list(NEEDED)
        if self.pixels.resize not in (None, "none"):
            needed.append("pixels.resize_size")
        if self.episode.settle_steps:
            needed.append("episode.settle_action")
        if self.world.fixture_poses == "drawn":
            needed += ["world.env_seed", "world.seeding"]
        if missing := [name for name in needed if values[name] is None]:
            raise ProtocolError(
                f"protocol {self.name} cannot be run: its source does not state {', '.join(missing)}. Write a card "
                f"with `extends: {self.name}` that does, and give its path to --protocol"
            )

    def changed(self, values: Mapping[str, Any]) -> "Card":
        """Return a card with other values of some fields, by dotted name such as `episode.horizon`.

        Raises:
            ProtocolError: A value has the wrong type, or contradicts another.
        """
        parts: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            section, _, field = name.partition(".")
            parts.setdefault(section, {})[field] = value
        return replace(self, **{k: replace(getattr(self, k), **v) for k, v in parts.items()})

    def check(self, announced: Mapping[str, Any]) -> None:
        """Compare the card with what a policy announces of itself.

        Args:
            announced: Dotted name of a field, such as `action.chunk`, or a section with its fields -> value. Names that
                no card has are ignored, as are fields that the card does not state.

        Raises:
            ProtocolMismatchError: Values differ; the message names both of each.
        """
        own = {k: v for k, v in self.flat().items() if "." in k}
        given = {k: v for k, v in _flat(announced) if k in own}
        wrong = [
            f"{name}: protocol {self.name} has {own[name]!r}, the policy {value!r}"
            for name, value in given.items()
            if value is not None and own[name] is not None and _plain(value) != _plain(own[name])
        ]
        if wrong:
            raise ProtocolMismatchError(
                "the policy was made for another protocol; nothing was run. " + "; ".join(wrong)
            )


SECTIONS: dict[str, type] = {
    "world": World,
    "episode": Rules,
    "pixels": Pixels,
    "proprioception": Proprioception,
    "language": Language,
    "action": Actions,
    "sampling": Sampling,
    "counting": Counting,
}


def _flat(values: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted names and values of sections; mappings inside of a section are values."""
    if is_dataclass(values):
        pairs = [(f.name, getattr(values, f.name)) for f in fields(values)]
    else:
        pairs = list(values.items())
    for name, value in pairs:
        if not prefix and (is_dataclass(value) or (name in SECTIONS and isinstance(value, Mapping))):
            yield from _flat(value, f"{name}.")
        else:
            yield prefix + name, value


def _plain(value: Any) -> Any:
    """Return a value with lists for all sequences, numbers as they compare."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value
