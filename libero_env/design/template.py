"""Template of a user-defined task: a valid YAML file with comments on what can be changed."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from math import hypot

import yaml

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.storage import parse_yaml_text
from libero_env.tasks.builder import make_task
from libero_env.tasks.merging import EMPTY, load_scene, model_regions, scene_names
from libero_env.tasks.task import Task
from libero_env.workspaces import WORKSPACES

# Places of objects (x, y) [m] in the original's scenes, and of furniture (x, y, yaw).
_SLOTS = ((-0.05, 0.0), (0.05, 0.2), (-0.2, 0.15), (0.1, -0.02), (-0.18, -0.12), (-0.05, 0.3))
_FURNITURE = ((0.02, -0.28, "pi"), (-0.41, 0.21, "0"), (-0.26, -0.26, "pi"))
_APART = 0.13  # [m] smallest distance of neighbours
_DEFAULT_OBJECTS = ("akita_black_bowl", "plate")
_INSIDE = "contain_region"


def task_template(
    scene: str = "kitchen",
    objects: Sequence[str] = (),
    furniture: Sequence[str] = (),
    goal: Sequence[str] = (),
    language: str | None = None,
) -> tuple[str, Task]:
    """Return the text of a task file, and its task.

    Args:
        scene: Scene of the benchmark, or an empty one.
        objects: Categories; by default, in an empty scene, a bowl and a plate. A single object gets a plate.
        furniture: Categories of fixtures.
        goal: Atoms that must all hold; by default the first object on, or in, the last.
        language: Instruction; by default it describes the goal.

    Raises:
        LiberoError: A name does not exist, or there are more objects than places.
    """
    objects = list(objects)
    given = load_scene(scene) if scene in scene_names() else {}
    if (scene in EMPTY or scene in WORKSPACES) and len(objects) < 2 and not goal:
        objects = [*objects, "plate"] if objects else list(_DEFAULT_OBJECTS)
    names = _number(objects, given.get("objects", ()))
    goal = list(goal) or _default_goal(names)
    language = language or _words(goal, names)
    taken = _occupied(scene)
    places: dict[str, object] = {}
    fixtures = _number(furniture, given.get("fixtures", {}).values())
    for name, (x, y, yaw) in _assign_slots(fixtures, _FURNITURE, taken, "furniture"):
        places[name] = f"{{at: [{x}, {y}], yaw: {yaw}}}"
    for name, (x, y) in _assign_slots(names, _SLOTS, taken, "objects"):
        places[name] = f"{{at: [{x}, {y}], half: 0.025}}"
    lines = [f"language: {_scalar(language)}", f"scene: {_scalar(scene)}"]
    for key, categories in (("furniture", furniture), ("objects", objects)):
        lines += [f"{key}: [{', '.join(map(_scalar, categories))}]"] if categories else []
    lines += [
        "# centre (x away from the robot, y to its left) and distance around it, m; angle of furniture, rad"
    ]
    lines += ["place:", *(f"  {name}: {place}" for name, place in places.items())] if places else []
    lines += ["# all of these must hold: On, In, Open, Close, Turnon, Turnoff, Up, Stack, ...", "goal:"]
    text = "\n".join([*lines, *(f"  - {_scalar(atom)}" for atom in goal)]) + "\n"
    return text, make_task(**parse_yaml_text(text).data)


def _default_goal(names: Mapping[str, str]) -> list[str]:
    if len(names) < 2:
        raise LiberoError("a goal is required: --goal 'On red_coffee_mug_1 plate_1'; or give two objects")
    first, *_, last = names
    inside = _INSIDE in model_regions(names[last])
    return [f"In {first} {last}_{_INSIDE}" if inside else f"On {first} {last}"]


def _words(goal: Iterable[str], names: Mapping[str, str]) -> str:
    """Return an instruction for a goal; it is correct for atoms like those of `_default_goal`."""
    phrases = []
    for atom in goal:
        if len(words := atom.strip("() ").split()) < 2:
            raise InvalidInputError(
                f"--goal {atom!r:.80} is not an atom; expected such as 'On red_coffee_mug_1 plate_1'"
            )
        predicate, *args = words
        plain = [names.get(arg, arg).replace("_", " ").replace(" 1", "") for arg in args]
        if predicate in ("On", "In") and len(plain) == 2:
            phrases.append(
                f"put the {plain[0]} {predicate.lower()} the {plain[1].removesuffix(' contain region')}"
            )
        else:
            phrases.append(f"{predicate.lower()} the {' and the '.join(plain)}")
    return " and ".join(phrases)


def _number(categories: Iterable[str], present: Iterable[str | Mapping[str, int]]) -> dict[str, str]:
    """Return name -> category, numbered after what is present: categories, or numbers of them."""
    counts, named = Counter[str](), dict[str, str]()
    for entry in present:
        counts.update(entry if isinstance(entry, Mapping) else [entry])
    for category in categories:
        counts[category] += 1
        named[f"{category}_{counts[category]}"] = category
    return named


def _occupied(scene: str) -> list[tuple[float, float]]:
    """Return the places that are occupied in a scene of the benchmark, (x, y) [m]."""
    if scene not in scene_names():
        return []
    targets = [
        regions for regions in load_scene(scene).get("regions", {}).values() if isinstance(regions, dict)
    ]
    places = [region["at"] for regions in targets for region in regions.values() if region and "at" in region]
    return [tuple(at) for at in places if isinstance(at, list)]


def _assign_slots(names: Iterable[str], slots: Sequence[tuple], taken: list[tuple[float, float]], kind: str):
    """Yield each name with the first free slot; slots become occupied as they are assigned."""
    for name in names:
        free = [slot for slot in slots if all(hypot(slot[0] - x, slot[1] - y) >= _APART for x, y in taken)]
        if not free:
            raise LiberoError(
                f"there are not enough places for the {kind}; leave {name} out and add it in the file"
            )
        taken.append((free[0][0], free[0][1]))
        yield name, free[0]


def _scalar(text: str) -> str:
    """Return a text as YAML has it in one line, in quotes where it would be read as something else."""
    plain = yaml.safe_dump(text, allow_unicode=True, width=float("inf")).removesuffix("...\n").strip()
    return json.dumps(text) if "\n" in plain else plain
