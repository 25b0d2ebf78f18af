"""Configuration that the environments share."""

import inspect
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import KW_ONLY, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, PlainValidator

from libero_env.assets.pack import Pack, select_pack
from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS
from libero_env.doors import enter
from libero_env.errors import InvalidInputError, require_known
from libero_env.sim.backend import Backend
from libero_env.sim.observations import DEFAULT_CAMERAS, DEFAULT_OBSERVATIONS
from libero_env.sim.predicates import SEMANTICS
from libero_env.sim.scene_spec import DRAWINGS
from libero_env.tasks.cameras import camera_text, distinct_cameras
from libero_env.text import shown
from libero_env.timing import CONTROL_HZ, PHYSICS_HZ, ControlFreq
from libero_env.validation import checked

AFTER, SUBSTEP = OBSERVED = ("after", "substep")
_LARGEST_OBSERVED_WITHIN = PHYSICS_HZ // 4  # [Hz]
Constructor = TypeVar("Constructor", bound=Callable[..., None])


def _tuple(value: Any) -> Any:
    """Return any iterable but a text or a mapping as a tuple."""
    listed = isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping)
    return tuple(value) if listed else value


def _number(value: Any) -> Any:
    """Return a number of NumPy as Python's, and a float without a fraction as int."""
    value = value.item() if isinstance(value, np.generic) else value
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _square(value: Any) -> Any:
    """Return one number as height and width."""
    number = _number(value)
    return (number, number) if isinstance(number, int) and not isinstance(number, bool) else _tuple(value)


def _assets(value: Any) -> Any:
    if value is None or isinstance(value, str | Path) or hasattr(value, "add_arena"):
        return value
    raise InvalidInputError(f"assets is {shown(value)}; expected builtin, original, a folder, or a Pack")


def _perturbations(value: Any) -> tuple[Any, ...]:
    return enter("perturbations", "read")(value) if value or value is None else ()


def _known(kind: str, names: Collection[str]) -> AfterValidator:
    """Return the check that a text is one of some names."""

    def check(value: str) -> str:
        require_known(kind, value, names)
        return value

    return AfterValidator(check)


Pixels = Annotated[int, BeforeValidator(_number), Field(ge=1)]  # the renderer knows the largest size
Size = Annotated[tuple[Pixels, Pixels], BeforeValidator(_square)]
Cameras = Annotated[
    tuple[Annotated[str, BeforeValidator(camera_text)], ...],
    BeforeValidator(_tuple),
    AfterValidator(distinct_cameras),
]
Names = Annotated[tuple[str, ...], BeforeValidator(_tuple)]
Assets = Annotated[Pack | str | Path | None, PlainValidator(_assets)]
Drawing = Annotated[str, _known("drawing", DRAWINGS)]
Robot = Annotated[str, _known("robot", ROBOTS)]


@checked
class EnvConfig:
    """Configuration of an environment, the same for one simulation and for many.

    Attributes:
        cameras: Cameras that are rendered for each observation, empty for none: names of those of the scene, and each a
            `libero_env.Camera`, or its text, that is added to it.
        camera_size: Height and width of the images, pixels; one number is both.
        horizon: Number of control steps after which an episode is truncated, whatever their length.
        observations: Names of observations, see `libero_env.sim.observations`.
        control_freq: Control steps per second, [Hz]; it divides 500, the physics steps per second.
        controller: Name of the controller, which defines the action, see `libero_env.sim.controller`.
        control_delta: Whether actions are relative to the current pose.
        reward: `sparse` or `staged`, see `libero_env.sim.rewards`.
        reward_scale: Reward of success.
        assets: Asset pack of the models: a `Pack`, `builtin`, `original`, a folder, or None for the user's choice.
        semantics: Semantics of the predicates: `original`, or `strict`, see `libero_env.sim.predicates`.
        drawing: Quality of the images: `faithful`, `fast`, or None for the pack's default, see `libero_env.sim.scene`.
        robot: Model of the arm: `libero`, or `robosuite-1.4.1`, see `libero_env.assets.robot`.
        observed: When a step is observed: `after` it, or in its last `substep` but one, as by the original: joints
            2 ms, poses and images 4 ms before the end.
        backend: Backend of the physics: `mujoco`, or `warp` for many simulations on a GPU, with settings as in
            `warp,device=cuda:1,contacts=256`, see `libero_env.sim.backend`.
        perturb: Perturbations, as text such as `camera=0.3,light=0.5` or as values, see `libero_env.perturbations`; the
            default is none.

    Raises:
        InvalidInputError: A value is of another kind or outside of its range, or a perturbation does not fit them.
        UnknownNameError: The semantics, the drawing, the robot, the backend or the time of observation do not exist.
    """

    _: KW_ONLY
    cameras: Cameras = DEFAULT_CAMERAS
    camera_size: Size = (128, 128)
    horizon: Annotated[int, BeforeValidator(_number), Field(ge=1, le=10**9)] = 600
    observations: Names = DEFAULT_OBSERVATIONS
    control_freq: Annotated[ControlFreq, BeforeValidator(_number)] = CONTROL_HZ
    controller: str = "osc_pose"
    control_delta: bool = True
    reward: str = "sparse"
    reward_scale: Annotated[float, BeforeValidator(_number)] = 1.0
    assets: Assets = None
    semantics: Annotated[str, _known("semantics", SEMANTICS)] = "original"
    drawing: Drawing | None = None
    robot: Robot = DEFAULT_ROBOT
    observed: Annotated[str, _known("time of observation", OBSERVED)] = AFTER
    backend: Annotated[Backend, PlainValidator(Backend.read)] = Backend()
    perturb: Annotated[tuple[Any, ...], PlainValidator(_perturbations)] = ()

    def __post_init__(self) -> None:
        if self.observed == SUBSTEP and self.control_freq > _LARGEST_OBSERVED_WITHIN:
            raise InvalidInputError(
                f"observed is {SUBSTEP}, which looks two physics steps before the end of a control step; at "
                f"control_freq {self.control_freq} there are not as many: expected at most "
                f"{_LARGEST_OBSERVED_WITHIN}, or observed={AFTER}"
            )
        if self.perturb:
            enter("perturbations", "check")(self)

    @property
    def pack(self) -> Pack:
        """Asset pack of the models."""
        return select_pack(self.assets)

    @classmethod
    def from_options(cls, config: "EnvConfig | None", options: Mapping[str, Any]) -> "EnvConfig":
        """Return a configuration with some of its fields replaced.

        Args:
            config: Configuration to start from; None for the default values.
            options: Fields to replace, by name.

        Raises:
            InvalidInputError: `config` is not a configuration, or a value is not valid.
            UnknownNameError: An option is not a field; the message lists the fields and names the nearest.
        """
        if not (config is None or isinstance(config, cls)):
            raise InvalidInputError(f"config is {shown(config)}; expected an EnvConfig or None")
        names = [field.name for field in fields(cls)]
        for name in options:
            require_known("environment option", name, names)
        return replace(config or cls(), **options)


def show_options(constructor: Constructor) -> Constructor:
    """Show the fields of `EnvConfig` in the signature of a constructor that takes them as `**options`."""
    signature = inspect.signature(constructor)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    types = get_type_hints(EnvConfig)
    parameters += [p.replace(annotation=types[n]) for n, p in inspect.signature(EnvConfig).parameters.items()]
    constructor.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return constructor
