"""The sections of a protocol, with what their values may be and which of them contradict each other."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from pydantic import Field

from libero_env.errors import LiberoError
from libero_env.text import shown
from libero_env.timing import ControlFreq
from libero_eval.protocols.clock import Clock

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")

# upper bounds are what no protocol means, and no machine does in a life
_AtLeastOne = Annotated[int, Field(ge=1)]
_Steps = Annotated[int, Field(ge=1, le=1_000_000)]
MAX_SEED = 2**32 - 1
_EnvSeed = Annotated[int, Field(ge=0, le=MAX_SEED)]
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
        success: `first_hit`: the episode ends when the goal holds; `accumulated`: the goal must have held at any time.
        errors: What an error of the policy does: `failure`, the episode counts as one; `stop`, the evaluation ends.
        observed: When observations are taken: `substep`, as the original does, before the last physics step of a
            control step; `after`, after it.
    """

    reset_order: tuple[_Call, ...]
    settle_steps: Annotated[int, Field(ge=0, le=10_000)] | None
    settle_action: _Action | None
    settle_counted: bool
    horizon: _Steps | Mapping[str, _Steps] | None
    success: Literal["first_hit", "accumulated"]
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
    clock: str = ""

    def problems(self) -> Iterator[str]:
        """Yield which values contradict each other."""
        if "trace:" in self.clock:
            yield f"action.clock is {shown(self.clock)}; a protocol has the latencies, and only --clock names a file"
        elif self.clock:
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
