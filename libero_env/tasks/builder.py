"""From YAML to a `Problem`: the tasks of the benchmark, those of users' files, and those of one call.

    scene: kitchen
    furniture: [wooden_cabinet]
    objects: [akita_black_bowl, plate]
    place:
      wooden_cabinet_1: {at: [0, -0.3], yaw: pi}
      akita_black_bowl_1: [0, 0]
      plate_1: {at: [0.05, 0.2], half: 0.02}
    goal: On akita_black_bowl_1 plate_1
    language: put the bowl on the plate

A scene gives objects and places. A task names its scene, sets the scene's parameters (`with`), and adds to the keys of
the scene or replaces their values. Keys of both:

    scene            a scene of the benchmark with its objects (`kitchen_scene1`), an empty one (`kitchen`,
                     `living_room`, `study`, `coffee`, `table`, `floor`), or the YAML file of a scene
    with             parameter: value. `$x` is the value of the parameter x and `$x_0` the first of a list
    furniture        categories of fixtures, in addition to those of the scene; numbered like objects
    fixtures         name: category
    objects          categories in joint order, in addition to those of the scene; `plate` is plate_1,
                     `{plate: 2}` is plate_1 and plate_2
    place            object or fixture: its initial place, instead of the one that the scene gives. Either [x, y] on the
                     workspace in metres (x points away from the robot, y to its left), or `{at: [x, y], half: h,
                     yaw: angle}` for any point within h of it, or its support: `plate_1`,
                     `wooden_cabinet_1_top_side`, `In wooden_cabinet_1_top_region`
    goal             one atom, a list of atoms that must all hold, or an expression: `(Or (Open a) (Not (On b c)))`;
                     an atom is `On a b`, `(On a b)` or, in Python, `("On", "a", "b")`
    language         `:language` of the task file; by default the words of the task's name
    name             name of the task
    problem          name of the problem class, as in BDDL; by default that of the workspace
    regions          target: {name: region}; the region is empty for a site of the target's model, else `at` (x, y)
                     and `half` (one number or two), or `ranges` [[x0, y0, x1, y1], ...], with `yaw` (one
                     angle or two) and `rgba`; metres and radians, angles may be arithmetic with pi.
                     `target: [a, b]` are sites of the model; a region that a task sets to `null` is removed
    init             atoms such as `On plate_1 stove_1`; those of a task's `init_also` come first
    obj_of_interest  names; by default the objects and then the fixtures that the goal refers to, where a region
                     stands for its target
    scene_properties key: value
    cameras          name: {pos, lookat or quat, fovy, body} of a camera that is added; see
                     `libero_env.tasks.cameras.Camera`
    zones            regions from which the robot should keep away, see `libero_env.sim.costs`

Regions that are sites of a model, such as `basket_1_contain_region`, need no declaration.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from string import Template
from typing import Any

from libero_env.errors import InvalidInputError, LiberoError, UnknownNameError
from libero_env.paths import objects_dir
from libero_env.storage import read_yaml
from libero_env.tasks.cameras import Camera
from libero_env.tasks.problem import PLACING, And, Atom, Expression, Problem, ProblemError, Region
from libero_env.tasks.schema import KEYS, Source, check_definition, read_definition, scene_file
from libero_env.tasks.task import FILE, Task, check_name
from libero_env.text import shown, suggest
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
# field of a problem, or section of a task file -> key
_KEYS_OF = {"name": "problem", "domain": "problem", "views": "cameras"}

Values = Mapping[str, Any]


def load_scene(name: str) -> Values:
    """Return the definition of a scene of the benchmark."""
    return read_yaml(f"tasks/data/scenes/{name}.yaml")


@cache
def scene_names() -> tuple[str, ...]:
    """Return the names that `load_scene` accepts, sorted."""
    files = (resources.files("libero_env.tasks") / "data" / "scenes").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def language_from_name(name: str) -> str:
    """Return the words of a task's name, without the scene prefix (`KITCHEN_SCENE1_`), as an instruction."""
    words = name.split("_")
    prefix = next((i + 1 for i, word in enumerate(words) if word.startswith("SCENE")), 0)
    return " ".join(words[prefix:])


def make_task(name: str | None = None, **definition: Any) -> Task:
    """Return a user-defined task, from the keys that a task's YAML file may contain.

    Args:
        name: Name of the task and of its files; by default the words of the language, joined by underscores.
        definition: Keys such as `scene`, `objects`, `place`, `goal` and `language`, and their values; see
            `libero_env.tasks.builder`. Values that are None are ignored.

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
    return task_from_definition({**definition, **({"name": name} if name else {})}, Source("task"))


def task_from_definition(definition: Values, source: Source, *, shares_with: bool = False) -> Task:
    """Return the task of a definition; see `make_task`.

    Args:
        definition: Content of a YAML file.
        source: Where it stands.
        shares_with: Whether its parameters are also those of other tasks, so that it need not use all of them.

    Raises:
        LiberoError: The definition is not valid; the message starts with file and line and lists the valid names.
    """
    name, problem = _build(definition, source, check_models=True, shares_with=shares_with)
    return Task(FILE, 0, name, problem.language, problem.language, problem)


def build_problem(scene: Values | str | None, task: Values) -> Problem:
    """Return the problem of a task in a scene, whose objects need no models.

    Args:
        scene: Keys shared by the tasks of the scene, or its name.
        task: `name`, `with` (values of the scene's parameters) and the other keys of the task.

    Raises:
        LiberoError: A key or a parameter does not exist, a value is not valid, or an atom refers to a name that is not
            declared.
    """
    return _build({**task, "scene": scene}, Source(f"task {task.get('name', '?')}"), check_models=False)[1]


def check_keys(definition: Values, source: Source, *more: str) -> None:
    """Check the keys of a definition.

    Raises:
        InvalidInputError: A key does not exist; the message has the nearest one.
    """
    for key in definition:
        if key not in (*KEYS, *more):
            raise InvalidInputError(
                f"{source.at(key)}: {key} is an unknown key.{suggest(key, KEYS)} Valid: {', '.join(KEYS)}"
            )


def entities_in_goal(goal: Expression, regions: Iterable[Region], *declared: Iterable[str]) -> list[str]:
    """Return the declared names that a goal refers to, in the order declared; for a region its target."""
    targets = {region.address: region.target for region in regions}
    named = {targets.get(name, name) for atom in goal.atoms() for name in atom.args}
    return [name for names in declared for name in names if name in named]


def model_regions(category: str) -> tuple[str, ...]:
    """Return the regions that are sites of an object's or fixture's model, such as `contain_region`, sorted.

    Raises:
        UnknownNameError: No object has this name.
    """
    from libero_env.assets.pack import select_pack

    names = {site.name for site in select_pack().build(category).spec.sites}
    return tuple(sorted(names - _PLACEMENT_SITES - {""}))


def _build(
    definition: Values, source: Source, *, check_models: bool, shares_with: bool = False
) -> tuple[str, Problem]:
    """Return the name and the problem of a task's definition.

    Args:
        definition: Keys and values.
        source: Where it stands.
        check_models: Whether categories must be those of objects, and undeclared regions are looked up in their models.
        shares_with: See `task_from_definition`.
    """
    check_keys(definition, source)
    merge = _Merge(check_models)
    content = merge.content({k: v for k, v in definition.items() if v is not None}, {}, source)
    for parameter in () if shares_with else definition.get("with") or ():
        if parameter not in merge.parameters:
            raise InvalidInputError(
                f"{source.at('with', parameter)}: neither the task nor its scene uses the parameter {parameter}; "
                f"leave it out.{suggest(parameter, merge.parameters)}"
            )
    language = content.texts.get("language") or language_from_name(content.texts.get("name", ""))
    name = content.texts.get("name") or re.sub(r"\W+", "_", language.strip().lower()).strip("_")
    if not language:
        raise InvalidInputError(
            f"{source.at()}: it has neither a name nor a language; add `language:` with the instruction"
        )
    try:
        check_name(name)
    except LiberoError as error:
        raise InvalidInputError(f"{source.at('language')}: {error}; add `name:`") from None
    return name, _problem(content, language, source, merge.places)


@dataclass
class _Content:
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


class _Merge:
    """Merging of a definition with its scene, and of that with its own.

    Args:
        check_models: Whether models of objects are asked for, see `_build`.

    Attributes:
        parameters: Parameters that the definitions use.
        places: Atom, region, camera or zone -> `file:line` that it comes from, for errors that are found at the end.
    """

    def __init__(self, check_models: bool):
        self._check_models = check_models
        self.places: dict[str, str] = {}
        self.parameters: set[str] = set()

    def content(self, definition: Values, inherited: Values, source: Source) -> _Content:
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
            *(atom for atom in init if _placed_by(atom) not in moved),
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

    def _scene(self, definition: Values, parameters: Values, source: Source) -> _Content:
        """Return the content of the scene: one of the benchmark, an empty one, or that of a file."""
        scene, valid = definition.get("scene"), (*EMPTY, *scene_names())
        if scene is None:
            fixtures = definition.get("fixtures")
            if isinstance(fixtures, Mapping) and any(str(c) in WORKSPACES for c in fixtures.values()):
                return _Content()
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
            return _Content(fixtures={_TABLE if category == "table" else category: category})
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
        return named

    def _place(self, places: Values, content: _Content, source: Source) -> list[Atom]:
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

    def _declare_sites(self, content: _Content) -> None:
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


def _problem(content: _Content, language: str, source: Source, places: Mapping[str, str]) -> Problem:
    """Return the problem of what all definitions say together."""
    from libero_env.assets.arena import load_workspace

    if not content.goal:
        raise InvalidInputError(
            f"{source.at()}: it has no goal; add one, such as `goal: On red_coffee_mug_1 plate_1`"
        )
    counts = Counter(content.objects.values())  # those of a category stand together
    objects = {f"{category}_{i + 1}": category for category, n in counts.items() for i in range(n)}
    placed = {_placed_by(atom) for atom in content.init}
    if missing := [
        name
        for name, category in {**content.fixtures, **objects}.items()
        if name not in placed and category not in WORKSPACES
    ]:
        raise InvalidInputError(
            f"{source.at('place')}: {', '.join(missing)} has no place; add it below place: `{missing[0]}: [0, 0]`"
        )
    regions = tuple(
        _region(name, target, keys, places.get(f"{target}_{name}", source.at("regions", target, name)))
        for target, named in content.regions.items()
        for name, keys in named.items()
        if keys is not None
    )
    cameras = tuple(_camera(name, keys, places[f"camera {name}"]) for name, keys in content.cameras.items())
    first, *others = content.goal
    try:
        goal = And(tuple(content.goal)) if others or isinstance(first, Atom) else first
        interest = content.interest
        if interest is None:
            interest = entities_in_goal(goal, regions, objects, content.fixtures)
        return Problem(
            name=content.texts.get("problem") or load_workspace(content.workspace(source)[1]).problem,
            language=language,
            fixtures=content.fixtures,
            objects=objects,
            regions=regions,
            init=tuple(content.init),
            obj_of_interest=tuple(interest),
            scene_properties=content.styles,
            goal=goal,
            cameras=cameras,
            zones=tuple(content.zones),
        )
    except ProblemError as error:
        wrong = error.violations[0]
        label = wrong.part
        if isinstance(label, int):
            label = str((content.init if wrong.section == ":init" else goal.atoms())[label])
        key = wrong.section.removeprefix(":")
        where = places.get(str(label), source.at(_KEYS_OF.get(key, key)))
        raise InvalidInputError(f"{where}: {wrong.what}; expected {wrong.expected}") from None
    except InvalidInputError as error:
        key = str(error.path[0]) if error.path else "goal"
        where = source.at(_KEYS_OF.get(key, key))
        raise InvalidInputError(f"{where}: {str(error).removeprefix('Problem: ')}") from None


def _placed_by(atom: Atom) -> str | None:
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


def _region(name: str, target: str, keys: Values, where: str) -> Region:
    """Return the region of its keys, which are from `where`."""
    ranges = [tuple(row) for row in keys.get("ranges", ())]
    if ("at" in keys) != ("half" in keys):
        has, lacks, such = ("at", "half", "0.02") if "at" in keys else ("half", "at", "[0, 0.2]")
        raise InvalidInputError(
            f"{where}: {target}_{name}: it has {has}, but no {lacks}; add such as {lacks}: {such}, metres"
        )
    if "at" in keys:
        if ranges:
            raise InvalidInputError(f"{where}: {target}_{name}: it has both at and ranges; leave out one")
        (x, y), (half_x, half_y) = keys["at"], keys["half"]
        ranges.append((x - half_x, y - half_y, x + half_x, y + half_y))
    yaw = (tuple(keys["yaw"]),) if "yaw" in keys else ()
    try:
        return Region(name, target, tuple(ranges), yaw, tuple(keys.get("rgba", ())))
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


def _camera(name: str, keys: Values, where: str) -> Camera:
    """Return the camera of its keys, which are from `where`."""
    try:
        return Camera(name, **keys)
    except InvalidInputError as error:
        raise InvalidInputError(f"{where}: {error}") from None


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
