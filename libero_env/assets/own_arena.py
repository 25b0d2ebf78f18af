"""Workspaces of users: a folder with `workspace.yaml`, in which a table is described or a room in MJCF is named."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Required

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from libero_env.errors import InvalidInputError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.folder import Length, Point, Text, digest, read_spec
from libero_env.objects.mjcf import file_inside
from libero_env.storage import read_yaml_file
from libero_env.validation import validate
from libero_env.workspaces import FILE, BuiltinWorkspace

FLOOR, TABLE_TOP = "floor", "table_top"
_HALF_THICKNESS, _LEG_RADIUS = 0.025, 0.025  # [m] of a table
_SMALLEST = 0.3  # [m] length of a table, whose legs stand 0.1 m from its edges
_SHOULDER, _REACH = (
    0.333,
    1.0,
)  # [m] of the Panda: height above its base, and from there to the fingertips at most
_SEEN_GROUP = 1  # as `libero_env.sim.render.Renderer` draws


class Table(TypedDict):
    """A plain table; see `OwnWorkspace`."""

    pos: Point
    size: Annotated[list[Annotated[Length, Field(ge=_SMALLEST)]], Field(min_length=2, max_length=2)]


class OwnWorkspace(TypedDict, total=False):
    """Content of `workspace.yaml`.

    Attributes:
        extends: Workspace of the benchmark whose room, lights, cameras, mount and styles are taken; cameras move with
            the origin of the regions.
        table: A plain table in its place: the middle of its top, and its lengths along x and y, [m].
        model: MJCF file of a room, with its floor and its table, in place of all of these; see `read_room`.
        robot: Position of the arm's base, [m]; by default it is as far from the table as there.
    """

    extends: Required[BuiltinWorkspace]
    table: Table
    model: Text
    robot: Point


def read_own(directory: Path) -> tuple[OwnWorkspace, np.ndarray | None, dict[str, Any]]:
    """Return the content of a user's workspace, the origin of its regions, and parameters of its room.

    Raises:
        InvalidInputError: A file is missing or not valid; the message names file and line.
    """
    file = read_yaml_file(directory / FILE)
    given: OwnWorkspace = validate(OwnWorkspace, file.data, source=file.source, line_of=file.line_of)
    if "table" in given and "model" in given:
        raise InvalidInputError(f"{file.at(('model',))}: it has table and model; expected one of them")
    parameters: dict[str, Any] = {"own": digest(directory)}
    if "model" in given:
        path = file_inside(directory, given["model"], file.at(("model",)))
        return given, read_room(path)[1], {**parameters, "model": path, "table": None, "furniture": ()}
    if "table" in given:
        origin = np.array(given["table"]["pos"])
        if origin[2] <= 2 * _HALF_THICKNESS:
            raise InvalidInputError(
                f"{file.at(('table', 'pos'))}: its top is {origin[2]:g} m over the floor; expected more than "
                f"{2 * _HALF_THICKNESS:g}"
            )
        return given, origin, {**parameters, "table": _table(origin, given["table"]["size"])}
    return given, None, parameters


def require_reach(
    directory: Path, robot: Sequence[float], surface: Sequence[float], size: Sequence[float]
) -> None:
    """Raise an InvalidInputError where an arm on its base reaches no part of the surface, whatever the task is.

    Args:
        robot: Position of its base, (3,) [m].
        surface: Middle of the surface, (3,) [m].
        size: Lengths of the surface along x and y, [m].
    """
    away = np.abs(np.subtract(surface, (*robot[:2], robot[2] + _SHOULDER)))
    away[:2] = np.maximum(away[:2] - np.array(size) / 2, 0)
    if (distance := float(np.linalg.norm(away))) > _REACH:
        raise InvalidInputError(
            f"{directory / FILE}: the arm, with its base (robot) at {[round(float(v), 3) for v in robot]}, reaches "
            f"nothing on the table at {[round(float(v), 3) for v in surface]}: it is {distance:.2f} m from its "
            f"shoulder; expected at most {_REACH:g} m"
        )


def read_room(path: Path) -> tuple[mujoco.MjSpec, np.ndarray]:
    """Return a room, and the position of its site `table_top`, the origin of the regions, in the world.

    Its geoms are solid as they say. Where none is in group 1, which pictures show, all are seen.

    Raises:
        InvalidInputError: It has no geom `floor` or site `table_top`, has joints, or is not valid; see
            `libero_env.objects.mjcf`.
    """
    room = read_spec(path)
    for kind, name, found in (("geom", FLOOR, room.geoms), ("site", TABLE_TOP, room.sites)):
        if name not in [element.name for element in found]:
            raise InvalidInputError(f"{path}: it has no {kind} {name!r}, which a workspace needs; add one")
    if room.joints:
        raise InvalidInputError(
            f"{path}: it has a joint, {room.joints[0].name!r}; what moves is a fixture or an object of the task"
        )
    if all(geom.group != _SEEN_GROUP for geom in room.geoms):
        for geom in room.geoms:
            geom.group = _SEEN_GROUP
    try:
        model = room.copy().compile()
    except ValueError as error:
        raise InvalidInputError(f"{path}: {' '.join(str(error).split())}") from None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return room, data.site(TABLE_TOP).xpos.copy()


def _table(top: np.ndarray, size: list[float]) -> Mapping[str, Any]:
    """Return a table on four legs, as the files of the benchmark's workspaces describe one."""
    x, y = np.array(size) / 2
    height = float(top[2]) / 2 - _HALF_THICKNESS
    down = -_HALF_THICKNESS - height
    feet = [[sx * (x - 0.1), sy * (y - 0.1), down] for sx in (1, -1) for sy in (1, -1)]
    legs = [{"type": "cylinder", "pos": foot, "size": [_LEG_RADIUS, height, 0.0]} for foot in feet]
    half = [float(x), float(y), _HALF_THICKNESS]
    return {
        "bodies": {"table": [float(top[0]), float(top[1]), float(top[2]) - _HALF_THICKNESS]},
        "collision": [{"name": "table_collision", "size": half, "friction": [1.0, 0.005, 0.0001]}],
        "visual": [{"name": "table_visual", "type": "box", "size": half}, *legs],
        "sites": {TABLE_TOP: [0.0, 0.0, _HALF_THICKNESS]},
        "gloss": [0.2, 0.0],
        "style": {"pattern": "wood", "period": 1.0, "colours": [[0.78, 0.71, 0.63], [0.72, 0.64, 0.55]]},
    }
