"""User-defined tasks: a scene and a goal in one YAML file, or in one call.

    scene: kitchen
    furniture: [wooden_cabinet]
    objects: [akita_black_bowl, plate]
    place:
      wooden_cabinet_1: {at: [0, -0.3], yaw: pi}
      akita_black_bowl_1: [0, 0]
      plate_1: {at: [0.05, 0.2], half: 0.02}
    goal: On akita_black_bowl_1 plate_1
    language: put the bowl on the plate

The keys are those of `libero_env.tasks.builder`, and the following short forms:

    scene      a scene of the benchmark with its objects (`kitchen_scene1`), an empty one (`kitchen`,
               `living_room`, `study`, `coffee`, `table`, `floor`), or the YAML file of a scene
    furniture  categories of fixtures, in addition to those of the scene; numbered like objects
    objects    categories of objects, in addition to those of the scene
    place      object or fixture: its initial place. Either [x, y] on the workspace in metres (x points away from the
               robot, y to its left), or `{at: [x, y], half: h, yaw: angle}` for any point within h of it, or its
               support: `plate_1`, `wooden_cabinet_1_top_side`, `In wooden_cabinet_1_top_region`. It replaces the place
               that the scene gives
    goal       one atom, several, or an expression; an atom is `On a b`, `(On a b)` or, in Python, `("On", "a", "b")`

Regions that are sites of a model, such as `basket_1_contain_region`, need no declaration.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml

from libero_env.assets.arena import WORKSPACES, load_workspace
from libero_env.assets.pack import select_pack
from libero_env.errors import LiberoError, UnknownNameError
from libero_env.objects.model import ObjectModel
from libero_env.tasks.builder import (
    KEYS,
    build_problem,
    fill_parameters,
    language_from_name,
    load_scene,
    scene_names,
)
from libero_env.tasks.problem import Problem
from libero_env.tasks.task import Task

EMPTY: Mapping[str, str] = {
    "kitchen": "kitchen_table",
    "living_room": "living_room_table",
    "study": "study_table",
    "coffee": "coffee_table",
    "table": "table",
    "floor": "floor",
}
SHORT = ("scene", "furniture", "objects", "place", "goal", "name", "with")
_KEYS = tuple(dict.fromkeys((*SHORT, *KEYS)))
_HALF_EXTENT = {"object": 0.025, "fixture": 0.01}  # [m] default, as in the original's scenes
_PLACEMENT_PREDICATES = ("On", "In")  # predicates of init atoms that give an entity its place
_TABLE = "main_table"  # name of the fixture `table` in the original's task files
FILE = "file"  # suite of a task that was read from a file on its own

Definition = Mapping[str, Any]


def make_task(name: str | None = None, **definition: Any) -> Task:
    """Return a user-defined task, from the keys that a task's YAML file may contain.

    Args:
        name: Name of the task and of its files; by default the words of the language, joined by underscores.
        definition: Keys such as `scene`, `objects`, `place`, `goal` and `language`, and their values; see
            `libero_env.tasks.authoring`. Values that are None are ignored.

    Returns:
        The task; its suite is `file`.

    Raises:
        LiberoError: A key, scene, object or region does not exist, or an object has no place; the message lists the
            valid names.

    Example:
        >>> task = make_task(
        ...     scene="kitchen",
        ...     objects=["red_coffee_mug", "plate"],
        ...     place={"red_coffee_mug_1": (0, 0), "plate_1": (0.05, 0.2)},
        ...     goal=("On", "red_coffee_mug_1", "plate_1"),
        ...     language="put the red mug on the plate",
        ... )
        >>> task.name
        'put_the_red_mug_on_the_plate'
    """
    definition = {key: value for key, value in definition.items() if value is not None}
    return task_from_definition({**definition, **({"name": name} if name else {})}, "task", Path())


def read_definition(path: Path) -> dict[str, Any]:
    """Return the content of a task's or scene's YAML file.

    Raises:
        LiberoError: The file is missing, not valid YAML, or has a key that does not exist.
    """
    try:
        definition = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LiberoError(f"{path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LiberoError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(definition, dict):
        raise LiberoError(f"{path}: expected keys such as scene, objects, place and goal")
    for key in definition:
        if key not in (*_KEYS, "tasks"):
            raise UnknownNameError(f"key of {path}", key, _KEYS)
    return definition


def model_regions(category: str) -> tuple[str, ...]:
    """Return the regions that are sites of an object's or fixture's model, such as `contain_region`, sorted.

    Raises:
        UnknownNameError: No object has this name.
    """
    return _site_regions(select_pack().build(category))


def _site_regions(item: ObjectModel) -> tuple[str, ...]:
    names = {site.name for site in item.spec.sites}
    return tuple(
        sorted(name for name in names if name and name != "default_site" and not name.endswith("_site"))
    )


def task_from_definition(definition: Definition, where: str, folder: Path) -> Task:
    """Return the task of a definition; see `make_task`.

    Args:
        definition: Content of a YAML file.
        where: Name of the source in error messages.
        folder: Folder that the path of a scene's file is relative to.

    Raises:
        LiberoError: The definition is not valid; the message starts with `where` and lists the valid names.
    """
    for key in definition:
        if key not in _KEYS:
            raise UnknownNameError(f"key of {where}", key, _KEYS)
    language = str(definition.get("language") or language_from_name(str(definition.get("name", ""))))
    name = str(definition.get("name") or re.sub(r"\W+", "_", language.strip().lower()).strip("_"))
    if not language:
        raise LiberoError(
            f"{where}: it has neither a name nor a language; add `language:` with the instruction"
        )
    problem = _problem({**definition, "name": name, "language": language}, where, folder)
    return Task(FILE, 0, name, language, language, problem)


def _problem(definition: Definition, where: str, folder: Path) -> Problem:
    """Return the problem of a definition that may use the short forms."""
    expanded = _expand(definition, {}, where, folder)
    if "goal" not in expanded:
        raise LiberoError(f"{where}: it has no goal; add one, such as `goal: On red_coffee_mug_1 plate_1`")
    entities = {**expanded["fixtures"], **_number(expanded["objects"], (), where)}
    placed = {
        words[1]
        for words in map(str.split, expanded["init"])
        if len(words) == 3 and words[0] in _PLACEMENT_PREDICATES
    }
    missing = [
        name for name, category in entities.items() if name not in placed and category not in WORKSPACES
    ]
    if missing:
        raise LiberoError(
            f"{where}: {', '.join(missing)} has no place; add it below place: `{missing[0]}: [0, 0]`"
        )
    if "problem" not in expanded:
        expanded["problem"] = load_workspace(_workspace(entities, where)[1]).problem
    return build_problem({}, expanded)


def _expand(definition: Definition, given: Definition, where: str, folder: Path) -> dict[str, Any]:
    """Return a definition merged with that of its scene, in the builder's keys only."""
    given = {**definition.get("with", {}), **given}
    scene = _scene(definition, given, where, folder)
    definition = fill_parameters(definition, given, where)
    fixtures = {**scene.get("fixtures", {}), **definition.get("fixtures", {})}
    fixtures |= _number(definition.get("furniture", ()), fixtures.values(), where)
    objects = _number(scene.get("objects", ()), (), where)
    objects |= _number(definition.get("objects", ()), objects.values(), where)
    entities = {**fixtures, **objects}
    regions, starts = _placements(definition.get("place", {}), fixtures, entities, where)
    moved = {atom.split()[1] for atom in starts}
    rest = map(_atom, definition["init"] if "init" in definition else scene.get("init", ()))
    init = [*map(_atom, definition.get("init_also", ())), *starts]
    init += [atom for atom in rest if not _is_placement(atom, moved)]
    goal = _goal(definition.get("goal") or scene.get("goal") or [])
    declared = _merge_regions(scene.get("regions"), definition.get("regions"))
    for target, own in regions.items():
        declared.setdefault(target, {}).update(own)
    declared = _merge_regions(declared, _undeclared([*init, *goal], declared, entities, where))
    other = {key: scene[key] for key in ("problem",) if key in scene}
    if not definition.get("goal") and "obj_of_interest" in scene:
        other["obj_of_interest"] = scene["obj_of_interest"]
    other |= {
        key: definition[key]
        for key in ("name", "language", "problem", "obj_of_interest")
        if key in definition
    }
    other |= {"goal": goal[0] if goal[0].startswith("(") else goal} if goal else {}
    styles = {**scene.get("scene_properties", {}), **definition.get("scene_properties", {})}
    expanded = {"fixtures": fixtures, "objects": _counts(objects), "regions": declared, "init": init}
    return {**other, **expanded, "scene_properties": styles}


def _is_placement(atom: str, names: set[str]) -> bool:
    """Return whether an atom gives one of the named entities its place."""
    words = atom.split()
    return len(words) == 3 and words[0] in _PLACEMENT_PREDICATES and words[1] in names


def _scene(definition: Definition, given: Definition, where: str, folder: Path) -> dict[str, Any]:
    """Return the definition of the scene: one of the benchmark, an empty one, or that of a file in `folder`."""
    scene, valid = definition.get("scene"), (*EMPTY, *scene_names())
    if scene is None:
        if any(category in WORKSPACES for category in definition.get("fixtures", {}).values()):
            return {}
        raise LiberoError(f"{where}: it has no scene; add one of {', '.join(valid)}")
    if isinstance(scene, Mapping):
        return _expand(scene, given, where, folder)
    scene = str(scene)
    if scene in EMPTY or scene in EMPTY.values():
        category = EMPTY.get(scene, scene)
        return {"fixtures": {_TABLE if category == "table" else category: category}}
    if scene.endswith((".yaml", ".yml")):
        path = folder / scene
        if not path.is_file():
            raise LiberoError(f"{where}: its scene {path} is missing")
        return _expand(read_definition(path), given, str(path), path.parent)
    if scene not in valid:
        raise UnknownNameError(f"scene of {where}", scene, valid)
    return fill_parameters(load_scene(scene), given, where)


def _number(entries: Any, existing: Iterable[str], where: str) -> dict[str, str]:
    """Return name -> category of entries such as `plate` or `{plate: 2}`, numbered after those that exist already."""
    if isinstance(entries, str | Mapping):
        entries = [entries]
    count, named = Counter(existing), {}
    known = {*select_pack().categories(), *WORKSPACES}
    for entry in entries:
        for category, number in entry.items() if isinstance(entry, Mapping) else [(entry, 1)]:
            if category not in known:
                raise UnknownNameError(f"object category of {where}", category, known)
            for _ in range(int(number)):
                count[category] += 1
                named[f"{category}_{count[category]}"] = category
    return named


def _counts(objects: Mapping[str, str]) -> list[dict[str, int]]:
    """Return the objects as the builder expects them, those of one category together."""
    return [{category: number} for category, number in Counter(objects.values()).items()]


def _placements(
    places: Definition, fixtures: Mapping[str, str], entities: Mapping[str, str], where: str
) -> tuple[dict[str, Any], list[str]]:
    """Return the regions and the init atoms of the key `place`."""
    workspace = _workspace(fixtures, where)[0]
    regions: dict[str, Any] = {}
    atoms = []
    for entity, place in places.items():
        if entity not in entities:
            entity = f"{entity}_1" if f"{entity}_1" in entities else entity
        if entity not in entities or entity == workspace:
            raise UnknownNameError(
                f"object or fixture to place of {where}", entity, set(entities) - {workspace}
            )
        if isinstance(place, str):
            predicate, _, rest = place.strip("() ").rpartition(" ")
            atoms.append(f"{predicate or 'On'} {entity} {rest}")
            continue
        regions[f"{entity}_start"] = _rectangle(
            place, "fixture" if entity in fixtures else "object", entity, where
        )
        atoms.append(f"On {entity} {workspace}_{entity}_start")
    return {workspace: regions} if regions else {}, atoms


def _workspace(fixtures: Mapping[str, str], where: str) -> tuple[str, str]:
    """Return the name and category of the fixture that is the workspace."""
    for name, category in fixtures.items():
        if category in WORKSPACES:
            return name, category
    raise LiberoError(f"{where}: none of its fixtures is a workspace; add a scene: {', '.join(EMPTY)}")


def _rectangle(place: Any, kind: str, entity: str, where: str) -> dict[str, Any]:
    """Return the region of a place: [x, y], or `at`, `half` and `yaw`."""
    region = dict(place) if isinstance(place, Mapping) else {"at": place}
    if "ranges" in region:
        return region
    at, half = region.pop("at", None), region.pop("half", _HALF_EXTENT[kind])
    half = half if isinstance(half, list | tuple) else (half, half)
    if not isinstance(at, list | tuple) or len(at) != 2 or len(half) != 2:
        raise LiberoError(
            f"{where}: the place of {entity} is {place!r}; expected [x, y] or {{at: [x, y], half: h}}"
        )
    region["ranges"] = [[round(float(at[k % 2]) + (-1, 1)[k // 2] * float(half[k % 2]), 6) for k in range(4)]]
    return region


def _atom(atom: Any) -> str:
    """Return `On a b` for `On a b`, `(On a b)` or `("On", "a", "b")`."""
    return atom.strip().removeprefix("(").removesuffix(")") if isinstance(atom, str) else " ".join(atom)


def _goal(goal: Any) -> list[str]:
    """Return the atoms of a goal, or its one expression in brackets."""
    if isinstance(goal, str):
        nested = goal.count("(") > 1 or re.match(r"\(\s*(and|or|not|forall)\b", goal.strip(), re.IGNORECASE)
        return [goal.strip()] if nested else [_atom(goal)]
    if isinstance(goal, tuple) and all(isinstance(word, str) and " " not in word for word in goal):
        return [_atom(goal)]
    return [_atom(atom) for atom in goal]


def _merge_regions(*sources: Mapping[str, Any] | None) -> dict[str, dict[str, Any]]:
    """Return the regions of several sources by target; later ones override keys of earlier ones of the same name."""
    merged: dict[str, dict[str, Any]] = {}
    for regions in sources:
        for target, named in (regions or {}).items():
            known = merged.setdefault(target, {})
            for name, region in (named if isinstance(named, Mapping) else dict.fromkeys(named, {})).items():
                known[name] = {**(known.get(name) or {}), **region} if isinstance(region, Mapping) else region
    return merged


def _undeclared(
    atoms: Iterable[str], declared: Mapping[str, Definition], entities: Mapping[str, str], where: str
) -> dict[str, dict[str, Any]]:
    """Return the regions of models that atoms refer to and that are not declared.

    Raises:
        UnknownNameError: The region does not exist; the message lists the valid ones.
    """
    known = {*entities, *(f"{target}_{name}" for target, names in declared.items() for name in names)}
    found: dict[str, dict[str, Any]] = {}
    for atom in atoms:
        words = re.findall(r"[\w?]+", atom)
        for name in words if atom.startswith("(") else words[1:]:
            target = max((t for t in entities if name.startswith(f"{t}_")), key=len, default=None)
            if name in known or target is None or entities[target] in WORKSPACES:
                continue
            site = name.removeprefix(f"{target}_")
            if site not in (valid := model_regions(entities[target])):
                raise UnknownNameError(f"region of {target} ({where}: {atom})", site, valid or ("none",))
            found.setdefault(target, {})[site] = {}
    return found
