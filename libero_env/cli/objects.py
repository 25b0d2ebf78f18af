"""`libero objects`: user-defined objects from files, stored where tasks find them."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add the command `libero objects`."""
    parser = subparsers.add_parser("objects", help="user-defined objects, from mesh and MJCF files")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _register_add(commands)
    listing = commands.add_parser(
        "list", help="list user-defined objects; with --all also those of the benchmark"
    )
    listing.add_argument("--all", action="store_true", help="also list those of the benchmark")
    listing.set_defaults(run=run_list)
    for name, run, text in (
        ("show", run_show, "print the properties of an object: size, mass, regions, grasp"),
        ("remove", run_remove, "remove user-defined objects"),
    ):
        command = commands.add_parser(name, help=text)
        command.add_argument("names", nargs="+", metavar="NAME")
        command.set_defaults(run=run)
    preview = commands.add_parser("preview", help="render an object from all sides")
    preview.add_argument("name", metavar="NAME")
    preview.add_argument("--out", type=arguments.path, help="the picture (default: NAME.png here)")
    preview.set_defaults(run=run_preview)


def _register_add(commands: Subparsers) -> None:
    add = commands.add_parser("add", help="convert an MJCF, OBJ, GLB, glTF, STL or PLY file into an object")
    add.add_argument("file", type=arguments.path)
    option, measure = add.add_argument, arguments.number(0, 1e6, open_ends=True)
    option("--name", help="name in task files (default: the file's name)")
    option("--size", type=measure, help="longest side, m (default: that of the file, whose unit is guessed)")
    option("--mass", type=measure, help="kg (default: by density)")
    option("--density", type=measure, help="kg/m^3 (default: 400)")
    option(
        "--up",
        choices=("z", "y"),
        help="axis of the file that points up (default: y for GLB and glTF, else z)",
    )
    option(
        "--collision",
        choices=("decompose", "hull", "boxes"),
        default="decompose",
        help="convex pieces, the convex hull, or boxes (default: decompose; without CoACD boxes)",
    )
    option(
        "--faces",
        type=arguments.whole(4, 1_000_000),
        default=3000,
        help="most triangles for display (default: 3000)",
    )
    option(
        "--container", action="store_true", help="objects can be put In it: adds the region contain_region"
    )
    option("--replace", action="store_true", help="replace a user-defined object of this name")
    option(
        "--out",
        type=arguments.path,
        help="folder (default: LIBERO_OBJECTS, else objects beside the configuration file)",
    )
    add.set_defaults(run=run_add)


def run_add(args: argparse.Namespace) -> None:
    """Add an object and print its properties and notes."""
    from libero_env.design.objects import add_object
    from libero_env.paths import objects_dir

    names = ("name", "size", "mass", "density", "up", "collision", "faces", "container", "replace", "out")
    added = add_object(args.file, **{name: getattr(args, name) for name in names})
    print(f"{added.name}: {added.folder}")
    print("\n".join(describe(added.properties)))
    for note in added.notes:
        print(f"note: {note}")
    if args.out and args.out.absolute() != objects_dir().absolute():
        print(f"tasks find it with LIBERO_OBJECTS={args.out}")


def describe(properties: Mapping[str, Any]) -> list[str]:
    """Return lines about an object, from its `object.yaml`."""
    size, grasp, collision = (
        properties.get("size", ()),
        properties.get("grasp") or {},
        properties.get("collision") or {},
    )
    lines = [f"  size      {' x '.join(f'{100 * side:.1f}' for side in size)} cm"] if size else []
    if "mass" in properties:
        lines.append(f"  mass      {1000 * properties['mass']:.0f} g")
    if collision:
        lines.append(f"  collision {collision['pieces']} shapes, by {collision['method']}")
    if grasp.get("width") is not None:
        lines.append(
            f"  grasp     {100 * grasp['width']:.1f} cm wide, {100 * grasp['height']:.1f} cm above the ground"
        )
    elif grasp:
        lines.append(f"  grasp     none: {grasp['reason']}")
    if "stands" in properties:
        lines.append(f"  stands    {'yes' if properties['stands'] else 'no, it falls over or slides'}")
    return lines


def run_list(args: argparse.Namespace) -> None:
    """Print a line for each object."""
    from libero_env.objects import folder, object_names
    from libero_env.paths import objects_dir

    own = folder.names()
    for name in object_names() if args.all else own:
        print(f"{name:28} {objects_dir() / name if name in own else ''}".rstrip())
    if not own and not args.all:
        print(f"no objects in {objects_dir()}; add one: libero objects add FILE")


def run_show(args: argparse.Namespace) -> None:
    """Print the properties and regions of objects."""
    from libero_env.objects import folder, get_object
    from libero_env.tasks.authoring import model_regions

    for name in args.names:
        item, directory = get_object(name), folder.find(name)
        print(f"{name}: {directory or 'builtin'}")
        height = item.top_offset[2] - item.bottom_offset[2]
        lines = (
            describe(folder.read_properties(directory))
            if directory
            else [f"  height    {100 * height:.1f} cm"]
        )
        print("\n".join([*lines, f"  radius    {100 * item.horizontal_radius:.1f} cm"]))
        print(f"  regions   {', '.join(model_regions(name)) or 'none'}")


def run_preview(args: argparse.Namespace) -> None:
    """Render an object and print the path of the picture."""
    from libero_env.design.objects.trial import draw_object
    from libero_env.design.preview import check_picture
    from libero_env.objects import get_object

    item, out = get_object(args.name), args.out or Path(f"{args.name}.png")
    check_picture(out)
    print(draw_object(item, out))


def run_remove(args: argparse.Namespace) -> None:
    """Remove objects; stop at the first that does not exist."""
    from libero_env.objects import folder

    for name in args.names:
        print(f"removed {folder.remove(name)}")
