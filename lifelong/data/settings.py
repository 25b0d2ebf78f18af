"""Settings of the demonstrations that a policy learns from."""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import Field

from libero_env.assets.robot import DEFAULT_ROBOT, ROBOTS
from libero_env.demos.agreement import FACTS
from libero_env.demos.contents import LOW_DIM_KEYS
from libero_env.errors import LiberoError
from libero_env.perturbations import Perturbation, parse_perturbations
from libero_env.perturbations.episodes import rendered_perturbations
from libero_env.validation import OneOf, checked
from lifelong.errors import ConfigError
from lifelong.types import Natural, PathText, PolicySpec, Width

MEMORY = ("auto", "host", "pinned", "device", "disk")  # see `lifelong.data.loading`
# view -> camera in the model
CAMERAS = {"agentview_rgb": "agentview", "eye_in_hand_rgb": "robot0_eye_in_hand"}
# A text such as `light=1,camera=0.3`, or kinds with severities: on a command line `stream.perturb={light:1}` needs no
# quotes within quotes, which a text with = does.
PerturbSetting = str | Mapping[str, float | int]
Statistics = Literal["constants", "first", "latest", "seen", "stream"]


@checked
class DataSettings:
    """Settings of the demonstrations that a policy learns from; see configs/data.

    Attributes:
        demos: Number of demonstrations of each task.
        image_size: Height and width of the images, pixels.
        seq_len: Number of steps in a window of training data, T.
        views: Names of the images that the policy sees, keys of `CAMERAS`.
        proprio: Names of the proprioceptive readings that the policy sees, keys of `LOW_DIM_KEYS`.
        pairing: `aligned` pairs each action with the observation before it; `stored` reads files as they are.
        labels: `expert` learns the actions that the expert chose, `executed` those with noise that were executed.
        robot: Model of the arm in demonstrations and evaluation, see `libero_env.assets.robot`.
        files: Demonstration files of tasks of the run, which are the tasks that they state, and data sets of other
            tools, `lerobot:FOLDER` and `rlds:FOLDER`; other tasks have theirs in `folder`.
        folder: Folder of the demonstrations; None for `libero_env.paths.demos_dir()`.
        memory: Where frames are held, see `lifelong.data.loading`; batches do not depend on it.
        drawing: How images are drawn, in the demonstrations and in evaluations of the policy: `fast`, `faithful`, or
            None for the default of the models. The saved configuration of a run has the one that was used.
        perturb: Perturbations of further copies of the demonstrations, as for `stream.perturb`, from which windows are,
            too: the recorded states, rendered again. None: no copies.
        perturb_copies: Number of copies, each with draws of its own.
        perturb_seed: Seed of the first copy's draws; those of the others follow.
        seed: Seed of the expert's demonstrations: of their starts, motions and noise. None: 0 for those that are
            recorded, and any for those of `files` and `folder`.
        despite: In what demonstrations may differ from each other, `expert` (what recorded them) and `labels`, and from
            what the policy is evaluated on, `models`; None: in nothing.
        statistics: What policies normalise readings by (those of LeRobot actions, too): `constants`; or statistics of
            the frames of the `first` task (of what was learned before the stream, if anything was), of the `latest`, of
            all `seen` so far, or of the whole `stream`, later tasks included, which no learner can know. None: the
            policy's own choice.
    """

    demos: Annotated[int, Field(ge=1, le=100_000)]
    image_size: Width
    seq_len: Annotated[int, Field(ge=1, le=100_000)]
    views: Annotated[Sequence[Annotated[str, OneOf(CAMERAS)]], Field(min_length=1)]
    proprio: Sequence[Annotated[str, OneOf(LOW_DIM_KEYS)]]
    pairing: Literal["aligned", "stored"] = "aligned"
    labels: Literal["expert", "executed"] = "expert"
    robot: Annotated[str, OneOf(ROBOTS)] = DEFAULT_ROBOT
    files: Sequence[PathText] = ()
    folder: PathText | None = None
    memory: Annotated[str, OneOf(MEMORY)] = "auto"
    drawing: Literal["fast", "faithful"] | None = None
    perturb: PerturbSetting | None = None
    perturb_copies: Annotated[int, Field(ge=1, le=1000)] = 1
    perturb_seed: Natural = 0
    seed: Natural | None = None
    statistics: Statistics | None = None
    despite: Sequence[Annotated[str, OneOf(FACTS)]] | None = None

    def __post_init__(self) -> None:
        require_switched_on(self, "data", perturb=("perturb_copies", "perturb_seed"))
        for key in ("views", "proprio"):
            names = list(getattr(self, key))
            if len(set(names)) < len(names):
                raise ConfigError(f"data.{key} is {names}; expected each name once")
        if any(one.kind == "instruction" for one in self.perturbations()):
            raise ConfigError(
                "data.perturb has instruction, and copies are learned with the task's own; see stream.perturb"
            )

    @property
    def copies(self) -> int:
        """Number of further copies of each demonstration."""
        return self.perturb_copies if self.perturbations() else 0

    def perturbations(self) -> tuple[Perturbation, ...]:
        """Return the perturbations of the first copy.

        Raises:
            ConfigError: They are not valid.
        """
        return read_perturbations(self.perturb, "data.perturb", seed=self.perturb_seed, rendered=True)

    def spec(self, language_dim: int) -> PolicySpec:
        """Return the inputs and outputs of a policy for these data.

        Args:
            language_dim: Size of the embedding of an instruction.
        """
        return PolicySpec(
            views=tuple(self.views),
            image_size=(self.image_size, self.image_size),
            proprio={name: LOW_DIM_KEYS[name] for name in self.proprio},
            language_dim=language_dim,
            seq_len=self.seq_len,
            measured=self.statistics not in (None, "constants"),
        )


def require_switched_on(settings: Any, group: str, **parts: Sequence[str]) -> None:
    """Check that details of a feature are not chosen where the feature is off.

    Args:
        settings: Settings of a group, a dataclass.
        group: Name of the group, for error messages.
        parts: The key that switches a feature on -> the keys that have no effect where it has its default.

    Raises:
        ConfigError: Such a key has another value than its default.
    """
    defaults = {field.name: field.default for field in fields(settings)}
    for switch, keys in parts.items():
        for key in keys if getattr(settings, switch) == defaults[switch] else ():
            if getattr(settings, key) != defaults[key]:
                raise ConfigError(
                    f"{group}.{key} has no effect without {group}.{switch}; leave it out, or set both"
                )


def read_perturbations(
    value: PerturbSetting | None, key: str, *, seed: int = 0, rendered: bool = False
) -> tuple[Perturbation, ...]:
    """Return the perturbations of a setting, in the order in which they are applied.

    Args:
        value: The setting; None for no perturbations.
        key: Its name, for error messages.
        seed: Seed of those that name none.
        rendered: Whether recorded demonstrations are to be rendered under them.

    Raises:
        ConfigError: A kind does not exist, a severity is out of range or 0, or a kind cannot be rendered.
    """
    if value is None:
        return ()
    text = value if isinstance(value, str) else ",".join(f"{k}={v}" for k, v in value.items())
    try:
        perturbations = parse_perturbations(text, seed)
        if not all(one.severity for one in perturbations) or not perturbations:
            raise ConfigError("expected severities above 0; null is for no perturbations")
        return rendered_perturbations(perturbations) if rendered else perturbations
    except LiberoError as error:
        raise ConfigError(f"{key} is {text!r}: {error}") from error
