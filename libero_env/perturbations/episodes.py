"""Perturbed episodes of several simulations: what is sampled at a reset, and what acts until the next."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from libero_env.errors import InvalidInputError, PlacementError
from libero_env.perturbations.appearance import CAMERA
from libero_env.perturbations.events import NEVER
from libero_env.perturbations.kinds import (
    ActionFilter,
    Episode,
    Layer,
    ObservationFilter,
    StartChange,
    sample_key,
)
from libero_env.perturbations.pairing import Pairing
from libero_env.perturbations.perturbation import KINDS, Perturbation, in_order, parse_perturbations
from libero_env.sim.appearance import Appearance, CameraView, joined
from libero_env.sim.scene import Scene
from libero_env.tasks import Task
from libero_env.tasks.problem import Problem
from libero_env.text import shown

TRIES = 200  # samples of a start until one is valid
_NAME_BYTES = 32  # of an index, a digest or a demonstration
_NEEDS_SCENE = ("appearance", "start")
Change = Appearance | StartChange | ObservationFilter | ActionFilter


def checked_perturbations(value: object) -> tuple[Perturbation | Change, ...]:
    """Return perturbations and absolute changes, those of severity 0 left out; a text is parsed.

    Args:
        value: Text such as `camera=0.3,light=0.5`, or perturbations and changes.

    Raises:
        UnknownNameError: A kind does not exist.
        InvalidInputError: A value is of another kind, out of range, or given twice.
    """
    if isinstance(value, str):
        return tuple(one for one in parse_perturbations(value, events=True) if one.severity)
    if not isinstance(value, Iterable) or isinstance(value, Mapping | bytes):
        raise InvalidInputError(f"perturb is {shown(value)}; expected a text such as camera=0.3,light=0.5")
    given = tuple(value)
    if odd := [one for one in given if not isinstance(one, Perturbation | Change)]:
        raise InvalidInputError(
            f"perturb has {shown(odd[0])}; expected a Perturbation, or a change such as an Appearance"
        )
    sampled = in_order(one for one in given if isinstance(one, Perturbation))
    return (
        *(one for one in sampled if one.severity),
        *(one for one in given if not isinstance(one, Perturbation)),
    )


def rendered_perturbations(perturb: object) -> tuple[Perturbation, ...]:
    """Return perturbations under which recorded states can be rendered, those of severity 0 left out.

    Raises:
        UnknownNameError: A kind of perturbation does not exist.
        InvalidInputError: A perturbation is not valid, or changes what happens and not only what is seen or said.
    """
    rendered = []
    for one in checked_perturbations(perturb):
        if not isinstance(one, Perturbation) or one.trigger or not one.definition.is_rendered:
            valid = ", ".join(kind.name for kind in KINDS.values() if kind.is_rendered)
            raise InvalidInputError(
                f"{one} changes what happens, and recorded demonstrations show what happened without it; valid: {valid}"
            )
        rendered.append(one)
    return tuple(rendered)


def needs_materials(changes: Iterable[Perturbation | Change]) -> bool:
    """Return whether scenes need spare materials."""
    return any(
        one.definition.needs_materials
        if isinstance(one, Perturbation)
        else bool(getattr(one, "materials", None))
        for one in changes
    )


class PerturbedEpisodes:
    """Samples and filters of the episodes of several simulations.

    Args:
        changes: Perturbations and absolute changes, of `checked_perturbations`.
        task: Task without perturbations.
        num: Number of simulations.

    Attributes:
        perturbations: Perturbations, which are sampled for each start.
        has_memory: Whether an observation depends on earlier images.
        attempts: Number of the sample that is used, from 0, of each simulation and perturbation, (num, n): how many
            before it were not valid, or not solved.
        steps: Number of control steps of each episode, (num,).
        events: Positions of the perturbations that begin during an episode.
        began: Number of control steps before each of them, (num, events); `NEVER` until then.
        moved: Whether one has just changed what is to be done, (num,).
        event_states: States just after events have begun, by simulation and event, of the present episodes.
    """

    def __init__(
        self, changes: Sequence[Perturbation | Change], task: Task, base: Scene, scene: Scene, num: int
    ):
        self.perturbations = tuple(one for one in changes if isinstance(one, Perturbation))
        self._fixed = tuple(one for one in changes if not isinstance(one, Perturbation))
        self._task, self._scene, self._pairing = task, scene, Pairing(base, scene)
        self.attempts = np.zeros((num, len(self.perturbations)), np.int64)
        self.steps = np.zeros(num, np.int64)
        self.events = [k for k, one in enumerate(self.perturbations) if one.trigger]
        self.began = np.full((num, len(self.events)), NEVER)
        self.moved, self.event_states = np.zeros(num, bool), dict[tuple[int, int], np.ndarray]()
        self._filters: dict[Layer, list[list[tuple[Any, Episode]]]] = {
            "observation": [[] for _ in range(num)],
            "action": [[] for _ in range(num)],
        }
        self._starts = np.zeros((num, _NAME_BYTES), np.uint8)  # their names in UTF-8
        sampled = [k for k, one in enumerate(self.perturbations) if one.layer == "observation"]
        filters = (*self._fixed_of("observation"), *(self._sample(k, "") for k in sampled))
        for k, one in enumerate(self.perturbations):  # refused before anything runs, without what it needs
            if one.layer in _NEEDS_SCENE:
                self._sample(k, "")
        self.has_memory = any(one.has_memory for one in filters)
        self._require_one_view()

    def _require_one_view(self) -> None:
        """Raise where a sampled view of the agent's camera would replace one that was given."""
        view = joined(self._fixed_of("appearance")).cameras.get(CAMERA, CameraView())
        model = self._scene.model
        index, by_kind = model.camera(CAMERA).id, {one.kind: one for one in self.perturbations}
        for kind, given, own in (
            ("camera", view.pos, model.cam_pos),
            ("camera", view.quat, model.cam_quat),
            ("fov", view.fovy, model.cam_fovy),
        ):
            if kind in by_kind and given is not None and not np.allclose(given, own[index], atol=1e-3):
                raise InvalidInputError(
                    f"{self._task.id}: perturb={by_kind[kind]} changes the view of {CAMERA}, which is another already, "
                    "of the task or given as a change; leave one of them out"
                )

    @property
    def is_physical(self) -> bool:
        """Whether the goal could hold at a start because of what was changed."""
        return bool(self._fixed_of("start")) or self.samples_starts or bool(self._of("problem"))

    @property
    def samples_starts(self) -> bool:
        """Whether starts are sampled, so that another sample may be valid where one is not."""
        return bool(self._of("start"))

    def paired(self, i: int, start: object, row: np.ndarray) -> np.ndarray:
        """Return the start of the perturbed task that belongs to one of the task without perturbations.

        Args:
            i: Index of the simulation.
            start: Index of the initial state, or another name.
            row: State of the task without perturbations.

        Raises:
            PlacementError: There is none.
        """
        problem = self._of("problem")
        seeds = {one.kind: one.seed for one in (self.perturbations[k] for k in problem)}
        first = max((self._first(k, start) for k in problem), default=0)
        of_kinds = (seeds.get(kind, 0) for kind in ("objects", "distractors"))
        keys = [sample_key("pairing", seed, self._task.id, start) for seed in of_kinds]
        paired, attempt = self._pairing.row(row, keys, first)
        self.attempts[i] = 0
        self.attempts[i, problem] = [attempt + self._first(k, "") for k in problem]
        return paired

    def begin(self, i: int, start: object, row: np.ndarray, again: int = 0) -> np.ndarray:
        """Begin an episode: sample all that is sampled for it, and return the state that it starts in.

        Args:
            i: Index of the simulation.
            start: Index of the initial state, or another name.
            row: Start of the perturbed task.
            again: Number of starts that were sampled already and are not valid.

        Raises:
            PlacementError: No sample of a start is valid.
        """
        for k in self._of("action"):
            self.attempts[i, k] = self._first(k, start)
        for change in self._fixed_of("start"):
            if (moved := change.apply(self._scene, row)) is None:
                raise PlacementError(f"{self._task.id}, start {start}: {change} is not possible")
            row = moved
        for k in self._of("start"):
            row = self._sampled_start(i, k, start, row, again)
        self.open(i, start)
        return row

    def open(self, i: int, start: object) -> None:
        """Begin the observations and actions of the episode of a start in simulation i."""
        self._starts[i] = np.frombuffer(str(start).encode().ljust(_NAME_BYTES, b"\0")[:_NAME_BYTES], np.uint8)
        self.resume(i, 0, begins=True)

    def resume(self, i: int, steps: int, *, begins: bool) -> None:
        """Go on with the episode of simulation i after so many steps; filters with a memory begin a new one.

        Args:
            i: Index of the simulation.
            steps: Number of control steps since the reset.
            begins: Whether no event has begun or failed to; otherwise `kept` says which.
        """
        self.steps[i] = steps
        if begins:
            self.began[i], self.attempts[i, self.events] = NEVER, 0
        for layer, filters in self._filters.items():
            filters[i] = self._opened(layer, self._start(i), i)

    def kept(self, i: int) -> list[np.ndarray]:
        """Return views of what belongs to the state of simulation i: its start, samples, and steps of events."""
        return [self._starts[i], self.attempts[i], self.began[i]]

    def _start(self, i: int) -> str:
        """Return the name of the start of simulation i."""
        return self._starts[i].tobytes().rstrip(b"\0").decode(errors="replace")

    def appearance(self, i: int) -> Appearance:
        """Return the appearance of simulation i; what is sampled for its start goes before absolute changes."""
        sampled = (self._sample(k, self._start(i)) for k in self._of("appearance", i))
        return joined([*self._fixed_of("appearance"), *sampled])

    def has_new_goal(self, i: int) -> bool:
        """Return whether an event has changed the goal of simulation i."""
        return any(self.perturbations[k].trigger for k in self._of("problem", i))

    def begin_event(self, i: int, event: int, row: np.ndarray) -> np.ndarray:
        """Let an event begin in simulation i, and return the state that it leaves; the same unless it moves something.

        Args:
            i: Index of the simulation.
            event: Position in `events`.
            row: State [time, qpos, qvel, poses of the fixtures].

        Raises:
            PlacementError: No sample of what it moves is valid; it does not happen.
        """
        k, start = self.events[event], self._start(i)
        one = self.perturbations[k]
        self.attempts[i, k] = TRIES  # unless one is valid
        if one.layer == "start":
            row = self._sampled_start(i, k, start, row, 0)
        self.began[i, event] = self.steps[i]
        if one.layer != "start":
            self.attempts[i, k] = self._first(k, start) if one.layer == "action" else 0
        if one.layer in self._filters:
            self._filters[one.layer][i].append(self._open_filter(k, start))
        return row

    def act(self, ids: Sequence[int] | np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the actions that are executed, for those that were chosen, (num, A), and count the step."""
        executed = actions.astype(np.float64)
        for i in ids:
            for one, episode in self._at_step("action", i):
                executed[i] = one.act(executed[i], episode)
            self.steps[i] += 1
        return executed

    def see_images(self, ids: Sequence[int] | np.ndarray, images: dict[str, np.ndarray]) -> None:
        """Replace rows `ids` of rendered images by what arrives of them."""
        for i in ids:
            for one, episode in self._at_step("observation", i):
                for name, rows in images.items():
                    if name.endswith("_rgb") or not one.only_rgb:
                        rows[i] = one.image(name, rows[i], episode)

    def see_state(self, entries: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return what arrives of the entries that are not images, name -> (num, n), whose rows are overwritten."""
        for i in range(len(self.steps)):
            for one, episode in self._at_step("observation", i):
                state = one.state({name: rows[i].copy() for name, rows in entries.items()}, episode)
                for name, values in state.items():
                    entries[name][i] = values
        return entries

    def _of(self, layer: Layer, i: int | None = None) -> list[int]:
        """Return the positions of the perturbations of a layer; of events those that have begun in simulation i."""
        steps = () if i is None else zip(self.events, self.began[i], strict=True)
        begun = [k for k, at in steps if at != NEVER]
        found = [k for k, one in enumerate(self.perturbations) if one.layer == layer]
        return [k for k in found if k not in self.events or k in begun]

    def _fixed_of(self, layer: Layer) -> list[Any]:
        """Return the absolute changes of a layer."""
        return [one for one in self._fixed if one.layer == layer]

    def _first(self, k: int, start: object) -> int:
        """Return the number of the first sample of a perturbation that may be used for a start."""
        return self.perturbations[k].first_attempt(self._task.id, start)

    def _sample(self, k: int, start: object, attempt: int = 0) -> Any:
        """Return the change that a perturbation samples for a start."""
        one = self.perturbations[k]
        if one.layer == "action":
            attempt = self._first(k, start)
        rng = one.key(self._task.id, start, attempt).generator()
        return one.definition.sample(one.amount, rng, *([self._scene] if one.layer in _NEEDS_SCENE else []))

    def _sampled_start(self, i: int, k: int, start: object, row: np.ndarray, again: int) -> np.ndarray:
        first = self._first(k, start) + again
        for attempt in range(first, first + TRIES):
            moved = self._sample(k, start, attempt).apply(self._scene, row)
            if moved is not None:
                self.attempts[i, k] = attempt
                return moved
        raise PlacementError(
            f"{self._task.id}, start {start}: none of {TRIES} samples of {self.perturbations[k]} is valid"
        )

    def _opened(self, layer: Layer, start: object, i: int) -> list[tuple[Any, Episode]]:
        """Return the filters of a layer, each with its episode: fixed ones, then those that are sampled."""
        task, opened = self._task.id, []
        for j, one in enumerate(self._fixed_of(layer)):
            opened.append((one, Episode(sample_key(f"fixed {j}", 0, task, start))))
        return [*opened, *(self._open_filter(k, start) for k in self._of(layer, i))]

    def _open_filter(self, k: int, start: object) -> tuple[Any, Episode]:
        one = self.perturbations[k]
        attempt = self._first(k, start) if one.layer == "action" else 0
        return self._sample(k, start), Episode(one.key(self._task.id, start, attempt))

    def _at_step(self, layer: Layer, i: int) -> list[tuple[Any, Episode]]:
        """Return the filters of simulation i, whose episodes are at its step."""
        filters = self._filters[layer][i]
        for _, episode in filters:
            episode.step = int(self.steps[i])
        return filters


def scene_problem(task: Task, base: Task) -> Problem:
    """Return the problem that the scene of a perturbed task is built from: one in other words needs no other scene."""
    if task.problem.language == base.problem.language:
        return task.problem
    return replace(task.problem, language=base.problem.language)
