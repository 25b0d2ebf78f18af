"""Conversion of the YAML definition of a task into a `Problem`.

A scene gives objects and places. A task names its scene, sets the scene's parameters (`with`), and adds to or replaces
keys of the scene. Keys of both:

    problem          name of the problem class, as in BDDL
    language         `:language` of the task file; by default the words of the task's name
    fixtures         name: category
    objects          categories in joint order; `plate` is plate_1, `{plate: 2}` is plate_1 and plate_2
    regions          target: {name: region}; the region is empty for a site of the target's model, else `at` (x, y)
                     and `half` (one number or two), or `ranges` [[x0, y0, x1, y1], ...], with `yaw` (one
                     angle or two) and `rgba`; metres and radians, angles may be arithmetic with pi.
                     `target: [a, b]` are sites of the model
    init             atoms such as `On plate_1 stove_1`; those of a task's `init_also` come first
    obj_of_interest  names; by default the objects and then the fixtures that the goal refers to, where a region
                     stands for its target
    scene_properties key: value
    goal             a list of atoms that must all hold, or one expression: `(Or (Open a) (Not (On b c)))`

`$x` is the value of the parameter x and `$x_0` the first of a list; a region that a task sets to `null` is removed.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib import resources
from string import Template
from typing import Any

from libero_env.errors import LiberoError, UnknownNameError
from libero_env.storage import parse_yaml
from libero_env.tasks import bddl
from libero_env.tasks.problem import And, Expression, Problem, Region
from libero_env.tasks.sexpr import number

KEYS = (
    "problem",
    "language",
    "fixtures",
    "objects",
    "regions",
    "init",
    "init_also",
    "obj_of_interest",
    "scene_properties",
    "goal",
)


@cache
def load_data(name: str) -> Any:
    """Return the content of a file in `data/`; it is shared, do not change it.

    Raises:
        UnknownNameError: The file does not exist.
    """
    folder = resources.files("libero_env.tasks") / "data"
    file = folder.joinpath(*name.split("/"))
    if not file.is_file():
        raise UnknownNameError("task file", name, (entry.name for entry in folder.iterdir()))
    return parse_yaml(file.read_text(encoding="utf-8"))


def load_scene(name: str) -> Mapping[str, Any]:
    """Return the definition of a scene of the benchmark."""
    return load_data(f"scenes/{name}.yaml")


def scene_names() -> tuple[str, ...]:
    """Return the names that `load_scene` accepts, sorted."""
    files = (resources.files("libero_env.tasks") / "data" / "scenes").iterdir()
    return tuple(sorted(file.name.removesuffix(".yaml") for file in files if file.name.endswith(".yaml")))


def fill_parameters(definition: Mapping[str, Any], given: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return a definition in which every `$parameter` is replaced by its value.

    Args:
        definition: Definition of a task or scene.
        given: Parameter -> value.
        where: Name of the source in error messages.

    Raises:
        UnknownNameError: A parameter has no value.
    """
    return _fill(definition, _parameters(given), where)


def build_problem(scene: Mapping[str, Any], task: Mapping[str, Any]) -> Problem:
    """Return the problem of a task in a scene.

    Args:
        scene: Keys shared by the tasks of the scene.
        task: `name`, `scene`, `with` (values of the scene's parameters) and the keys of the task.

    Raises:
        LiberoError: A key or a parameter does not exist, or an atom refers to a name that is not declared.
    """
    where = f"task {task.get('name', '?')}"
    own = {key: value for key, value in task.items() if key not in ("name", "scene", "with")}
    for key in [*scene, *own]:
        if key not in KEYS:
            raise UnknownNameError(f"key of {where} or its scene", key, KEYS)
    definition = {"language": language_from_name(task.get("name", "")), **scene, **own}
    definition["regions"] = _merge(_sites(scene.get("regions")), _sites(own.get("regions")))
    for key in ("fixtures", "scene_properties"):
        definition[key] = _merge(scene.get(key) or {}, own.get(key) or {})
    definition = _fill(definition, _parameters(task.get("with", {})), where)
    for key in ("problem", "goal"):
        if key not in definition:
            raise LiberoError(f"{where}: neither it nor its scene has the key {key!r}; add it to the YAML")
    regions = tuple(_regions(definition["regions"]))
    objects = dict(_objects(definition.get("objects", [])))
    known = {*definition["fixtures"], *objects, *(region.address for region in regions)}
    atoms = lambda texts: tuple(bddl.parse_atom(text, known, where) for text in texts)  # noqa: E731
    goal = definition["goal"]
    goal = bddl.parse_expression(goal, known, where) if isinstance(goal, str) else And(atoms(goal))
    interest = definition.get("obj_of_interest")
    if interest is None:
        interest = entities_in_goal(goal, regions, objects, definition["fixtures"])
    return Problem(
        name=definition["problem"],
        language=definition["language"],
        fixtures=definition["fixtures"],
        objects=objects,
        regions=regions,
        init=atoms([*definition.get("init_also", []), *definition.get("init", [])]),
        obj_of_interest=tuple(interest),
        scene_properties=definition["scene_properties"],
        goal=goal,
    )


def language_from_name(name: str) -> str:
    """Return the words of a task's name, without the scene prefix (`KITCHEN_SCENE1_`), as an instruction."""
    words = name.split("_")
    prefix = next((i + 1 for i, word in enumerate(words) if word.startswith("SCENE")), 0)
    return " ".join(words[prefix:])


def entities_in_goal(goal: Expression, regions: Iterable[Region], *declared: Iterable[str]) -> list[str]:
    """Return the declared names that a goal refers to, in the order declared; for a region its target."""
    targets = {region.address: region.target for region in regions}
    named = {targets.get(name, name) for atom in goal.atoms() for name in atom.args}
    return [name for names in declared for name in names if name in named]


def _sites(regions: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return the regions with `target: [a, b]` expanded to `target: {a: {}, b: {}}`."""
    return {
        target: {name: {} for name in named} if isinstance(named, list) else named
        for target, named in (regions or {}).items()
    }


def _merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` updated by `over`, with mappings merged at every level; keys of `base` come first."""
    merged = dict(base)
    for key, value in over.items():
        nested = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if nested else value
    return merged


def _parameters(given: Mapping[str, Any]) -> dict[str, Any]:
    lists = {key: value for key, value in given.items() if isinstance(value, list)}
    return {**given, **{f"{key}_{i}": item for key, items in lists.items() for i, item in enumerate(items)}}


def _fill(node: Any, values: Mapping[str, Any], where: str) -> Any:
    """Return `node` with every `$parameter` replaced; a string that is only a parameter becomes its value."""
    if isinstance(node, Mapping):
        return {_fill_key(key, values, where): _fill(value, values, where) for key, value in node.items()}
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


def _fill_key(key: Any, values: Mapping[str, Any], where: str) -> str:
    filled = _fill(key, values, where)
    if not isinstance(filled, str):
        raise LiberoError(f"{where}: the key {key!r:.60} is {filled!r:.60}; expected a text")
    return filled


def _objects(entries: Sequence[str | Mapping[str, int]]):
    for entry in entries:
        for category, count in entry.items() if isinstance(entry, Mapping) else [(entry, 1)]:
            for i in range(1, count + 1):
                yield f"{category}_{i}", category


def _regions(targets: Mapping[str, Mapping[str, Any]]):
    for target, regions in targets.items():
        for name, region in regions.items():
            if region is not None:
                yield _region(name, target, region)


def _region(name: str, target: str, region: Mapping[str, Any]) -> Region:
    for key in region:
        if key not in ("at", "half", "ranges", "yaw", "rgba"):
            raise UnknownNameError(
                f"key of region {target}_{name}", key, ("at", "half", "ranges", "yaw", "rgba")
            )
    ranges = [(float(x0), float(y0), float(x1), float(y1)) for x0, y0, x1, y1 in region.get("ranges", [])]
    if "at" in region:
        if "half" not in region:
            raise LiberoError(
                f"region {target}_{name}: it has at, but no half; add such as half: 0.02, metres"
            )
        (x, y), half = region["at"], region["half"]
        half_x, half_y = half if isinstance(half, list | tuple) else (half, half)
        ranges.append((x - half_x, y - half_y, x + half_x, y + half_y))
    yaw: tuple[tuple[float, float], ...] = ()
    if "yaw" in region:
        angles = region["yaw"] if isinstance(region["yaw"], list | tuple) else [region["yaw"]] * 2
        low, high = (number(str(angle)) for angle in angles)
        yaw = ((low, high),)
    return Region(name, target, tuple(ranges), yaw, tuple(map(float, region.get("rgba", ()))))
