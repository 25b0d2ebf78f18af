"""Conversion of the original's MJCF files into what MuJoCo reads, with the semantics of the original's loader.

The files rely on that loader: it wrote default classes into the elements, dropped `<compiler>` and `<size>`, took the
first of two assets of one name, and computed the mass of a body from collision geoms (group 0) only.
"""

import copy
import os
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree as ET

from libero_env.errors import InvalidInputError, LiberoError
from libero_env.mujoco_compat import mujoco
from libero_env.objects.builtin.assemble import GLOWING_SITES, HIDDEN_GROUP
from libero_env.objects.model import GLOW_GROUP, ROOT_BODY
from libero_env.objects.xml_file import explain, parse_xml, place_of

REMEDY = "`libero assets check` lists what is missing, `libero assets download` downloads it"
_BODY_TAGS = ("body", "geom", "inertial", "joint", "site")
_ASSETS = ("material", "mesh", "texture")  # elements, and attributes that refer to them


def read_file(path: Path, within: Path | None = None) -> tuple[list[ET.Element], ET.Element]:
    """Return the assets of a file, with absolute paths, and its world body, with default classes written out.

    Args:
        within: Folder that files may be in which the file names; None for any.

    Raises:
        LiberoError: The file is missing or not XML, or names a file outside of `within`.
    """
    try:
        root = parse_xml(path)
    except InvalidInputError as error:
        raise LiberoError(f"{error}; {REMEDY}") from error
    for element in root.iterfind("asset/*[@file]"):
        file = path.parent.absolute() / element.get("file", "")
        if within is not None and not Path(os.path.normpath(file)).is_relative_to(within.absolute()):
            raise LiberoError(f"{place_of(element)}: {file} is outside of {within}; {REMEDY}")
        element.set("file", str(file))
    return written_out(root, path)


def written_out(root: ET.Element, path: Path) -> tuple[list[ET.Element], ET.Element]:
    """Return the assets and the world body of a file with default classes written out.

    Args:
        root: Elements of the file, with absolute paths; they are changed.
        path: The file, for messages.

    Raises:
        LiberoError: There is no world body.
    """
    world = root.find("worldbody")
    if world is None:
        raise LiberoError(f"{path}: no <worldbody>; {REMEDY}")
    classes = {c.get("class"): {e.tag: e.attrib for e in c} for c in root.findall("default/default")}
    for element in world.iter():
        for key, value in classes.get(element.attrib.pop("class", None), {}).get(element.tag, {}).items():
            element.attrib.setdefault(key, value)
    assets: dict[tuple[str, str], ET.Element] = {}
    for element in root.findall("asset/*"):
        if "file" in element.attrib and element.tag == "mesh":
            element.attrib.setdefault("name", Path(element.attrib["file"]).stem)
        if element.tag in _ASSETS:
            assets.setdefault((element.tag, element.get("name", "")), element)
    return list(assets.values()), world


@lru_cache(maxsize=64)
def object_xml(path: Path, category: str, within: Path | None = None) -> str:
    """Return the MJCF text of an object: one body `main` with the content of the file's body `object`.

    Args:
        path: MJCF file.
        category: Name of the category; it becomes the prefix of the assets' names.
        within: Folder that files may be in which the file names; None for any.

    Raises:
        LiberoError: A file is missing or not as expected.
    """
    assets, world = read_file(path, within)
    body = world.find("body/body[@name='object']")
    if body is None:
        raise LiberoError(f"{path}: no body named 'object' below the outer body; {REMEDY}")
    return attachable_xml(category, assets, body)


def attachable_xml(category: str, assets: Iterable[ET.Element], body: ET.Element) -> str:
    """Return the MJCF text of an object that scenes can attach.

    Args:
        category: Name of the category; it becomes the prefix of the assets' names.
        body: Body of the object; it is changed.

    Raises:
        LiberoError: A required file is missing.
    """
    body.attrib = {"name": ROOT_BODY}  # the scene sets its pose
    _keep(body, _BODY_TAGS)
    for joint in body.findall("joint"):
        body.remove(joint)
    for number, geom in enumerate(body.iter("geom")):
        geom.attrib.setdefault("name", f"g{number}")
        if geom.get("group") == "1":
            geom.set("mass", "0")
    for site in body.iter("site"):
        site.set("group", str(GLOW_GROUP if site.get("name") in GLOWING_SITES else _group(site)))
    hidden = {"size": "0.002", "rgba": "0 0 0 0", "group": str(HIDDEN_GROUP)}
    ET.SubElement(body, "site", {"name": "default_site", "pos": "0 0 0", **hidden})
    assets = used_assets(assets, body)
    for element in (*assets, *body.iter()):
        for key in ("name", *_ASSETS) if element.tag in _ASSETS else _ASSETS:
            if key in element.attrib:
                element.set(key, f"{category}_{element.attrib[key]}")
    return to_xml(category, assets, [body])


def read_spec(text: str, path: Path) -> mujoco.MjSpec:
    """Return what MuJoCo reads from an MJCF text that was made from a file.

    Raises:
        LiberoError: MuJoCo cannot read it.
    """
    try:
        return mujoco.MjSpec.from_string(text)
    except ValueError as error:
        raise LiberoError(f"{explain(error, path)}; {REMEDY}") from error


def used_assets(assets: Iterable[ET.Element], *parts: ET.Element) -> list[ET.Element]:
    """Return the assets that the given elements need, and no others: files of the others may be missing.

    Raises:
        LiberoError: A required file is missing.
    """
    needed = {(kind, element.get(kind)) for part in parts for element in part.iter() for kind in _ASSETS}
    needed |= {("texture", a.get("texture")) for a in assets if (a.tag, a.get("name")) in needed}
    used = [a for a in assets if (a.tag, a.get("name")) in needed or a.get("type") == "skybox"]
    for asset in used:
        if (file := asset.get("file")) and not Path(file).is_file():
            raise LiberoError(f"{file}: no such file; {REMEDY}")
    return used


def to_xml(name: str, assets: Iterable[ET.Element], bodies: Iterable[ET.Element]) -> str:
    """Return a complete MJCF text: angles in radians, mass from collision geoms only, open meshes allowed."""
    root = ET.Element("mujoco", {"model": name})
    ET.SubElement(root, "compiler", {"angle": "radian", "inertiagrouprange": "0 0", "autolimits": "true"})
    section = ET.SubElement(root, "asset")
    for asset in assets:
        asset = copy.copy(asset)
        if asset.tag == "mesh":
            # visual meshes have no mass: their volume need not be closed
            asset.attrib.setdefault("inertia", "shell")
        section.append(asset)
    ET.SubElement(root, "worldbody").extend(bodies)
    return ET.tostring(root, encoding="unicode")


def _keep(body: ET.Element, tags: Iterable[str]) -> None:
    for child in list(body):
        if child.tag not in tags:
            body.remove(child)
        elif child.tag == "body":
            _keep(child, tags)


def _group(site: ET.Element) -> int:
    rgba = site.get("rgba", "0.5 0.5 0.5 1").split()
    return int(site.get("group", "0")) if float(rgba[-1]) > 0 else HIDDEN_GROUP
