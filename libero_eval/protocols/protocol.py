"""Protocols: everything that decides what a policy sees, and how its episodes are run and counted.

The dataclasses are the sections of a protocol's file, see `libero_eval.protocols.files`. A value of null means that the
source of the protocol does not state it: it is never guessed, and a protocol is run only when all that a run needs is
stated.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields, is_dataclass
from operator import attrgetter
from typing import Annotated, Any, Literal, get_args

from pydantic import Field

from libero_env.errors import LiberoError
from libero_env.tasks import Task
from libero_env.text import plain, shown, suggest
from libero_env.timing import ControlFreq
from libero_env.validation import validate
from libero_eval.protocols.clock import Clock
from lifelong.errors import ProtocolError, ProtocolMismatchError

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")

# upper bounds are what no protocol means, and no machine does in a life
_AtLeastOne = Annotated[int, Field(ge=1)]
_Steps = Annotated[int, Field(ge=1, le=1_000_000)]
_MAX_SEED = 2**32 - 1
_EnvSeed = Annotated[int, Field(ge=0, le=_MAX_SEED)]
_RenderSide = Annotated[int, Field(ge=1, le=16384)]  # pixels
_Side = Annotated[int, Field(ge=1, le=4096)]
_Call = Literal["seed", "reset", "set_init_state", "settle"]
_CALLS = get_args(_Call)  # in the order in which they are made
_Action = Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]


@dataclass(frozen=True)
class Simulation:
    """What is simulated.

    Attributes:
        models: Models of the scene: `original`, `builtin`, or `any`, those that the user has chosen.
        models_digest: Digest that the models must have, as `libero assets info` prints it.
        drawing: How images are drawn, see `libero_env.sim.scene`.
        robot: Model of the arm, see `libero_env.assets.robot`.
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
        control_freq: Control steps per second, [Hz]; it divides 500. Steps and horizons are counted, not timed.
        controller: Name of the controller, see `libero_env.sim.controller`.
        delta: Whether actions are relative to the present pose. Those of the waiting steps always are.
        predicates: Semantics of the goals, see `libero_env.sim.predicates`.
        perturb: Perturbations, such as `camera=0.3,light=0.5`, see `libero_env.perturbations`; empty for none.
        backend: Backend of the physics and the pictures, see `libero_env.sim.backend`.
    """

    models: Literal["original", "builtin", "any"]
    models_digest: str | None
    drawing: Literal["faithful", "fast"]
    robot: Literal["libero", "robosuite-1.4.1"] | None
    init_states: Literal["original", "builtin"]
    environments: Literal["reused", "rebuilt"] | None
    fixture_poses: Literal["drawn", "stored"]
    env_seed: _EnvSeed | None
    seeding: Literal["once", "every_reset"] | None
    seed_per_start: int | None
    seed_per_task: int | None
    loads: Annotated[int, Field(ge=1, le=10_000)] | None
    control_freq: ControlFreq
    controller: Literal["osc_pose"]
    delta: bool
    predicates: Literal["original", "strict"]
    perturb: str = ""
    backend: Literal["mujoco", "warp"] = "mujoco"

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        if self.perturb:
            yield from _unlike_stored("world.perturb", self.perturb, _stored_perturbations)
        if self.fixture_poses == "stored" and self.init_states == "original":
            yield "world.fixture_poses are stored, but world.init_states are original, with which none are stored"
        if self.fixture_poses == "stored" and self.env_seed is not None:
            yield f"world.env_seed is {self.env_seed}, but world.fixture_poses are stored: nothing is drawn"
        if self.seeding == "once":
            if self.environments == "rebuilt":
                yield (
                    "world.environments are rebuilt, but world.seeding is once, for a task: write every_reset, "
                    "and what of the seed changes in seed_per_start"
                )
            for name in ("seed_per_start", "seed_per_task"):
                if value := getattr(self, name):
                    yield f"world.{name} is {value}, but world.seeding is once"


@dataclass(frozen=True)
class Episodes:
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
        observed: When observations are taken: `substep`, as the original does, before the last physics step of a
            control step; `after`, after it.
    """

    reset_order: tuple[_Call, ...]
    settle_steps: Annotated[int, Field(ge=0, le=10_000)] | None
    settle_action: _Action | None
    settle_counted: bool
    horizon: _Steps | Mapping[str, _Steps] | None
    success: Literal["first_hit", "accumulated", "final"]
    errors: Literal["failure", "stop"] | None
    observed: Literal["substep", "after"]

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        if self.settle_steps == 0:
            if self.settle_action is not None:
                yield f"episode.settle_action is {list(self.settle_action)}, but episode.settle_steps is 0"
            if self.settle_counted:
                yield "episode.settle_counted is true, but episode.settle_steps is 0"
        by_suite = self.horizon if isinstance(self.horizon, Mapping) else {}
        if by_suite and (missing := [s for s in SUITES if s not in by_suite]):
            yield f"episode.horizon has no value for {', '.join(missing)}"
        least = 1 + (self.settle_steps or 0) * self.settle_counted
        single = self.horizon if isinstance(self.horizon, int) else least
        if (lowest := min([*by_suite.values(), single])) < least:
            yield f"episode.horizon is {lowest}; it must be at least {least}"
        order = list(self.reset_order)
        if "set_init_state" not in order or order != [call for call in _CALLS if call in order]:
            yield (
                f"episode.reset_order is {order}; it must have set_init_state, and calls are made once, in the order "
                f"of {', '.join(_CALLS)}"
            )
        elif self.settle_steps and "settle" not in order:
            yield f"episode.settle_steps is {self.settle_steps}, but episode.reset_order has no settle"


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

    cameras: Annotated[tuple[Literal["agentview", "robot0_eye_in_hand"], ...], Field(min_length=1)]
    render_size: tuple[_RenderSide, _RenderSide] | None
    orientation: Literal["upright", "bottom_up", "rotated"] | None
    resize: Literal["none", "pil_bilinear_pad", "jpeg_lanczos3", "torch_bilinear"] | None
    resize_size: tuple[_Side, _Side] | None
    crop: Annotated[float, Field(gt=0, le=1)] | None

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        size = self.resize_size
        if len(set(self.cameras)) != len(self.cameras):
            yield f"pixels.cameras is {list(self.cameras)}; expected each camera once"
        if self.resize == "none" and size is not None:
            yield f"pixels.resize_size is {list(size)}, but pixels.resize is none"
        if self.resize not in (None, "none") and size is None:
            yield f"pixels.resize is {self.resize}, but pixels.resize_size is null"
        if self.crop is not None and self.crop < 1 and self.resize in (None, "none"):
            yield (
                f"pixels.crop is {self.crop}, but pixels.resize is {self.resize or 'null'}: nothing says to which size"
            )


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

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        if self.source == "none" and self.order:
            yield f"proprioception.order is {list(self.order)}, but proprioception.source is none"
        if self.source == "observation":
            for name in ("order", "rotation", "dtype"):
                if not getattr(self, name):
                    yield f"proprioception.source is observation, but proprioception.{name} is not stated"


@dataclass(frozen=True)
class Language:
    """The instruction.

    Attributes:
        source: `file_name`, words of the task's name, or `bddl`, the task file's `:language`.
        template: Text with `{instruction}`.
    """

    source: Literal["file_name", "bddl"]
    template: str

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with the template."""
        if "{instruction}" not in self.template:
            yield f"language.template is {self.template!r}; it must have {{instruction}}"


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
        clock: Time that inference takes, and what is executed meanwhile, such as `latency=120ms,merge=replace`, see
            `libero_eval.protocols.clock`; empty for none.
    """

    unnorm_key: str | None
    unnorm_statistic: str | None
    unnorm_mask: str | None
    unnorm_clip: bool | None
    gripper: Literal["as_predicted", "sign", "open_sign", "open_cut"] | None
    chunk: _AtLeastOne | None
    replan: _AtLeastOne | None
    ensembling: str | None
    clock: str = ""

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        if self.clock:
            yield from _unlike_stored("action.clock", self.clock, lambda text: str(Clock.read(text)))
        if self.chunk is not None and self.replan is not None and self.replan > self.chunk:
            yield (
                f"action.replan is {self.replan}, but action.chunk is {self.chunk}: there are not as many actions"
            )


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
    denoising_steps: _AtLeastOne | None
    temperature: float | None
    precision: str | None
    batch: _AtLeastOne | None


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

    tasks: _AtLeastOne | None
    trials: _Steps | None
    interval: str | None
    checkpoint: str | None
    dataset: str | None


@dataclass(frozen=True)
class EvalProtocol:
    """A protocol; `EvalProtocol.read` checks the values.

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
    """

    name: str
    title: str
    world: Simulation
    episode: Episodes
    pixels: Pixels
    proprioception: Proprioception
    language: Language
    action: Actions
    sampling: Sampling
    counting: Counting
    sources: Mapping[str, str]

    def __post_init__(self) -> None:
        sections = (self.episode, self.pixels, self.action, self.proprioception, self.world, self.language)
        problems = [text for section in sections for text in section.problems()]
        if self.world.fixture_poses == "drawn" and "reset" not in self.episode.reset_order:
            problems.append(
                "world.fixture_poses are drawn, but episode.reset_order has no reset, which draws them"
            )
        valid = (*SECTIONS, *FIELDS)
        problems += [
            f"sources.{key} is not a key of a protocol.{suggest(key, valid)}"
            for key in self.sources
            if key not in valid
        ]
        if problems:
            raise ProtocolError("; ".join(problems))

    @classmethod
    def read(cls, values: Mapping[str, Any], where: str) -> "EvalProtocol":
        """Return the protocol of plain data, as of a file, or of `resolved`.

        Args:
            values: Section -> field -> value, with `name`, `title` and `sources`.
            where: File that messages name.

        Raises:
            ProtocolError: A field is missing or unknown, a value has the wrong type, or two contradict each other.
        """
        content = {"sources": {}} | {k: v for k, v in values.items() if k not in ("digest", "extends")}
        return validate(cls, content, source=where, error=ProtocolError)

    def flat(self) -> dict[str, Any]:
        """Return the values of all sections by dotted name, such as `world.env_seed`."""
        return {name: attrgetter(name)(self) for name in FIELDS}

    def resolved(self) -> dict[str, Any]:
        """Return the protocol as plain data, with a digest of everything that decides a result."""
        return {**asdict(self), "digest": self.digest}

    @property
    def digest(self) -> str:
        """Digest of all values, 16 hex digits; name, title and sources are not part of it, nor an empty clock."""
        values = self.flat()
        if not self.action.clock:
            del values["action.clock"]
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    def steps(self, task: Task) -> int:
        """Return the maximum number of the policy's steps on a task.

        Raises:
            ProtocolError: None is stated for the task's suite.
        """
        horizon = self.episode.horizon
        if isinstance(horizon, Mapping):
            own_suite = None if task.suite.startswith("libero_") else max(horizon.values())
            horizon = horizon.get(task.origin.suite, own_suite)
        if horizon is None:
            raise ProtocolError(f"protocol {self.name} states no episode.horizon for {task.suite}")
        return horizon - self.settle_steps * self.episode.settle_counted

    @property
    def settle_steps(self) -> int:
        """Number of steps before the policy acts."""
        return self.episode.settle_steps or 0

    def words(self, task: Task) -> str:
        """Return the instruction of a task."""
        return task.problem.language if self.language.source == "bddl" else task.language

    def prompt(self, task: Task) -> str:
        """Return the text that a policy receives: the instruction in the template."""
        return self.language.template.replace("{instruction}", self.words(task))

    def env_seed(self, task: Task, init_state: int) -> int | None:
        """Return the seed that the environment gets for an initial state; None where the poses are stored.

        Raises:
            ProtocolError: It is none that NumPy's generator takes.
        """
        world = self.world
        if world.fixture_poses == "stored" or world.env_seed is None or world.seeding == "once":
            return None if world.fixture_poses == "stored" else world.env_seed
        per_start, per_task = world.seed_per_start or 0, world.seed_per_task or 0
        seed = world.env_seed + per_start * init_state + per_task * task.index
        if not 0 <= seed <= _MAX_SEED:
            raise ProtocolError(
                f"protocol {self.name}: world.env_seed {world.env_seed}, seed_per_start {per_start} and seed_per_task "
                f"{per_task} give {task.id} in initial state {init_state} the seed {seed}; valid: 0 to {_MAX_SEED}"
            )
        return seed

    def require(self) -> None:
        """Check that the protocol states all that a run needs.

        Raises:
            ProtocolError: It does not, or states what no run offers; the message names the fields.
        """
        if self.episode.success == "final":
            raise ProtocolError(f"protocol {self.name} cannot be run: episodes end at success, not `final`")
        if self.action.ensembling not in (None, "none"):
            raise ProtocolError(
                f"protocol {self.name} cannot be run: answers are not combined, and action.ensembling is "
                f"{self.action.ensembling}"
            )
        needed = ["episode.settle_steps", "episode.horizon", "pixels.render_size", "pixels.orientation"]
        needed += ["pixels.resize", "proprioception.source", "action.gripper"]
        needed += ["episode.settle_action"] if self.episode.settle_steps else []
        needed += ["world.env_seed", "world.seeding"] if self.world.fixture_poses == "drawn" else []
        values = self.flat()
        if missing := [name for name in needed if values[name] is None]:
            raise ProtocolError(
                f"protocol {self.name} cannot be run: its source does not state {', '.join(missing)}. Write a file "
                f"with `extends: {self.name}` that does, and give its path to --protocol"
            )

    def changed(self, values: Mapping[str, Any]) -> "EvalProtocol":
        """Return a protocol with other values of some fields, by dotted name such as `episode.horizon`.

        Raises:
            ProtocolError: A value has the wrong type, or contradicts another.
        """
        content = asdict(self)
        for name, value in values.items():
            section, _, field = name.partition(".")
            content[section][field] = value
        return self.read(content, f"protocol {self.name}")

    def check(self, announced: Mapping[str, Any]) -> None:
        """Compare the protocol with what a policy announces of itself.

        Args:
            announced: Dotted name of a field, such as `action.chunk`, or a section with its fields -> value. Other
                names are ignored, as are fields that the protocol does not state.

        Raises:
            ProtocolMismatchError: Values differ; the message names both of each.
        """
        expected = {name: value for name, value in self.flat().items() if value is not None}
        by_section = {k: v for k, v in announced.items() if k in SECTIONS and isinstance(v, Mapping)}
        stated = {**announced, **{f"{s}.{k}": v for s, part in by_section.items() for k, v in part.items()}}
        wrong = [
            f"{name}: protocol {self.name} has {value!r}, the policy {shown(stated[name])}"
            for name, value in expected.items()
            if stated.get(name) is not None and plain(stated[name]) != plain(value)
        ]
        if wrong:
            raise ProtocolMismatchError(
                "the policy was made for another protocol; nothing was run. " + "; ".join(wrong)
            )


SECTIONS: dict[str, Any] = {part.name: part.type for part in fields(EvalProtocol) if is_dataclass(part.type)}
FIELDS = tuple(f"{section}.{field.name}" for section, kind in SECTIONS.items() for field in fields(kind))


def _unlike_stored(name: str, text: str, store: Callable[[str], str]) -> Iterator[str]:
    """Yield what is wrong with a text that is not written as it is stored."""
    try:
        if text != (stored := store(text)):
            yield f"{name} is {shown(text)}; in the words that are stored it is {shown(stored)}"
    except LiberoError as error:
        yield f"{name}: {error}"


def _stored_perturbations(text: str) -> str:
    from libero_env.perturbations import format_perturbations, parse_perturbations  # slow to import

    return format_perturbations(parse_perturbations(text, events=True))
