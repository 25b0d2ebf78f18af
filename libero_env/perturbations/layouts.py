"""Another layout: regions of objects are moved on the workspace, so far that instruction and goal mean the same."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from libero_env.errors import PlacementError
from libero_env.init_states.store import load_init_states
from libero_env.perturbations.drawing import direction
from libero_env.perturbations.starts import carried, contacts, shifted
from libero_env.sim.scene import Scene
from libero_env.tasks.problem import Atom, Problem, Region
from libero_env.tasks.task import Task

_DIRECTIONS = 200  # tries for each object


def move_layout(metres: float, rng: np.random.Generator, task: Task, scene: Scene) -> Task:
    """Return the task with the regions of its objects moved by the same distance, each in another direction.

    What the goal is about besides the objects that are carried stays in its place, as do fixtures. Where the
    instruction tells objects of one category apart by their places, all objects move together.

    Raises:
        PlacementError: An object cannot be moved so far without touching another in one of the stored initial states.
    """
    rows = list(load_init_states(task, scene))
    free = [contacts(scene, row) for row in rows]
    shifts: dict[str, np.ndarray] = {}
    for group in _groups(task.problem):
        for _ in range(_DIRECTIONS):
            step = metres * direction(rng, 2)
            moved = [_moved(scene, row, task.problem, group, step) for row in rows]
            if all(contacts(scene, row) <= before for row, before in zip(moved, free, strict=True)):
                rows = moved
                shifts |= dict.fromkeys(group, step)
                break
        else:
            raise PlacementError(f"{task.id}: {', '.join(group)} cannot be moved by {metres:.3f} m")
    return replace(task, problem=_with_shifts(task.problem, shifts))


def _groups(problem: Problem) -> list[list[str]]:
    """Return the objects that stand on the workspace and are moved; those of a group by the same."""
    roots, atoms = carried(problem), problem.goal.atoms()
    taken = [atom.args[0] for atom in atoms if atom.args[0] in problem.objects]
    counts = Counter(problem.objects.values())
    if any(
        counts[problem.objects[name]] > 1 for atom in atoms for name in atom.args if name in problem.objects
    ):
        return [list(roots)]
    on_table = any(_is_place(problem, name) for atom in atoms for name in atom.args[1:])
    kept = {name for atom in atoms for name in _objects_of(problem, atom.args[1:])}
    if on_table:  # such as `to the right of the plate`: what is named beside it is a landmark
        words = set(problem.language.lower().split())
        kept |= {n for n, c in problem.objects.items() if words & set(c.split("_")) and n not in taken}
    return [[name] for name in roots if name not in kept]


def _is_place(problem: Problem, name: str) -> bool:
    region = problem.region(name)
    return region is not None and bool(region.ranges)


def _objects_of(problem: Problem, names: Sequence[str]) -> list[str]:
    """Return the objects of names and regions."""
    regions = [problem.region(name) for name in names]
    targets = [name if region is None else region.target for name, region in zip(names, regions, strict=True)]
    return [name for name in targets if name in problem.objects]


def _moved(
    scene: Scene, row: np.ndarray, problem: Problem, group: Sequence[str], step: np.ndarray
) -> np.ndarray:
    loads = carried(problem)
    for name in group:
        row = shifted(scene, row, (name, *loads[name]), step)
    return row


def _with_shifts(problem: Problem, shifts: dict[str, np.ndarray]) -> Problem:
    """Return a problem in which each object has a region of its own, moved from where it was."""
    regions, init = list(problem.regions), []
    for atom in problem.init:
        region = problem.region(atom.args[-1])
        if atom.args[0] in shifts and region is not None and len(atom.args) == 2:
            x, y = shifts[atom.args[0]]
            ranges = tuple((a + x, b + y, c + x, d + y) for a, b, c, d in region.ranges)
            own = Region(f"{region.name}_of_{atom.args[0]}", region.target, ranges, region.yaw, region.rgba)
            regions.append(own)
            atom = Atom(atom.predicate, (atom.args[0], own.address))
        init.append(atom)
    return replace(problem, regions=tuple(regions), init=tuple(init))
