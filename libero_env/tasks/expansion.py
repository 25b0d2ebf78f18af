"""Merging of a task's definition with that of its scene, and its short forms, into the keys of the builder."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

from libero_env.assets.arena import WORKSPACES
from libero_env.assets.pack import select_pack
from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.objects.model import ObjectModel
from libero_env.tasks.builder import fill_parameters, load_scene, scene_names
from libero_env.tasks.source import Source, Trace, read_definition, scene_file
from libero_env.validation import validate

EMPTY: Mapping[str, str] = {
    "kitchen": "kitchen_table",
    "living_room": "living_room_table",
    "study": "study_table",
    "coffee": "coffee_table",
    "table": "table",
    "floor": "floor",
}
_HALF_EXTENT = {"object": 0.025, "fixture": 0.01}  # [m] default, as in the original's scenes
_PLACEMENT_PREDICATES = ("On", "In")  # predicates of init atoms that give an entity its place
_TABLE = "main_table"  # name of the fixture `table` in the original's task files
_NESTED = re.compile(r"\(\s*(and|or|not|forall)\b", re.IGNORECASE)

Definition = Mapping[str, Any]


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


def expand(definition: Definition, given: Definition, source: Source, trace: Trace) -> dict[str, Any]:
    """Return a definition merged with that of its scene, in the builder's keys only.

    Args:
        definition: Content of a YAML file.
        given: Parameter -> value.
        source: Where the definition stands.
        trace: Notes where atoms and regions come from.

    Raises:
        LiberoError: The definition is not valid; the message starts with file and line.
    """
    own = validate(
        dict[str, Any],
        definition.get("with") or {},
        source=source.name,
        prefix=("with",),
        line_of=source.line_of,
    )
    given = {**own, **given}
    scene = _scene(definition, given, source, trace)
    definition = _filled(definition, given, source)
    fixtures = {**scene.get("fixtures", {}), **definition.get("fixtures", {})}
    _check_categories(definition.get("fixtures", {}), source)
    fixtures |= _number(definition, "furniture", fixtures.values(), source)
    objects = _number(scene, "objects", (), source)
    objects |= _number(definition, "objects", objects.values(), source)
    entities = {**fixtures, **objects}
    regions, starts = _placements(definition.get("place", {}), fixtures, entities, source, trace)
    moved = {atom.split()[1] for atom in starts}
    rest = _atoms(definition, "init", source, trace) if "init" in definition else scene.get("init", ())
    init = [*_atoms(definition, "init_also", source, trace), *starts]
    init += [atom for atom in rest if not is_placement(atom, moved)]
    goal = _atoms(definition, "goal", source, trace) or scene.get("goal", [])
    declared = _merge_regions(scene.get("regions"), definition.get("regions"))
    for target, named in definition.get("regions", {}).items():
        for name in named:
            trace.note(f"{target}_{name}", source, "regions", target, name)
    for target, placed in regions.items():
        declared.setdefault(target, {}).update(placed)
    declared = _merge_regions(declared, _undeclared([*init, *goal], declared, entities, trace))
    other = {key: scene[key] for key in ("problem",) if key in scene}
    if not definition.get("goal") and "obj_of_interest" in scene:
        other["obj_of_interest"] = scene["obj_of_interest"]
    other |= {
        key: definition[key]
        for key in ("name", "language", "problem", "obj_of_interest")
        if key in definition
    }
    styles = {**scene.get("scene_properties", {}), **definition.get("scene_properties", {})}
    expanded = {"fixtures": fixtures, "objects": _counts(objects), "regions": declared, "init": init}
    return {**other, **expanded, "goal": goal, "scene_properties": styles}


def is_placement(atom: str, names: Iterable[str] | None = None) -> bool:
    """Return whether an atom gives an entity, one of the named ones, its place."""
    words = atom.split()
    placing = len(words) == 3 and words[0].capitalize() in _PLACEMENT_PREDICATES
    return placing and (names is None or words[1] in names)


def workspace_of(fixtures: Mapping[str, str], where: str) -> tuple[str, str]:
    """Return the name and category of the fixture that is the workspace.

    Raises:
        InvalidInputError: There is none.
    """
    for name, category in fixtures.items():
        if category in WORKSPACES:
            return name, category
    raise InvalidInputError(f"{where}: none of its fixtures is a workspace; add a scene: {', '.join(EMPTY)}")


def _filled(definition: Definition, given: Definition, source: Source) -> dict[str, Any]:
    """Return a definition with the values of its parameters, checked."""
    from libero_env.tasks.schema import check_definition

    kept = {key: value for key, value in definition.items() if key not in ("scene", "with")}
    return check_definition(fill_parameters(kept, given, source.name), source)


def _scene(definition: Definition, given: Definition, source: Source, trace: Trace) -> dict[str, Any]:
    """Return the definition of the scene: one of the benchmark, an empty one, or that of a file."""
    scene, valid = definition.get("scene"), (*EMPTY, *scene_names())
    if scene is None:
        fixtures = definition.get("fixtures")
        if isinstance(fixtures, Mapping) and any(str(c) in WORKSPACES for c in fixtures.values()):
            return {}
        raise InvalidInputError(f"{source.at()}: it has no scene; add one of {', '.join(valid)}")
    if isinstance(scene, Mapping):
        inner = Source(f"{source.at('scene')}, scene", source.folder, source.root, source.files)
        return expand(scene, given, inner, trace)
    if not isinstance(scene, str):
        raise InvalidInputError(
            f"{source.at('scene')}: scene is {scene!r:.60}; expected one of {', '.join(valid)}"
        )
    if scene in EMPTY or scene in EMPTY.values():
        category = EMPTY.get(scene, scene)
        return {"fixtures": {_TABLE if category == "table" else category: category}}
    if scene.endswith((".yaml", ".yml")):
        own, place = read_definition(scene_file(scene, source), source)
        return expand(own, given, place, trace)
    if scene not in valid:
        raise UnknownNameError(f"scene of {source.at('scene')}", scene, valid)
    inner = Source(f"{source.at('with')}, in {scene}")
    filled = _filled(load_scene(scene), given, inner)
    for key in ("init", "goal"):
        filled[key] = _atoms(filled, key, inner, trace)
    return filled


def _check_categories(fixtures: Mapping[str, str], source: Source) -> None:
    known = {*select_pack().categories(), *WORKSPACES} if fixtures else ()
    for name, category in fixtures.items():
        if category not in known:
            raise UnknownNameError(f"fixture category of {source.at('fixtures', name)}", category, known)


def _number(definition: Definition, key: str, existing: Iterable[str], source: Source) -> dict[str, str]:
    """Return name -> category of entries such as `plate` or `{plate: 2}`, numbered after those that exist already."""
    count, named = Counter(existing), {}
    entries = definition.get(key, ())
    known = {*select_pack().categories(), *WORKSPACES} if entries else ()
    for i, entry in enumerate(entries):
        for category, number in entry.items() if isinstance(entry, Mapping) else [(entry, 1)]:
            if category not in known:
                raise UnknownNameError(f"object category of {source.at(key, i)}", category, known)
            for _ in range(number):
                count[category] += 1
                named[f"{category}_{count[category]}"] = category
    return named


def _counts(objects: Mapping[str, str]) -> list[dict[str, int]]:
    """Return the objects as the builder expects them, those of one category together."""
    return [{category: number} for category, number in Counter(objects.values()).items()]


def _placements(
    places: Definition, fixtures: Mapping[str, str], entities: Mapping[str, str], source: Source, trace: Trace
) -> tuple[dict[str, Any], list[str]]:
    """Return the regions and the init atoms of the key `place`."""
    workspace = workspace_of(fixtures, source.at("fixtures"))[0]
    regions: dict[str, Any] = {}
    atoms = []
    for key, place in places.items():
        entity = key
        if entity not in entities:
            entity = f"{entity}_1" if f"{entity}_1" in entities else entity
        if entity not in entities or entity == workspace:
            raise UnknownNameError(
                f"object or fixture to place of {source.at('place', key)}",
                entity,
                set(entities) - {workspace},
            )
        if isinstance(place, str):
            predicate, _, rest = place.strip("() ").rpartition(" ")
            atoms.append(f"{predicate or 'On'} {entity} {rest}")
        else:
            regions[f"{entity}_start"] = _rectangle(place, "fixture" if entity in fixtures else "object")
            atoms.append(f"On {entity} {workspace}_{entity}_start")
            trace.note(f"{workspace}_{entity}_start", source, "place", key)
        trace.note(atoms[-1], source, "place", key)
    return {workspace: regions} if regions else {}, atoms


def _rectangle(place: Definition, kind: str) -> dict[str, Any]:
    """Return the region of a place: `at`, `half` and `yaw`."""
    region = dict(place)
    if "ranges" in region:
        return region
    at, half = region.pop("at"), region.pop("half", (_HALF_EXTENT[kind],) * 2)
    region["ranges"] = [[round(at[k % 2] + (-1, 1)[k // 2] * half[k % 2], 6) for k in range(4)]]
    return region


def _atoms(definition: Definition, key: str, source: Source, trace: Trace) -> list[str]:
    """Return atoms such as `On a b` without brackets, and expressions with them."""
    atoms = []
    for i, text in enumerate(definition.get(key, ())):
        is_nested = text.startswith("(") and (text.count("(") > 1 or _NESTED.match(text))
        atoms.append(text if is_nested else text.removeprefix("(").removesuffix(")").strip())
        trace.note(atoms[-1], source, key, i)
    return atoms


def _merge_regions(*sources: Mapping[str, Any] | None) -> dict[str, dict[str, Any]]:
    """Return the regions of several sources by target; later ones override keys of earlier ones of the same name."""
    merged: dict[str, dict[str, Any]] = {}
    for regions in sources:
        for target, named in (regions or {}).items():
            known = merged.setdefault(target, {})
            for name, region in named.items():
                known[name] = {**(known.get(name) or {}), **region} if isinstance(region, Mapping) else region
    return merged


def _undeclared(
    atoms: Iterable[str], declared: Mapping[str, Definition], entities: Mapping[str, str], trace: Trace
) -> dict[str, dict[str, Any]]:
    """Return the regions of models that atoms refer to and that are not declared.

    Raises:
        UnknownNameError: The region does not exist; the message lists the valid ones.
    """
    known = {*entities, *(f"{target}_{name}" for target, names in declared.items() for name in names)}
    found: dict[str, dict[str, Any]] = {}
    for atom in atoms:
        words = re.findall(r"[^\s()]+", atom)
        for name in words if atom.startswith("(") else words[1:]:
            target = max((t for t in entities if name.startswith(f"{t}_")), key=len, default=None)
            if name in known or target is None or entities[target] in WORKSPACES:
                continue
            site = name.removeprefix(f"{target}_")
            if site not in (valid := model_regions(entities[target])):
                raise UnknownNameError(
                    f"region of {target} ({trace.at(atom)}: {atom})", site, valid or ("none",)
                )
            found.setdefault(target, {})[site] = {}
    return found
