"""Draws every object of the catalog at rest, in a labelled grid.

MUJOCO_GL=egl python experiments/objects/gallery.py [--out docs/images/objects.png] [--names milk ...]
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from libero_env.objects import ObjectModel, get_object, object_names

FLOOR_COLOR = (0.86, 0.84, 0.80, 1.0)


def main() -> None:
    """Reads the command line and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/objects.png"))
    parser.add_argument("--names", nargs="*", default=None, help="categories; all when left out")
    parser.add_argument("--size", type=int, default=200, help="pixels per object")
    parser.add_argument("--columns", type=int, default=4)
    parser.add_argument("--collision", action="store_true", help="show the collision boxes too")
    parser.add_argument(
        "--far", action="store_true", help="one picture from the benchmark's camera, 128 pixels"
    )
    args = parser.parse_args()
    names = args.names or object_names()
    if args.far:
        picture = from_agentview([get_object(name) for name in names])
        Image.fromarray(picture).resize((768, 768), Image.Resampling.NEAREST).save(args.out)
        return
    tiles = [portrait(get_object(name), size=args.size, collision=args.collision) for name in names]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    sheet(tiles, names, args.columns).save(args.out, optimize=True)
    print(f"{len(names)} objects drawn to {args.out}")


def portrait(model: ObjectModel, *, size: int, collision: bool = False) -> np.ndarray:
    """One object standing on a floor, seen from the front and above.

    Args:
        model: drawn in its rest orientation.
        size: width and height of the picture, pixels.
        collision: draw the collision boxes half transparent over the visual.

    Returns:
        Picture (size, size, 3) uint8.
    """
    low, high = _bounds(model)
    # Drawn at twice the size and shrunk: smooth edges whatever the renderer offers.
    scene = mujoco.MjSpec()
    scene.visual.global_.offwidth = scene.visual.global_.offheight = 2 * size
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = (0.4,) * 3, (0.35,) * 3
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    scene.worldbody.add_geom(type=plane, pos=(0, 0, low[2]), size=(4, 4, 0.1), rgba=FLOOR_COLOR)
    scene.worldbody.add_light(pos=(0.6, -0.5, 1.2), dir=(-0.45, 0.4, -0.8), diffuse=(0.5,) * 3)
    scene.attach(model.spec, prefix="object_", frame=scene.worldbody.add_frame(quat=model.rest_quat()))
    compiled = scene.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.5 * (low + high)
    camera.distance = 1.6 * np.linalg.norm(high - low)
    camera.azimuth, camera.elevation = 170.0, -28.0
    option = mujoco.MjvOption()
    boxes = compiled.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    compiled.geom_rgba[boxes, 3] = 0.4 * collision
    with mujoco.Renderer(compiled, 2 * size, 2 * size) as renderer:
        renderer.update_scene(data, camera, option)
        picture = renderer.render()
    return np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BOX))


def from_agentview(models: Sequence[ObjectModel], size: int = 128) -> np.ndarray:
    """All objects on the floor before the robot, as the camera `agentview` of the floor scenes sees them.

    Returns:
        Picture (size, size, 3) uint8.
    """
    scene = mujoco.MjSpec()
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = (0.1,) * 3, (0.4,) * 3
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(4, 4, 0.1), rgba=FLOOR_COLOR)
    scene.worldbody.add_light(pos=(1, 1, 4), dir=(0, -0.15, -1), diffuse=(0.8,) * 3, castshadow=False)
    scene.worldbody.add_camera(
        name="agentview", pos=(0.897, 0, 0.65), quat=(0.618, 0.343, 0.343, 0.618), fovy=45
    )
    columns = 4
    for index, model in enumerate(models):
        low, _ = _bounds(model)
        x, y = -0.25 + 0.16 * (index // columns), -0.27 + 0.18 * (index % columns)
        frame = scene.worldbody.add_frame(pos=(x, y, -low[2]), quat=model.rest_quat())
        scene.attach(model.spec, prefix=f"object_{index}_", frame=frame)
    compiled = scene.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    option = mujoco.MjvOption()
    option.geomgroup[0] = 1
    compiled.geom_rgba[compiled.geom_type == mujoco.mjtGeom.mjGEOM_BOX, 3] = 0.0
    with mujoco.Renderer(compiled, size, size) as renderer:
        renderer.update_scene(data, "agentview", option)
        return renderer.render()


def sheet(tiles: Sequence[np.ndarray], names: Sequence[str], columns: int) -> Image.Image:
    """Pictures (n, n, 3) in rows, each with its name below."""
    size, caption = len(tiles[0]), 22
    rows = -(-len(tiles) // columns)
    image = Image.new("RGB", (columns * size, rows * (size + caption)), (255, 255, 255))
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(14)
    for index, (tile, name) in enumerate(zip(tiles, names, strict=True)):
        x, y = size * (index % columns), (size + caption) * (index // columns)
        image.paste(Image.fromarray(tile), (x, y))
        draw.text((x + size / 2, y + size + caption / 2), name, (20, 20, 20), font, anchor="mm")
    return image


def _bounds(model: ObjectModel) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around the visual at rest, each (3,), metres."""
    compiled = model.spec.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    geom = next(i for i in range(compiled.ngeom) if compiled.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH)
    mesh = compiled.geom_dataid[geom]
    start = compiled.mesh_vertadr[mesh]
    vertices = compiled.mesh_vert[start : start + compiled.mesh_vertnum[mesh]]
    rest = np.empty(9)
    mujoco.mju_quat2Mat(rest, model.rest_quat())
    at_root = vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
    at_rest = at_root @ rest.reshape(3, 3).T
    return at_rest.min(axis=0), at_rest.max(axis=0)


if __name__ == "__main__":
    main()
