"""Tasks of one's own: a scene and a goal in one YAML file, or in one call.

    scene: kitchen
    furniture: [wooden_cabinet]
    objects: [akita_black_bowl, plate]
    place:
      wooden_cabinet_1: {at: [0, -0.3], yaw: pi}
      akita_black_bowl_1: [0, 0]
      plate_1: {at: [0.05, 0.2], half: 0.02}
    goal: On akita_black_bowl_1 plate_1
    language: put the bowl on the plate

The keys are those of `libero_env.tasks.builder`, and these, which are short for what it takes many to say:

    scene      a scene of the benchmark (`kitchen_scene1`, with what stands in it), an empty one (`kitchen`,
               `living_room`, `study`, `coffee`, `table`, `floor`), or the YAML file of one
    furniture  categories of fixtures, besides those of the scene; numbered as objects are
    objects    categories, besides those of the scene
    place      thing: where it is at the start: [x, y] on the workspace in metres (x points away from the robot,
               y to its left), `{at: [x, y], half: h, yaw: angle}` for any point within h of it, or what it stands on:
               `plate_1`, `wooden_cabinet_1_top_side`, `In wooden_cabinet_1_top_region`; for a thing of the scene
               instead of what the scene says
    goal       one atom, several, or an expression; an atom is `On a b`, `(On a b)` or, in Python, `("On", "a", "b")`

Places of objects and fixtures, such as `basket_1_contain_region`, need no declaration.
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
from libero_env.tasks.builder import KEYS, build_problem, filled, language_from_name, load_scene, scene_names
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
_OWN_KEYS = tuple(dict.fromkeys((*SHORT, *KEYS)))
_HALF = {"object": 0.025, "fixture": 0.01}  # m, of places that say none, as in the original's scenes
_PLACING = ("On", "In")  # predicates that say where something stands
_TABLE = "main_table"  # the original's name of the fixture `table`
FILE = "file"  # suite of a task that was read alone

Facts = Mapping[str, Any]


def make_task(name: str | None = None, **facts: Any) -> Task:
    """A task of your own; `libero_env.tasks.authoring` lists the facts.

        make_task(scene="kitchen", objects=["red_cup", "plate"], place={"red_cup_1": (0, 0), "plate_1": (0.05, 0.2)},
                  goal=("On", "red_cup_1", "plate_1"), language="put the red cup on the plate")

    Args:
        name: of its files; by default the words of the language, joined.
        facts: what the YAML file would say.

    Raises:
        LiberoError: a key, scene, thing or place that does not exist, or a thing without a place; the message lists
            the valid ones.
    """
    facts = {key: value for key, value in facts.items() if value is not None}
    return task_of({**facts, **({"name": name} if name else {})}, "task", Path())


def read_facts(path: Path) -> dict[str, Any]:
    """What a YAML file says.

    Raises:
        LiberoError: it is missing, no YAML, or has a key that does not exist.
    """
    try:
        facts = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise LiberoError(f"{path}: {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LiberoError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(facts, dict):
        raise LiberoError(f"{path}: expected keys such as scene, objects, place and goal")
    for key in facts:
        if key not in (*_OWN_KEYS, "tasks"):
            raise UnknownNameError(f"key of {path}", key, _OWN_KEYS)
    return facts


def places_of(category: str) -> tuple[str, ...]:
    """The places of an object or fixture that atoms can name after it, such as `contain_region`, sorted.

    Raises:
        UnknownNameError: no object has this name.
    """
    return _places(select_pack().build(category))


def _places(item: ObjectModel) -> tuple[str, ...]:
    names = {site.name for site in item.spec.sites}
    return tuple(
        sorted(name for name in names if name and name != "default_site" and not name.endswith("_site"))
    )


def task_of(facts: Facts, where: str, folder: Path) -> Task:
    """The task that facts amount to; see `make_task`.

    Args:
        facts: what a YAML file says.
        where: for messages.
        folder: that of the file, beside which a scene's file may be.
    """
    for key in facts:
        if key not in _OWN_KEYS:
            raise UnknownNameError(f"key of {where}", key, _OWN_KEYS)
    said = str(facts.get("language") or language_from_name(str(facts.get("name", ""))))
    name = str(facts.get("name") or re.sub(r"\W+", "_", said.strip().lower()).strip("_"))
    if not said:
        raise LiberoError(f"{where}: it has neither a name nor a language; say what is to be done")
    problem = _problem({**facts, "name": name, "language": said}, where, folder)
    return Task(FILE, 0, name, said, said, problem)


def _problem(facts: Facts, where: str, folder: Path) -> Problem:
    """The problem of facts in which the short forms are used."""
    whole = _written_out(facts, {}, where, folder)
    if "goal" not in whole:
        raise LiberoError(f"{where}: it has no goal; add one, such as `goal: On red_cup_1 plate_1`")
    things = {**whole["fixtures"], **_numbered(whole["objects"], (), where)}
    placed = {words[1] for words in map(str.split, whole["init"]) if len(words) == 3 and words[0] in _PLACING}
    missing = [name for name, category in things.items() if name not in placed and category not in WORKSPACES]
    if missing:
        raise LiberoError(
            f"{where}: nothing says where {', '.join(missing)} stands; add it below place: `{missing[0]}: [0, 0]`"
        )
    if "problem" not in whole:
        whole["problem"] = load_workspace(_workspace(things, where)[1]).problem
    return build_problem({}, whole)


def _written_out(facts: Facts, given: Facts, where: str, folder: Path) -> dict[str, Any]:
    """Facts of a task or scene, with those of the scene that it names, in the builder's words alone."""
    given = {**facts.get("with", {}), **given}
    scene = _scene(facts, given, where, folder)
    facts = filled(facts, given, where)
    fixtures = {**scene.get("fixtures", {}), **facts.get("fixtures", {})}
    fixtures |= _numbered(facts.get("furniture", ()), fixtures.values(), where)
    objects = _numbered(scene.get("objects", ()), (), where)
    objects |= _numbered(facts.get("objects", ()), objects.values(), where)
    things = {**fixtures, **objects}
    regions, starts = _placed(facts.get("place", {}), fixtures, things, where)
    moved = {atom.split()[1] for atom in starts}
    rest = map(_atom, facts["init"] if "init" in facts else scene.get("init", ()))
    init = [*map(_atom, facts.get("init_also", ())), *starts]
    init += [atom for atom in rest if not _places_one(atom, moved)]
    goal = _goal(facts.get("goal") or scene.get("goal") or [])
    declared = _joined(scene.get("regions"), facts.get("regions"))
    for target, own in regions.items():
        declared.setdefault(target, {}).update(own)
    declared = _joined(declared, _undeclared([*init, *goal], declared, things, where))
    said = {key: scene[key] for key in ("problem",) if key in scene}
    if not facts.get("goal") and "obj_of_interest" in scene:
        said["obj_of_interest"] = scene["obj_of_interest"]
    said |= {key: facts[key] for key in ("name", "language", "problem", "obj_of_interest") if key in facts}
    said |= {"goal": goal[0] if goal[0].startswith("(") else goal} if goal else {}
    styles = {**scene.get("scene_properties", {}), **facts.get("scene_properties", {})}
    whole = {"fixtures": fixtures, "objects": _counts(objects), "regions": declared, "init": init}
    return {**said, **whole, "scene_properties": styles}


def _places_one(atom: str, names: set[str]) -> bool:
    """Whether an atom says where one of these things stands."""
    words = atom.split()
    return len(words) == 3 and words[0] in _PLACING and words[1] in names


def _scene(facts: Facts, given: Facts, where: str, folder: Path) -> dict[str, Any]:
    """The facts of the scene that is named: of the benchmark, an empty one, or in a file beside this one."""
    scene, valid = facts.get("scene"), (*EMPTY, *scene_names())
    if scene is None:
        if any(category in WORKSPACES for category in facts.get("fixtures", {}).values()):
            return {}
        raise LiberoError(f"{where}: it says no scene; add one of {', '.join(valid)}")
    if isinstance(scene, Mapping):
        return _written_out(scene, given, where, folder)
    scene = str(scene)
    if scene in EMPTY or scene in EMPTY.values():
        category = EMPTY.get(scene, scene)
        return {"fixtures": {_TABLE if category == "table" else category: category}}
    if scene.endswith((".yaml", ".yml")):
        path = folder / scene
        if not path.is_file():
            raise LiberoError(f"{where}: its scene {path} is missing")
        return _written_out(read_facts(path), given, str(path), path.parent)
    if scene not in valid:
        raise UnknownNameError(f"scene of {where}", scene, valid)
    return filled(load_scene(scene), given, where)


def _numbered(entries: Any, there: Iterable[str], where: str) -> dict[str, str]:
    """Name -> category of entries such as `plate` or `{plate: 2}`, counted on from those that are there."""
    if isinstance(entries, str | Mapping):
        entries = [entries]
    count, named = Counter(there), {}
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
    """Objects as the builder takes them; those of one category come together."""
    return [{category: number} for category, number in Counter(objects.values()).items()]


def _placed(
    places: Facts, fixtures: Mapping[str, str], things: Mapping[str, str], where: str
) -> tuple[dict[str, Any], list[str]]:
    """Regions and init atoms of what `place` says."""
    workspace = _workspace(fixtures, where)[0]
    regions: dict[str, Any] = {}
    atoms = []
    for thing, place in places.items():
        if thing not in things:
            thing = f"{thing}_1" if f"{thing}_1" in things else thing
        if thing not in things or thing == workspace:
            raise UnknownNameError(f"thing to place of {where}", thing, set(things) - {workspace})
        if isinstance(place, str):
            predicate, _, rest = place.strip("() ").rpartition(" ")
            atoms.append(f"{predicate or 'On'} {thing} {rest}")
            continue
        regions[f"{thing}_start"] = _rectangle(
            place, "fixture" if thing in fixtures else "object", thing, where
        )
        atoms.append(f"On {thing} {workspace}_{thing}_start")
    return {workspace: regions} if regions else {}, atoms


def _workspace(fixtures: Mapping[str, str], where: str) -> tuple[str, str]:
    """Name and category of the fixture that is the workspace."""
    for name, category in fixtures.items():
        if category in WORKSPACES:
            return name, category
    raise LiberoError(f"{where}: none of its fixtures is a workspace; name a scene: {', '.join(EMPTY)}")


def _rectangle(place: Any, kind: str, thing: str, where: str) -> dict[str, Any]:
    """The facts of a region: [x, y], or `at`, `half` and `yaw`."""
    facts = dict(place) if isinstance(place, Mapping) else {"at": place}
    if "ranges" in facts:
        return facts
    at, half = facts.pop("at", None), facts.pop("half", _HALF[kind])
    half = half if isinstance(half, list | tuple) else (half, half)
    if not isinstance(at, list | tuple) or len(at) != 2 or len(half) != 2:
        raise LiberoError(
            f"{where}: the place of {thing} is {place!r}; expected [x, y] or {{at: [x, y], half: h}}"
        )
    facts["ranges"] = [[round(float(at[k % 2]) + (-1, 1)[k // 2] * float(half[k % 2]), 6) for k in range(4)]]
    return facts


def _atom(atom: Any) -> str:
    """`On a b` of `On a b`, `(On a b)` or `("On", "a", "b")`."""
    return atom.strip().removeprefix("(").removesuffix(")") if isinstance(atom, str) else " ".join(atom)


def _goal(goal: Any) -> list[str]:
    """Atoms, or one expression in brackets."""
    if isinstance(goal, str):
        nested = goal.count("(") > 1 or re.match(r"\(\s*(and|or|not|forall)\b", goal.strip(), re.IGNORECASE)
        return [goal.strip()] if nested else [_atom(goal)]
    if isinstance(goal, tuple) and all(isinstance(word, str) and " " not in word for word in goal):
        return [_atom(goal)]
    return [_atom(atom) for atom in goal]


def _joined(*several: Mapping[str, Any] | None) -> dict[str, dict[str, Any]]:
    """The regions of several sources by target; a later one changes facts of an earlier one of its name."""
    joined: dict[str, dict[str, Any]] = {}
    for regions in several:
        for target, named in (regions or {}).items():
            there = joined.setdefault(target, {})
            for name, facts in (named if isinstance(named, Mapping) else dict.fromkeys(named, {})).items():
                there[name] = {**(there.get(name) or {}), **facts} if isinstance(facts, Mapping) else facts
    return joined


def _undeclared(
    atoms: Iterable[str], declared: Mapping[str, Facts], things: Mapping[str, str], where: str
) -> dict[str, dict[str, Any]]:
    """The places of models that atoms speak of and nothing declares.

    Raises:
        LiberoError: a name that is none, with the places that there are.
    """
    known = {*things, *(f"{target}_{name}" for target, facts in declared.items() for name in facts)}
    found: dict[str, dict[str, Any]] = {}
    for atom in atoms:
        words = re.findall(r"[\w?]+", atom)
        for name in words if atom.startswith("(") else words[1:]:
            target = max((t for t in things if name.startswith(f"{t}_")), key=len, default=None)
            if name in known or target is None or things[target] in WORKSPACES:
                continue
            site = name.removeprefix(f"{target}_")
            if site not in (places := places_of(things[target])):
                raise UnknownNameError(f"place of {target} ({where}: {atom})", site, places or ("none",))
            found.setdefault(target, {})[site] = {}
    return found
