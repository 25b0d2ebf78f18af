"""Models of user-defined objects from their MJCF files, see `libero_env.assets.object_mjcf`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import SubElement

from libero_env.assets.object_mjcf import OFFSETS, arrange_body, read_object
from libero_env.assets.original_mjcf import read_spec
from libero_env.objects import ObjectModel

STATES = ("open", "close", "turnon", "turnoff")
_DAMPING = 0.0005  # [N s/m and N m s/rad] damping of a free joint, as in robosuite


def model_of(item: Any, category: str) -> ObjectModel:
    """Return the model of an object with an MJCF file: of this package, or of a subclass of robosuite's class.

    Raises:
        LiberoError: The file is missing, is not MJCF, or has no body with a geom.
    """
    duplicate = bool(getattr(item, "duplicate_collision_geoms", False))
    xml, offsets = read_object(Path(item.file), category, duplicate)
    specs = getattr(item, "joint_specs", None)
    listed = [{"type": "free"}] if specs == "default" else [j for j in specs or () if isinstance(j, dict)]
    free = [joint for joint in listed if joint.get("type") == "free"]
    axis = getattr(item, "rotation_axis", None)
    rotation = getattr(item, "rotation", None)
    if rotation is not None and not isinstance(rotation, Mapping):
        rotation = {axis or "z": rotation}
    given = (getattr(item, "object_properties", None) or {}).get("articulation", {})
    articulation = {state: given.get(f"default_{state}_ranges") for state in STATES}
    place: dict[str, Any] = {name: offsets[name] for name in OFFSETS}
    return ObjectModel(
        category=category,
        spec=read_spec(xml, Path(item.file)),
        joint_damping=float(free[0].get("damping", _DAMPING)) if free else _DAMPING,
        rotation={axis: (float(low), float(high)) for axis, (low, high) in (rotation or {}).items()},
        rotation_axis=axis,
        bottom_offset=place["bottom"],
        top_offset=place["top"],
        horizontal_radius=max(map(abs, place["horizontal_radius"][:2])),
        articulation={state: (float(r[0]), float(r[1])) for state, r in articulation.items() if r},
    )


def accept_plain_files(target_class: Any) -> None:
    """Let a subclass of robosuite's MujocoXMLObject read plain files."""
    read = target_class._get_object_subtree

    def subtree(self: Any) -> Any:
        path = Path(self.file)
        body = arrange_body(self.worldbody, path)
        outer = next(found for found in self.worldbody.iter("body") if body in list(found))
        for name, pos in read_object(path, "object")[1].items():
            if outer.find(f"site[@name='{name}_site']") is None:
                site = {"name": f"{name}_site", "pos": " ".join(map(str, pos))}
                SubElement(outer, "site", site | {"rgba": "0 0 0 0", "size": "0.005"})
        return read(self)

    target_class._get_object_subtree = subtree
