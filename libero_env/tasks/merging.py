"""Merging of a task's definition with its scene, and of that with its own."""

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from string import Template
from typing import Any

from libero_env.errors import InvalidInputError, LiberoError, UnknownNameError
from libero_env.paths import objects_dir
from libero_env.storage import read_yaml
from libero_env.tasks.expression import Atom, Expression
from libero_env.tasks.rules import PLACING
from libero_env.tasks.schema import Source, check_definition, read_definition, scene_file
from libero_env.text import shown
from libero_env.validation import validate
from libero_env.workspaces import BUILTIN_WORKSPACES, WORKSPACES, is_described

EMPTY: Mapping[str, str] = {
    **{room: f"{room}_table" for room in ("kitchen", "living_room", "study", "coffee")},
    "table": "table",
    "floor": "floor",
}
_HALF_EXTENT = {"object": 0.025, "fixture": 0.01}  # [m] default, as in the original's scenes


_TABLE = "main_table"  # name of the fixture `table` in the original's task files
# sites that tell the original's reader where an object ends
_PLACEMENT_SITES = frozenset({"default_site", "bottom_site", "top_site", "horizontal_radius_site"})
Values = Mapping[str, Any]


def load_scene(name: str) -> Values:
    """Return the definition of a scene of the benchmark."""
    return read_yaml(f"tasks/data/scenes/{name}.yaml")


@cache
def scene_names() -> tuple[str, ...]:
    """Return the names that `load_scene` accepts, sorted."""
    files = (resources.files("libero_env.tasks") / "data" / "scenes").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def model_regions(category: str) -> tuple[str, ...]:
    """Return the regions that are sites of an object's or fixture's model, such as `contain_region`, sorted.

    Raises:
        UnknownNameError: No object has this name.
    """
    from libero_env.assets.pack import select_pack

    names = {site.name for site in select_pack().build(category).spec.sites}
    return tuple(sorted(names - _PLACEMENT_SITES - {""}))


@dataclass
class Content:
    """What a definition and its scenes say together.

    Attributes:
        fixtures: Name -> category.
        objects: Name -> category.
        regions: Target -> name -> keys of the region, or None for one that is removed.
        init: Initial conditions.
        goal: Conditions that must all hold.
        styles: Kind -> style.
        cameras: Name -> keys of the camera.
        zones: Regions from which the robot should keep away.
        texts: `name`, `language` and `problem`, where they are given.
        interest: Names of interest; None for those of the goal.
    """

    fixtures: dict[str, str] = field(default_factory=dict)
    objects: dict[str, str] = field(default_factory=dict)
    regions: dict[str, dict[str, Any]] = field(default_factory=dict)
    init: list[Atom] = field(default_factory=list)
    goal: list[Expression] = field(default_factory=list)
    styles: dict[str, str] = field(default_factory=dict)
    cameras: dict[str, Any] = field(default_factory=dict)
    zones: list[str] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)
    interest: list[str] | None = None

    def workspace(self, source: Source) -> tuple[str, str]:
        """Return the name and category of the fixture that is the workspace."""
        for name, category in self.fixtures.items():
            if category in WORKSPACES:
                return name, category
        where = source.at("fixtures")
        raise InvalidInputError(
            f"{where}: none of its fixtures is a workspace; add a scene: {', '.join(EMPTY)}"
        )


class Merge:
    """Merging of a definition with its scene, and of that with its own.

    Args:
        check_models: Whether models of objects are asked for, see `_build`.
        places: Where parts come from, which is added to; see `Source`.

    Attributes:
        parameters: Parameters that the definitions use.
    """

    def __init__(self, check_models: bool, places: dict[str, str]):
        self._check_models, self.places = check_models, places
        self.parameters: set[str] = set()

    def content(self, definition: Values, inherited: Values, source: Source) -> Content:
        """Return the content of a definition with that of its scene.

        Args:
            definition: Keys and values.
            inherited: Parameter -> value, which takes precedence over the definition's.
            source: Where the definition stands.
        """
        parameters = validate(
            dict[str, Any],
            definition.get("with") or {},
            source=source.name,
            prefix=("with",),
            line_of=source.line_of,
        )
        parameters = {**parameters, **inherited}
        content = self._scene(definition, parameters, source)
        plain = {key: value for key, value in definition.items() if key not in ("scene", "with")}
        keys: Values = check_definition(_fill(plain, _with_entries(parameters), source.name), source)
        for used in re.findall(r"\$\{?(\w+)", repr(plain)):
            self.parameters.add(used if used in parameters else used.rpartition("_")[0])
        for name, category in keys.get("fixtures", {}).items():
            self._check_category("fixture", category, source, "fixtures", name)
            content.fixtures[name] = category
            self.places.setdefault(name, source.at("fixtures", name))
        content.fixtures |= self._numbered(keys, "furniture", content.fixtures, source)
        content.objects |= self._numbered(keys, "objects", content.objects, source)
        for target, regions in keys.get("regions", {}).items():
            known = content.regions.setdefault(target, {})
            for name, region in regions.items():
                known[name] = None if region is None else _replaced(known.get(name) or {}, region)
                self.places.setdefault(f"{target}_{name}", source.at("regions", target, name))
        placed = self._place(keys.get("place", {}), content, source)
        init = keys.get("init", content.init)
        moved = {atom.args[0] for atom in placed}
        content.init = [
            *keys.get("init_also", ()),
            *placed,
            *(atom for atom in init if placed_by(atom) not in moved),
        ]
        if keys.get("goal"):
            content.goal, content.interest = keys["goal"], None
        for key in ("init", "init_also", "goal"):
            for i, expression in enumerate(keys.get(key, ())):
                for atom in expression.atoms():
                    self.places.setdefault(str(atom), source.at(key, i))
        content.interest = keys.get("obj_of_interest", content.interest)
        for name, view in keys.get("cameras", {}).items():
            content.cameras[name] = view
            self.places.setdefault(f"camera {name}", source.at("cameras", name))
        for i, name in enumerate(keys.get("zones", ())):
            content.zones.append(name)
            self.places.setdefault(name, source.at("zones", i))
        content.styles |= keys.get("scene_properties", {})
        content.texts |= {key: keys[key] for key in ("name", "language", "problem") if key in keys}
        if self._check_models:
            self._declare_sites(content)
        return content

    def _scene(self, definition: Values, parameters: Values, source: Source) -> Content:
        """Return the content of the scene: one of the benchmark, an empty one, or that of a file."""
        scene, valid = definition.get("scene"), (*EMPTY, *scene_names())
        if scene is None:
            fixtures = definition.get("fixtures")
            if isinstance(fixtures, Mapping) and any(str(c) in WORKSPACES for c in fixtures.values()):
                return Content()
            raise InvalidInputError(f"{source.at()}: it has no scene; add one of {', '.join(valid)}")
        if isinstance(scene, Mapping):
            inner = Source(f"{source.at('scene')}, scene", source.folder, source.root, source.files)
        elif not isinstance(scene, str):
            raise InvalidInputError(
                f"{source.at('scene')}: scene is {scene!r:.60}; expected one of {', '.join(valid)}"
            )
        elif self._check_models and scene in (*valid, *BUILTIN_WORKSPACES) and is_described(scene):
            raise InvalidInputError(
                f"{source.at('scene')}: {scene} is a scene of the benchmark and a workspace of yours, in "
                f"{objects_dir()}; rename its folder"
            )
        elif scene in EMPTY or (scene in WORKSPACES and scene not in valid):
            category = EMPTY.get(scene, scene)
            return Content(fixtures={_TABLE if category == "table" else category: category})
        elif scene.endswith((".yaml", ".yml")):
            scene, inner = read_definition(scene_file(scene, source), source)
        elif scene not in valid:
            raise UnknownNameError(f"scene of {source.at('scene')}", scene, valid)
        else:
            scene, inner = load_scene(scene), Source(f"{source.at('with')}, in {scene}")
        content = self.content(scene, parameters, inner)
        content.texts = {key: text for key, text in content.texts.items() if key == "problem"}
        return content

    def _check_category(self, kind: str, category: str, source: Source, *path: str | int) -> None:
        if self._check_models:
            from libero_env.assets.pack import select_pack

            known = {*select_pack().categories(), *WORKSPACES}
            if category not in known:
                raise UnknownNameError(f"{kind} category of {source.at(*path)}", category, known)

    def _numbered(
        self, keys: Values, key: str, existing: Mapping[str, str], source: Source
    ) -> dict[str, str]:
        """Return name -> category of entries such as `plate` or `{plate: 2}`, numbered after those that exist."""
        counts, named = Counter(existing.values()), {}
        for i, entry in enumerate(keys.get(key, ())):
            for category, number in entry.items() if isinstance(entry, Mapping) else [(entry, 1)]:
                self._check_category("object", category, source, key, i)
                for _ in range(number):
                    counts[category] += 1
                    while (name := f"{category}_{counts[category]}") in existing:
                        counts[category] += 1
                    named[name] = category
                    self.places.setdefault(name, source.at(key, i))
        return named

    def _place(self, places: Values, content: Content, source: Source) -> list[Atom]:
        """Add the regions of the key `place`, and return its init atoms."""
        workspace = content.workspace(source)[0]
        entities = {**content.fixtures, **content.objects}
        atoms = []
        for key, place in places.items():
            entity = key if key in entities or f"{key}_1" not in entities else f"{key}_1"
            if entity not in entities or entity == workspace:
                what = f"object or fixture to place of {source.at('place', key)}"
                raise UnknownNameError(what, entity, set(entities) - {workspace})
            if isinstance(place, tuple):
                predicate, support = place
                atoms.append(Atom(predicate, (entity, support)))
            else:
                kind = "fixture" if entity in content.fixtures else "object"
                content.regions.setdefault(workspace, {})[f"{entity}_start"] = _rectangle(place, kind)
                atoms.append(Atom("On", (entity, f"{workspace}_{entity}_start")))
                self.places.setdefault(f"{workspace}_{entity}_start", source.at("place", key))
            self.places.setdefault(str(atoms[-1]), source.at("place", key))
        return atoms

    def _declare_sites(self, content: Content) -> None:
        """Declare the regions of models that atoms refer to.

        Raises:
            UnknownNameError: The region does not exist; the message lists the valid ones.
        """
        entities = {**content.fixtures, **content.objects}
        declared = {f"{target}_{name}" for target, names in content.regions.items() for name in names}
        named = [(name, str(a)) for e in (*content.init, *content.goal) for a in e.atoms() for name in a.args]
        for name, where in (*named, *((zone, zone) for zone in content.zones)):
            target = max((t for t in entities if name.startswith(f"{t}_")), key=len, default=None)
            if name in entities or name in declared or target is None or entities[target] in WORKSPACES:
                continue
            site = name.removeprefix(f"{target}_")
            if site not in (valid := model_regions(entities[target])):
                what = f"region of {target} ({self.places[where]}: {where})"
                raise UnknownNameError(what, site, valid or ("none",))
            content.regions.setdefault(target, {})[site] = {}


def placed_by(atom: Atom) -> str | None:
    """Return the object or fixture that an init atom gives its place; None where it places nothing."""
    return atom.args[0] if len(atom.args) == 2 and atom.predicate in PLACING else None


def _rectangle(place: Values, kind: str) -> dict[str, Any]:
    """Return the keys of the region of a place: `ranges`, `yaw` and `rgba`."""
    region = dict(place)
    if "ranges" in region:
        return region
    at, half = region.pop("at"), region.pop("half", (_HALF_EXTENT[kind],) * 2)
    region["ranges"] = [[round(at[k % 2] + (-1, 1)[k // 2] * half[k % 2], 6) for k in range(4)]]
    return region


def _replaced(known: Values, own: Values) -> dict[str, Any]:
    """Return the keys of a scene's region with a task's: `at` replaces `ranges`, and `ranges` replaces `at`."""
    gone = ("ranges",) if "at" in own else ("at", "half") if "ranges" in own else ()
    return {**{key: value for key, value in known.items() if key not in gone}, **own}


def _with_entries(parameters: Values) -> dict[str, Any]:
    """Return parameters, those that are lists also entry by entry: `x_0`, `x_1`."""
    lists = {key: value for key, value in parameters.items() if isinstance(value, list)}
    return {
        **parameters,
        **{f"{key}_{i}": item for key, items in lists.items() for i, item in enumerate(items)},
    }


def _fill(node: Any, values: Values, where: str) -> Any:
    """Return `node` with every `$parameter` replaced; a text that is only a parameter becomes its value.

    Raises:
        UnknownNameError: A parameter has no value.
    """
    if isinstance(node, Mapping):
        keys = [_fill(key, values, where) for key in node]
        if wrong := [key for key in keys if not isinstance(key, str)]:
            raise LiberoError(f"{where}: the key {shown(wrong[0])} is not a text")
        return {key: _fill(value, values, where) for key, value in zip(keys, node.values(), strict=True)}
    if isinstance(node, list | tuple):
        return [_fill(item, values, where) for item in node]
    if not isinstance(node, str) or "$" not in node:
        return node
    if node[1:] in values:
        return values[node[1:]]
    try:
        return Template(node).substitute(values)
    except (KeyError, ValueError) as error:
        raise UnknownNameError(f"parameter of {where} in {node!r}", str(error), values) from error
