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
from typing import Any

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.storage import read_yaml
from libero_env.tasks.cameras import Camera
from libero_env.tasks.expression import And, Atom, Expression
from libero_env.tasks.merging import Content, Merge, Values, placed_by
from libero_env.tasks.problem import Problem, ProblemError, Region
from libero_env.tasks.schema import KEYS, Source
from libero_env.tasks.task import FILE, Task, check_name
from libero_env.text import suggest
from libero_env.workspaces import BUILTIN_WORKSPACES, WORKSPACES

# field of a problem, or section of a task file -> key
_KEYS_OF = {"name": "problem", "domain": "problem", "views": "cameras"}


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

    Examples:
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
    merge = Merge(check_models, source.places)
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


def _problem_class(workspace: str) -> str:
    """Return the original's name of the problems on a workspace."""
    if workspace in BUILTIN_WORKSPACES:
        return read_yaml(f"assets/workspaces/{workspace}.yaml")["problem"]
    from libero_env.assets.arena import load_workspace  # with MuJoCo

    return load_workspace(workspace).problem


def _problem(content: Content, language: str, source: Source, places: Mapping[str, str]) -> Problem:
    """Return the problem of what all definitions say together."""
    if not content.goal:
        raise InvalidInputError(
            f"{source.at()}: it has no goal; add one, such as `goal: On red_coffee_mug_1 plate_1`"
        )
    counts = Counter(content.objects.values())  # those of a category stand together
    objects = {f"{category}_{i + 1}": category for category, n in counts.items() for i in range(n)}
    placed = {placed_by(atom) for atom in content.init}
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
            name=content.texts.get("problem") or _problem_class(content.workspace(source)[1]),
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
