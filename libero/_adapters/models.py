"""The models of the facade: the original's where they are installed, and user-defined objects from their MJCF files.

robosuite expects in the world body of an object an outer body with the sites `bottom_site`, `top_site` and
`horizontal_radius_site`, in it the body `object`, with collision geoms in group 0 and visual geoms in group 1. In plain
files one body is enough; what is missing is derived from its shape.
"""

from collections.abc import Mapping
from copy import deepcopy
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from libero_env.assets.original_mjcf import attachable_xml, read_file, read_spec
from libero_env.assets.pack import ORIGINAL, Pack, facade_assets, original_folder, pack_of
from libero_env.errors import LiberoError
from libero_env.mujoco_compat import mujoco
from libero_env.objects import ObjectModel

OFFSETS = ("bottom", "top", "horizontal_radius")  # sites, without their suffix
Offsets = Mapping[str, tuple[float, ...]]
STATES = ("open", "close", "turnon", "turnoff")
_DAMPING = 0.0005  # [N s/m and N m s/rad] damping of a free joint, as in robosuite


def facade_pack() -> Pack:
    """Return the pack of the facade; see `libero_env.assets.pack.facade_assets`."""
    return pack_of(facade_assets())


def assets_folder() -> Path | None:
    """Return the folder of the original's models if the facade uses them; its files are not checked."""
    value = facade_assets().value
    folder = original_folder() if value == ORIGINAL else Path(value).expanduser()
    return folder if folder.is_dir() else None


def model_of(item: Any, category: str) -> ObjectModel:
    """Return the model of an object with an MJCF file or one that robosuite generates, such as its `BoxObject`.

    Offsets and radius are those of the object's class where it defines them.

    Raises:
        LiberoError: The file is missing, is not MJCF, or has no body with a geom.
    """
    file = Path(getattr(item, "file", f"{category}.xml"))
    if hasattr(item, "file"):
        duplicate = bool(getattr(item, "duplicate_collision_geoms", False))
        xml, offsets = read_object(file, category, duplicate)
    else:
        xml, offsets = _generated(item, category), {}
    place: dict[str, Any] = {name: _own_offset(item, name, offsets.get(name)) for name in OFFSETS}
    specs = getattr(item, "joint_specs", None)
    listed = [{"type": "free"}] if specs == "default" else [j for j in specs or () if isinstance(j, dict)]
    free = [joint for joint in listed if joint.get("type") == "free"]
    axis = getattr(item, "rotation_axis", None)
    rotation = getattr(item, "rotation", None)
    if rotation is not None and not isinstance(rotation, Mapping):
        rotation = {axis or "z": rotation}
    ranges = (getattr(item, "object_properties", None) or {}).get("articulation", {})
    articulation = {state: ranges.get(f"default_{state}_ranges") for state in STATES}
    return ObjectModel(
        category=category,
        spec=read_spec(xml, file),
        joint_damping=float(free[0].get("damping", _DAMPING)) if free else _DAMPING,
        rotation={axis: (float(low), float(high)) for axis, (low, high) in (rotation or {}).items()},
        rotation_axis=axis,
        bottom_offset=place["bottom"],
        top_offset=place["top"],
        horizontal_radius=max(map(abs, place["horizontal_radius"][:2])),
        articulation={state: (float(r[0]), float(r[1])) for state, r in articulation.items() if r},
    )


def _generated(item: Any, category: str) -> str:
    """Return the MJCF of an object of robosuite's without a file; names lose its prefix, which scenes add."""
    body, assets = deepcopy(item.get_obj()), deepcopy(list(item.asset))
    for site in body.findall("site"):
        if (site.get("name") or "").endswith("default_site"):  # scenes add it, too
            body.remove(site)
    for element in (part for root in (body, *assets) for part in root.iter()):
        for key, value in element.attrib.items():
            element.set(key, value.removeprefix(item.naming_prefix))
    return attachable_xml(category, assets, body)


def _own_offset(item: Any, name: str, measured: tuple[float, ...] | None) -> Any:
    """Return an offset or the radius as a user's class has it, (3,) m, or else the measured one."""
    attribute = name if name.endswith("radius") else f"{name}_offset"
    owner = next((cls for cls in type(item).__mro__ if attribute in vars(cls)), type(item))
    if measured is not None and owner.__module__.startswith(("robosuite.", "libero.")):
        return measured
    value = np.ravel(getattr(item, attribute)).astype(float)
    return tuple(value.tolist()) if value.size == 3 else (float(value[0]), 0.0, 0.0)


def accept_plain_files(target_class: Any) -> None:
    """Let a subclass of robosuite's MujocoXMLObject read plain files."""
    read = target_class._get_object_subtree

    def subtree(self: Any) -> Any:
        path = Path(self.file)
        body = arrange_body(self.worldbody, path)
        outer = next(parent for parent in self.worldbody.iter("body") if body in list(parent))
        for name, pos in read_object(path, "object")[1].items():
            if outer.find(f"site[@name='{name}_site']") is None:
                site = {"name": f"{name}_site", "pos": " ".join(map(str, pos))}
                SubElement(outer, "site", site | {"rgba": "0 0 0 0", "size": "0.005"})
        return read(self)

    target_class._get_object_subtree = subtree


def read_object(path: Path, category: str, duplicate: bool = False) -> tuple[str, Offsets]:
    """Return the MJCF that scenes attach, and lowest point, highest point and radius relative to the root body, m.

    Args:
        path: MJCF file.
        category: Category, the prefix of the names of its assets.
        duplicate: Whether collision geoms are visible although there are visual geoms.

    Raises:
        LiberoError: The file is missing, is not MJCF, or has no body with a geom.
    """
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _read_object(path.absolute(), category, duplicate, stamp)


@lru_cache(maxsize=64)
def _read_object(path: Path, category: str, duplicate: bool, _: int) -> tuple[str, Offsets]:
    assets, world = read_file(path)
    body = arrange_body(world, path)
    solid = [geom for geom in body.iter("geom") if geom.get("group") != "1"]
    if duplicate:
        _add_visuals(body, solid)
    collision_meshes = {geom.get("mesh") for geom in solid}
    for asset in assets:
        if asset.tag == "mesh" and asset.get("name") in collision_meshes:
            asset.attrib.setdefault("inertia", "convex")  # mass by volume; the mesh may be open
    try:
        offsets = {
            name: tuple(map(float, site.get("pos", "0 0 0").split()))
            for name in OFFSETS
            if (site := world.find(f"body/site[@name='{name}_site']")) is not None
        }
        xml = attachable_xml(category, assets, body)
        return xml, offsets if len(offsets) == len(OFFSETS) else {**_measured(xml), **offsets}
    except ValueError as error:
        raise LiberoError(f"{path}: MuJoCo cannot read it: {' '.join(str(error).split())}") from error


def arrange_body(world: Element, path: Path) -> Element:
    """Arrange a world body in place as robosuite expects, and return the body `object`.

    Raises:
        LiberoError: No body has a geom.
    """
    body = world.find("body/body[@name='object']")
    if body is None:
        body = next((one for one in world.iter("body") if one.find("geom") is not None), None)
        if body is None:
            raise LiberoError(
                f"{path}: no body with a geom; expected <worldbody><body><geom .../></body></worldbody>"
            )
        sites = [s for s in world.iter("site") if (s.get("name") or "").removesuffix("_site") in OFFSETS]
        for old in world.findall("body"):
            world.remove(old)
        outer = SubElement(world, "body")
        outer.extend(sites)
        outer.append(body)
        body.attrib = {"name": "object"}
    for geom in body.iter("geom"):
        geom.attrib.setdefault("group", "0")
    if all(geom.get("group") != "1" for geom in body.iter("geom")):
        _add_visuals(body, list(body.iter("geom")))
    return body


def _add_visuals(body: Element, solid: list[Element]) -> None:
    """Add visual copies of collision geoms."""
    for parent in list(body.iter("body")):
        for geom in [geom for geom in parent.findall("geom") if geom in solid]:
            shown = {key: value for key, value in geom.attrib.items() if key != "name"}
            SubElement(
                parent, "geom", shown | {"group": "1", "contype": "0", "conaffinity": "0", "mass": "0"}
            )


def _measured(xml: str) -> dict[str, tuple[float, ...]]:
    """Return lowest point, highest point and radius of the collision geoms, with joints at zero."""
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for geom in np.flatnonzero(model.geom_group == 0):
        mat = data.geom_xmat[geom].reshape(3, 3)
        middle = data.geom_xpos[geom] + mat @ model.geom_aabb[geom, :3]
        half = np.abs(mat) @ model.geom_aabb[geom, 3:]
        low, high = np.minimum(low, middle - half), np.maximum(high, middle + half)
    radius = float(np.abs([low[:2], high[:2]]).max())
    return {
        "bottom": (0.0, 0.0, float(low[2])),
        "top": (0.0, 0.0, float(high[2])),
        "horizontal_radius": (radius, 0.0, 0.0),
    }
