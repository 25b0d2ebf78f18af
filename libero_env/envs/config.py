"""Configuration that the environments share."""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, TypedDict, TypeVar

import numpy as np
from pydantic import Field

from libero_env.assets.pack import Pack
from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.perturbations.episodes import checked_perturbations
from libero_env.sim.engine import MUJOCO, BackEnd
from libero_env.sim.observations import DEFAULT_CAMERAS, DEFAULT_OBSERVATIONS
from libero_env.sim.predicates import SEMANTICS
from libero_env.sim.scene import DRAWINGS
from libero_env.text import shown
from libero_env.validation import validate_arguments

AFTER, SUBSTEP = OBSERVED = ("after", "substep")
Pixels = Annotated[int, Field(ge=1)]  # the renderer knows the largest size
Horizon = Annotated[int, Field(ge=1, le=10**9)]
Constructor = TypeVar("Constructor", bound=Callable[..., None])


@dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Configuration of an environment, the same for one simulation and for many.

    Attributes:
        cameras: Names of the cameras that are rendered for each observation; empty for none.
        camera_size: Height and width of the images, pixels.
        horizon: Number of steps after which an episode is truncated.
        observations: Names of observations, see `libero_env.sim.observations`.
        controller: Name of the controller, which defines the action, see `libero_env.sim.controller`.
        control_delta: Whether actions are relative to the current pose.
        reward: `sparse` or `staged`, see `libero_env.sim.rewards`.
        reward_scale: Reward of success.
        assets: Asset pack of the models: a `Pack`, `builtin`, `original`, a folder, or None for the user's choice.
        semantics: Semantics of the predicates: `original`, or `strict`, see `libero_env.sim.predicates`.
        drawing: How images are drawn: `faithful`, `fast`, or None for the pack's default, see `libero_env.sim.scene`.
        robot: Model of the arm: `libero`, or `robosuite-1.4.1`, see `libero_env.assets.robot`.
        observed: When a step is observed: `after` it, or in its last `substep` but one, as by the original: joints
            2 ms, poses and images 4 ms before the end.
        backend: Back end of the physics: `mujoco`, or `warp` for many simulations on a GPU, with settings as in
            `warp,device=cuda:1,contacts=256`, see `libero_env.sim.engine`.
        perturb: Perturbations, as text such as `camera=0.3,light=0.5` or as values, see `libero_env.perturbations`; the
            default is none.

    Raises:
        InvalidInputError: A value is of another kind or outside of its range.
        UnknownNameError: The semantics, the drawing, the robot, the back end or the time of observation do not exist.
    """

    cameras: Sequence[str] = DEFAULT_CAMERAS
    camera_size: tuple[Pixels, Pixels] = (128, 128)
    horizon: Horizon = 600
    observations: Sequence[str] = DEFAULT_OBSERVATIONS
    controller: str = "osc_pose"
    control_delta: bool = True
    reward: str = "sparse"
    reward_scale: float = 1.0
    assets: Pack | str | Path | None = None
    semantics: str = "original"
    drawing: str | None = None
    robot: str = DEFAULT_ROBOT
    observed: str = AFTER
    backend: BackEnd | str = MUJOCO
    perturb: str | Sequence[Any] = ()

    def __post_init__(self) -> None:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name in ("cameras", "camera_size", "observations"):
            if isinstance(values[name], Iterable) and not isinstance(values[name], str | bytes | Mapping):
                values[name] = tuple(values[name])
        if isinstance(values["camera_size"], tuple):
            values["camera_size"] = tuple(map(_whole, values["camera_size"]))
        values["horizon"] = _whole(self.horizon)
        values["perturb"] = checked_perturbations(self.perturb)
        values["backend"] = BackEnd.read(self.backend)
        validate_arguments(EnvConfig, values)
        assets = values["assets"]
        if not (assets is None or isinstance(assets, str | Path) or hasattr(assets, "add_arena")):
            raise InvalidInputError(
                f"assets is {shown(assets)}; expected builtin, original, a folder, or a Pack"
            )
        for name, value in values.items():
            object.__setattr__(self, name, value)
        if self.semantics not in SEMANTICS:
            raise UnknownNameError("semantics", self.semantics, SEMANTICS)
        if self.drawing is not None and self.drawing not in DRAWINGS:
            raise UnknownNameError("drawing", self.drawing, DRAWINGS)
        if self.robot not in ROBOTS:
            raise UnknownNameError("robot", self.robot, ROBOTS)
        if self.observed not in OBSERVED:
            raise UnknownNameError("time of observation", self.observed, OBSERVED)

    @property
    def back_end(self) -> BackEnd:
        """Back end of the physics."""
        return BackEnd.read(self.backend)

    @classmethod
    def from_options(cls, config: "EnvConfig | None", options: Mapping[str, Any]) -> "EnvConfig":
        """Return a configuration with some of its fields replaced.

        Args:
            config: Configuration to start from; None for the default values.
            options: Fields to replace, by name.

        Raises:
            InvalidInputError: `config` is no configuration, or a value is not valid.
            UnknownNameError: An option is not a field; the message lists the fields and names the nearest.
        """
        if not (config is None or isinstance(config, cls)):
            raise InvalidInputError(f"config is {shown(config)}; expected an EnvConfig or None")
        names = [field.name for field in fields(cls)]
        for name in options:
            if name not in names:
                raise UnknownNameError("environment option", name, names)
        return replace(config or cls(), **options)


def _whole(value: Any) -> Any:
    """Return a whole number of any type as int; other values as they are."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return int(value) if isinstance(value, np.integer) else value


class EnvOptions(TypedDict, total=False):
    """Fields of `EnvConfig` as keyword arguments."""

    cameras: Sequence[str]
    camera_size: tuple[int, int]
    horizon: int
    observations: Sequence[str]
    controller: str
    control_delta: bool
    reward: str
    reward_scale: float
    assets: Pack | str | Path | None
    semantics: str
    drawing: str | None
    robot: str
    observed: str
    backend: BackEnd | str
    perturb: str | Sequence[Any]


def show_options(constructor: Constructor) -> Constructor:
    """Show the fields of `EnvConfig` in the signature of a constructor that takes them as `**options`."""
    signature = inspect.signature(constructor)
    parameters = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    parameters += inspect.signature(EnvConfig).parameters.values()
    constructor.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return constructor
