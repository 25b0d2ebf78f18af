"""Perturbed episodes of simulations: what is drawn at a reset, and what acts until the next."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from libero_env.errors import InvalidInputError, PlacementError
from libero_env.perturbations.channels import (
    ActionChannel,
    ActionFilter,
    ObservationChannel,
    ObservationFilter,
)
from libero_env.perturbations.drawing import DrawKey, draw_key
from libero_env.perturbations.draws import first_attempt
from libero_env.perturbations.kind import Layer
from libero_env.perturbations.pairing import Pairing
from libero_env.perturbations.starts import StartChange
from libero_env.perturbations.value import Perturbation, in_order, parse_perturbations
from libero_env.sim.look import Look, joined
from libero_env.sim.scene import Scene
from libero_env.tasks import Task
from libero_env.tasks.problem import Problem
from libero_env.text import shown

Change = Look | StartChange | ObservationFilter | ActionFilter
TRIES = 200  # draws of a start until one is valid


def checked_perturbations(value: object) -> tuple[Perturbation | Change, ...]:
    """Return perturbations and absolute changes, those of severity 0 left out; a text is parsed.

    Args:
        value: Text such as `camera=0.3,light=0.5`, or perturbations and changes.

    Raises:
        UnknownNameError: A kind does not exist.
        InvalidInputError: A value is of another kind, out of range, or given twice.
    """
    if isinstance(value, str):
        return tuple(one for one in parse_perturbations(value) if one.severity)
    if not isinstance(value, Iterable) or isinstance(value, Mapping | bytes):
        raise InvalidInputError(f"perturb is {shown(value)}; expected a text such as camera=0.3,light=0.5")
    given = tuple(value)
    for one in given:
        if not isinstance(one, Perturbation | Change):
            raise InvalidInputError(
                f"perturb has {shown(one)}; expected a Perturbation, or a change that it could draw, such as a Look"
            )
    drawn = in_order(one for one in given if isinstance(one, Perturbation))
    fixed = tuple(one for one in given if not isinstance(one, Perturbation))
    return (*(one for one in drawn if one.severity), *fixed)


def needs_materials(changes: Iterable[Perturbation | Change]) -> bool:
    """Return whether scenes need materials to draw with."""
    return any(
        one.definition.draws_materials
        if isinstance(one, Perturbation)
        else isinstance(one, Look) and one.materials
        for one in changes
    )


class PerturbedEpisodes:
    """Draws and filters of the episodes of several simulations.

    Args:
        changes: Perturbations and absolute changes, of `checked_perturbations`.
        task: Task without perturbations.
        base: Scene of that task.
        scene: Scene of the perturbed task.
        num: Number of simulations.

    Attributes:
        perturbations: Perturbations, which are drawn for each start.
        has_memory: Whether an observation depends on earlier images.
        attempts: Number of the draw that is used, from 0, of each simulation and perturbation, (num, n): how many
            before it were not valid, or not solved.
        steps: Number of control steps of each episode, (num,).
    """

    def __init__(
        self, changes: Sequence[Perturbation | Change], task: Task, base: Scene, scene: Scene, num: int
    ):
        self.perturbations = tuple(one for one in changes if isinstance(one, Perturbation))
        self._fixed = tuple(one for one in changes if not isinstance(one, Perturbation))
        self._task, self._scene, self._pairing = task, scene, Pairing(base, scene)
        self.attempts = np.zeros((num, len(self.perturbations)), np.int64)
        self.steps = np.zeros(num, np.int64)
        self._seen: list[list[ObservationChannel]] = [[] for _ in range(num)]
        self._done: list[list[ActionChannel]] = [[] for _ in range(num)]
        self._starts: list[object] = [""] * num
        filters = [f for f in self._fixed if isinstance(f, ObservationFilter)]
        filters += [self._draw(k, "") for k in self._of("observation")]
        self.has_memory = any(one.has_memory for one in filters)

    @property
    def is_physical(self) -> bool:
        """Whether the goal could hold at a start because of what was changed."""
        starts = any(isinstance(one, StartChange) for one in self._fixed)
        return starts or self.draws_starts or bool(self._of("problem"))

    @property
    def draws_starts(self) -> bool:
        """Whether starts are drawn, so that another draw may be valid where one is not."""
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
        seeds = [self.perturbations[k].seed for k in problem]
        first = max((self._first(k, start) for k in problem), default=0)
        paired, attempt = self._pairing.row(row, draw_key("pairing", sum(seeds), self._task.id, start), first)
        self.attempts[i] = 0
        self.attempts[i, problem] = [attempt + self._first(k, "") for k in problem]
        return paired

    def begin(self, i: int, start: object, row: np.ndarray, again: int = 0) -> np.ndarray:
        """Begin an episode: draw all that is drawn for it, and return the state that it starts in.

        Args:
            i: Index of the simulation.
            start: Index of the initial state, or another name.
            row: Start of the perturbed task.
            again: Number of starts that were drawn already and are not valid.

        Raises:
            PlacementError: No draw of a start is valid.
        """
        for k in self._of("action"):
            self.attempts[i, k] = self._first(k, start)
        for change in self._fixed:
            if isinstance(change, StartChange):
                if (moved := change.apply(self._scene, row)) is None:
                    raise PlacementError(f"{self._task.id}, start {start}: {change} is not possible")
                row = moved
        for k in self._of("start"):
            row = self._drawn_start(i, k, start, row, again)
        self.open(i, start)
        return row

    def open(self, i: int, start: object) -> None:
        """Begin the observations and actions of the episode of a start in simulation i."""
        self._starts[i] = start
        self.resume(i, 0)

    def resume(self, i: int, steps: int) -> None:
        """Go on with the episode of simulation i after so many steps; filters with a memory begin a new one."""
        self.steps[i] = steps
        self._seen[i] = [one.open(key) for one, key in self._keyed("observation", self._starts[i])]
        self._done[i] = [one.open(key) for one, key in self._keyed("action", self._starts[i])]

    def look(self, start: object) -> Look:
        """Return how the episode of a start is drawn; what is drawn for it goes before absolute changes."""
        drawn = [self._draw(k, start) for k in self._of("look")]
        return joined([*(one for one in self._fixed if isinstance(one, Look)), *drawn])

    def act(self, ids: Sequence[int] | np.ndarray, actions: np.ndarray) -> np.ndarray:
        """Return the actions that are executed, for those that were chosen, (num, A), and count the step."""
        executed = actions.astype(np.float64)
        for i in ids:
            for channel in self._done[i]:
                executed[i] = channel.act(executed[i], int(self.steps[i]))
            self.steps[i] += 1
        return executed

    def see_images(self, ids: Sequence[int] | np.ndarray, images: dict[str, np.ndarray]) -> None:
        """Replace rows `ids` of drawn images by what arrives of them."""
        for i in ids:
            for channel in self._seen[i]:
                for name, rows in images.items():
                    rows[i] = channel.image(name, rows[i], int(self.steps[i]))

    def see_state(self, entries: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return what arrives of the entries that are no images, name -> (num, n)."""
        arrived = {name: rows.copy() for name, rows in entries.items()}
        for i, channels in enumerate(self._seen):
            for channel in channels:
                own = channel.state({name: rows[i] for name, rows in arrived.items()}, int(self.steps[i]))
                for name, values in own.items():
                    arrived[name][i] = values
        return arrived

    def _of(self, layer: Layer) -> list[int]:
        """Return the positions of the perturbations of a layer."""
        return [k for k, one in enumerate(self.perturbations) if one.definition.layer == layer]

    def _first(self, k: int, start: object) -> int:
        """Return the number of the first draw of a perturbation that may be used for a start."""
        return first_attempt(self.perturbations[k], self._task.id, start)

    def _key(self, k: int, start: object, attempt: int = 0) -> DrawKey:
        one = self.perturbations[k]
        return draw_key(one.kind, one.seed, self._task.id, start, attempt)

    def _draw(self, k: int, start: object, attempt: int = 0) -> Any:
        """Return the change that a perturbation draws for a start."""
        one = self.perturbations[k]
        if one.definition.layer == "action":
            attempt = self._first(k, start)
        rng = self._key(k, start, attempt).generator()
        needs_scene = one.definition.layer in ("look", "start")
        return one.definition.draw(one.amount, rng, *([self._scene] if needs_scene else []))

    def _drawn_start(self, i: int, k: int, start: object, row: np.ndarray, again: int) -> np.ndarray:
        first = self._first(k, start) + again
        for attempt in range(first, first + TRIES):
            moved = self._draw(k, start, attempt).apply(self._scene, row)
            if moved is not None:
                self.attempts[i, k] = attempt
                return moved
        raise PlacementError(
            f"{self._task.id}, start {start}: none of {TRIES} draws of {self.perturbations[k]} is valid"
        )

    def _keyed(self, layer: Layer, start: object) -> list[tuple[Any, DrawKey]]:
        """Return the filters of a layer, with the keys of their channels: fixed ones, then those that are drawn."""
        kind = ObservationFilter if layer == "observation" else ActionFilter
        attempts = {k: self._first(k, start) if layer == "action" else 0 for k in self._of(layer)}
        drawn = [(self._draw(k, start), self._key(k, start, n)) for k, n in attempts.items()]
        fixed = [one for one in self._fixed if isinstance(one, kind)]
        keys = [draw_key(f"fixed {j}", 0, self._task.id, start) for j in range(len(fixed))]
        return [*zip(fixed, keys, strict=True), *drawn]


def scene_problem(task: Task, base: Task) -> Problem:
    """Return the problem that the scene of a perturbed task is built from: one in other words needs no other scene."""
    if task.problem.language == base.problem.language:
        return task.problem
    return replace(task.problem, language=base.problem.language)
