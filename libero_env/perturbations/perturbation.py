"""The dataclass `Perturbation`, its text (`camera=0.3,light=0.5`), and tasks as perturbations change them."""

from collections import OrderedDict
from collections.abc import Iterable, Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import AfterValidator, Field

from libero_env.doors import doors, enter
from libero_env.errors import InvalidInputError, require_known
from libero_env.perturbations.events import PHASES, checked_trigger
from libero_env.perturbations.kinds import Kind, Layer, SampleKey, first_attempt, sample_key
from libero_env.storage import read_yaml
from libero_env.tasks.task import Task
from libero_env.text import shown
from libero_env.validation import checked

if TYPE_CHECKING:
    from libero_env.sim.scene import Scene

_MODULES = {
    "start": "starts",
    "observation": "filters",
    "action": "filters",
}  # of others than the layer's own name


def _sample(layer: Layer, name: str, *args: Any) -> Any:
    """Sample a change by the module of its layer, which needs MuJoCo."""
    module = import_module(f"libero_env.perturbations.{_MODULES.get(layer, layer)}")
    return module.SAMPLERS[name](*args)


KINDS: Mapping[str, Kind] = {
    name: Kind(name, sample=partial(_sample, keys["layer"], name), **keys)
    for name, keys in read_yaml("perturbations/data/kinds.yaml").items()
} | {name: enter("kinds", name) for name in doors("kinds")}
"""All kinds by name, in the order in which they are applied; those of installed packages are the last."""

EXPECTED = (
    "expected KIND=SEVERITY, or several with commas between: camera=0.3,light=0.5; severities are from 0 to 1"
)
_MAX_CACHED = 256
_cached: OrderedDict[Any, Task] = OrderedDict()  # perturbed tasks


def get_kind(name: str) -> Kind:
    """Return a kind of perturbation.

    Raises:
        UnknownNameError: It does not exist; the message lists the kinds.
    """
    require_known("kind of perturbation", name, KINDS)
    return KINDS[name]


@checked
class Perturbation:
    """A change of a task or of its episodes.

    Attributes:
        kind: Name of the kind, see `libero_env.perturbations.KINDS`.
        severity: Severity in [0, 1]; 0 changes nothing, and the kind says what 1 is.
        seed: Seed of what is sampled.
        trigger: When it begins, see `libero_env.perturbations.events`; empty for the whole episode.

    Raises:
        UnknownNameError: The kind or the trigger do not exist.
        InvalidInputError: Severity or seed are out of range, or such a kind cannot begin during an episode.
    """

    kind: Annotated[str, AfterValidator(lambda name: get_kind(name).name)]
    severity: Annotated[float, Field(ge=0, le=1)]
    seed: Annotated[int, Field(ge=0, le=2**63 - 1)] = 0
    trigger: str = ""

    def __post_init__(self) -> None:
        _check_event(self.kind, self.trigger)

    @property
    def name(self) -> str:
        """Kind and trigger, such as `camera@lifted`; the kind alone without one."""
        return f"{self.kind}@{self.trigger}".rstrip("@")

    @property
    def definition(self) -> Kind:
        """Kind of the perturbation."""
        return KINDS[self.kind]

    @property
    def layer(self) -> Layer:
        """Layer that it acts on."""
        return self.definition.layer

    @property
    def amount(self) -> float:
        """Physical amount, in the unit of the kind."""
        return self.definition.amount(self.severity)

    def sample_name(self, task: str, start: object = "") -> str:
        """Return the name of a sample in the file of those that can be solved.

        Args:
            task: Id of the task without perturbations.
            start: Index of the initial state; empty for what is sampled once for the task.
        """
        return f"{task} {self.kind}={self.severity:g}@{self.seed} {start}".rstrip()

    def first_attempt(self, task: str, start: object = "") -> int:
        """Return the number of the first sample that may be used; see `sample_name`."""
        return first_attempt(self.sample_name(task, start))

    def key(self, task: str, start: object = "", attempt: int = 0) -> SampleKey:
        """Return the key of a sample; see `sample_key`."""
        return sample_key(self.kind, self.seed, task, start, attempt)

    def __str__(self) -> str:
        marks = [self.trigger] * bool(self.trigger) + [str(self.seed)] * bool(self.seed)
        return "@".join([f"{self.kind}={self.severity:g}", *marks])


def parse_perturbations(text: str, seed: int = 0, *, events: bool = False) -> tuple[Perturbation, ...]:
    """Return the perturbations of a text, in the order in which they are applied.

    Args:
        text: `KIND=SEVERITY` with commas between; `camera=0.3@7` has the seed 7.
        seed: Seed of those that name none.
        events: Whether some may begin during an episode: `camera=0.3@lifted`, `camera=0.3@lifted@7`.

    Raises:
        UnknownNameError: A kind or a trigger does not exist.
        InvalidInputError: A part has another form, a severity is out of range, or kinds exclude each other.
    """
    perturbations = []
    for part in filter(None, map(str.strip, text.split(","))):
        kind, _, rest = part.partition("=")
        severity, *marks = rest.split("@")
        get_kind(kind.strip())
        trigger = marks.pop(0) if events and marks and not marks[0].isdecimal() else ""
        _check_event(kind.strip(), trigger)
        try:
            own_seed = int("@".join(marks)) if marks else seed
            perturbations.append(Perturbation(kind.strip(), float(severity), own_seed, trigger))
        except ValueError:  # those of `Perturbation` too
            raise InvalidInputError(f"perturbation {shown(part)}: {EXPECTED}") from None
    return in_order(perturbations)


def in_order(perturbations: Iterable[Perturbation]) -> tuple[Perturbation, ...]:
    """Return perturbations in the order in which they are applied.

    Raises:
        InvalidInputError: A kind is named twice, or kinds exclude each other.
    """
    names = list(KINDS)
    ordered = sorted(perturbations, key=lambda one: (names.index(one.kind), one.trigger))
    for first, second in zip(ordered, ordered[1:], strict=False):
        if (first.kind, first.trigger) == (second.kind, second.trigger):
            raise InvalidInputError(f"perturbation {first.kind} is named twice: {first} and {second}")
    active = [one for one in ordered if one.severity]
    for one in active:
        rivals = [other.kind for other in active if other is not one and other.layer == one.layer]
        if one.definition.exclusive and rivals:
            raise InvalidInputError(f"perturbation {one.kind} cannot be combined with {', '.join(rivals)}")
    return tuple(ordered)


def replace_perturbations(
    perturbations: Iterable[Perturbation], others: Iterable[Perturbation]
) -> tuple[Perturbation, ...]:
    """Return perturbations and others, which take the place of those of the same kind.

    Raises:
        InvalidInputError: Kinds exclude each other.
    """
    by_kind = {(one.kind, one.trigger): one for one in (*perturbations, *others)}
    return in_order(by_kind.values())


def format_perturbations(perturbations: Iterable[Perturbation]) -> str:
    """Return the text of perturbations, in the order in which they are applied; without those of severity 0."""
    return ",".join(str(one) for one in in_order(perturbations) if one.severity)


def _check_event(kind: str, trigger: str) -> None:
    """Raise unless a kind can begin at a trigger."""
    if checked_trigger(trigger) and not KINDS[kind].can_begin:
        valid = ", ".join(name for name, one in KINDS.items() if one.can_begin)
        raise InvalidInputError(
            f"event {kind}@{trigger}: {kind} cannot begin during an episode; can: {valid}"
        )
    if kind == "object" and trigger in PHASES:
        raise InvalidInputError(
            f"event object@{trigger}: the robot touches the object then, so that it is not moved; expected "
            "object@step40 or object@25%"
        )


def perturb_task(task: Task, perturbations: Iterable[Perturbation], scene: "Scene") -> Task:
    """Return a task as perturbations change it; those of other layers, and events, are ignored.

    Suite, index and name stay, so that its results can be paired with those of the task without perturbations.

    Args:
        perturbations: Perturbations in the order in which they are applied.

    Raises:
        InvalidInputError: The task has no other goal.
        PlacementError: Objects cannot be moved so far.
    """
    active = tuple(
        one for one in perturbations if one.layer == "problem" and one.severity and not one.trigger
    )
    attempts = tuple(one.first_attempt(task.id) for one in active)
    cache_key = (task, active, attempts, scene.pack, scene.robot)
    if cache_key not in _cached:
        changed = task
        for one, attempt in zip(active, attempts, strict=True):
            rng = one.key(task.id, attempt=attempt).generator()
            changed = one.definition.sample(one.amount, rng, changed, scene)
        _cached[cache_key] = changed
        while len(_cached) > _MAX_CACHED:
            _cached.popitem(last=False)
    return _cached[cache_key]


def reword_task(task: Task, perturbations: Iterable[Perturbation]) -> Task:
    """Return a task in the words that perturbations give it, without its scene; those of other kinds are ignored."""
    for one in perturbations:
        if one.kind == "instruction" and one.severity:
            rng = one.key(task.id, attempt=one.first_attempt(task.id)).generator()
            return one.definition.sample(one.amount, rng, task, None)
    return task
