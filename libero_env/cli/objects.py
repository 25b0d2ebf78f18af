"""`libero objects`: user-defined objects from files, stored where tasks find them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from libero_env.cli.options import Field, FilePath, Positional

Names = Positional[Annotated[tuple[str, ...], Field(min_length=1)]]
Measure = Annotated[float, Field(gt=0, lt=1e6)]


def add(
    file: Positional[FilePath],
    *,
    name: str | None = None,
    size: Measure | None = None,
    mass: Measure | None = None,
    density: Measure | None = None,
    up: Literal["z", "y"] | None = None,
    collision: Literal["decompose", "hull", "boxes"] = "decompose",
    faces: Annotated[int, Field(ge=4, le=1_000_000)] = 3000,
    container: bool = False,
    replace: bool = False,
    out: FilePath | None = None,
) -> None:
    """Convert an MJCF, OBJ, GLB, glTF, STL or PLY file into an object, and print its properties and notes.

    Args:
        file: The file.
        name: Name in task files (default: the file's name).
        size: Longest side, m (default: that of the file, whose unit is guessed).
        mass: In kg (default: by density).
        density: In kg/m^3 (default: 400).
        up: Axis of the file that points up (default: y for GLB and glTF, else z).
        collision: Convex pieces, the convex hull, or boxes; without CoACD decompose gives boxes.
        faces: Most triangles for display.
        container: Objects can be put In it: adds the region contain_region.
        replace: Replace a user-defined object of this name.
        out: Folder (default: LIBERO_OBJECTS, else objects beside the configuration file).
    """
    from libero_env.design.objects import add_object
    from libero_env.paths import objects_dir

    added = add_object(
        file,
        name=name,
        size=size,
        mass=mass,
        density=density,
        up=up,
        collision=collision,
        faces=faces,
        container=container,
        replace=replace,
        out=out,
    )
    print(f"{added.name}: {added.folder}")
    print("\n".join(describe(added.properties)))
    for note in added.notes:
        print(f"note: {note}")
    if out and out.absolute() != objects_dir().absolute():
        print(f"tasks find it with LIBERO_OBJECTS={out}")


def describe(properties: Mapping[str, Any]) -> list[str]:
    """Return lines about an object, from its `object.yaml`."""
    size, grasp = properties.get("size", ()), properties.get("grasp") or {}
    lines = [f"  size      {' x '.join(f'{100 * side:.1f}' for side in size)} cm"] if size else []
    if "mass" in properties:
        lines.append(f"  mass      {1000 * properties['mass']:.0f} g")
    if collision := properties.get("collision"):
        lines.append(f"  collision {collision['pieces']} shapes, by {collision['method']}")
    if grasp.get("width") is not None:
        width, height = 100 * grasp["width"], 100 * grasp["height"]
        lines.append(f"  grasp     {width:.1f} cm wide, {height:.1f} cm above the ground")
    elif grasp:
        lines.append(f"  grasp     none: {grasp['reason']}")
    if "stands" in properties:
        lines.append(f"  stands    {'yes' if properties['stands'] else 'no, it falls over or slides'}")
    return lines


def list_objects(*, all: bool = False) -> None:
    """List user-defined objects.

    Args:
        all: Also list those of the benchmark.
    """
    from libero_env.assets.pack import select_pack
    from libero_env.objects import folder
    from libero_env.paths import objects_dir

    own = folder.names()
    for name in select_pack().categories() if all else own:
        print(f"{name:28} {objects_dir() / name if name in own else ''}".rstrip())
    if not own and not all:
        print(f"no objects in {objects_dir()}; add one: libero objects add FILE")


def show(names: Names) -> None:
    """Print the properties of objects as they rest: size, mass, grasp, the joint range of each state, regions.

    Args:
        names: Names of objects.
    """
    from libero_env.assets.pack import select_pack
    from libero_env.design.objects.trial import try_object
    from libero_env.objects import folder
    from libero_env.tasks.merging import model_regions

    pack = select_pack()
    for name in names:
        item, directory = pack.build(name), folder.find(name)
        stored = folder.read_properties(directory) if directory else {}
        lines = describe({**stored, **try_object(item, lambda _: None)})
        print("\n".join([f"{name}: {directory or pack.name}", *lines]))
        print(f"  placement keeps {100 * item.horizontal_radius:.1f} cm around its origin free")
        for state, (low, high) in item.articulation.items():
            print(f"  {state:9} from {low:g} to {high:g}, rad or m")
        print(f"  regions   {', '.join(model_regions(name)) or 'none'}")


def preview(name: Positional[str], *, out: FilePath | None = None) -> None:
    """Render an object from all sides, and print the path of the picture.

    Args:
        name: Name of an object.
        out: The picture (default: NAME.png here).
    """
    from libero_env.assets.pack import select_pack
    from libero_env.design.objects.trial import draw_object
    from libero_env.design.preview import check_picture

    item, path = select_pack().build(name), out or Path(f"{name}.png")
    check_picture(path)
    print(draw_object(item, path))


def remove(names: Names) -> None:
    """Remove user-defined objects; stop at the first that does not exist.

    Args:
        names: Names of objects.
    """
    from libero_env.objects import folder

    for name in names:
        print(f"removed {folder.remove(name)}")
