"""Draws the gallery: a picture of every object and of every task, and a labelled sheet.

MUJOCO_GL=egl python experiments/objects/gallery.py               everything, into docs/
MUJOCO_GL=egl python experiments/objects/gallery.py --objects     only the objects, with their sheet
MUJOCO_GL=egl python experiments/objects/gallery.py --tasks [--suite libero_goal ...]
MUJOCO_GL=egl python experiments/objects/gallery.py --names milk ketchup --out sheet.png [--collision | --far]
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from libero_env.envs.batch import BatchEnv
from libero_env.init_states.store import generate_init_states, shipped_path
from libero_env.objects import ObjectModel, get_object, object_names
from libero_env.tasks import Task, get_suite, suite_names

FLOOR_COLOR = (0.86, 0.84, 0.80, 1.0)
VISUAL_GROUP = 1
FRONT = 165.0  # degrees, where the camera looks
ELSEWHERE = {  # what opens, or is read, on another side
    "black_book": 215.0,
    "yellow_book": 215.0,
    "white_storage_box": 245.0,
    "wine_rack": 225.0,
    "wooden_shelf": 245.0,
    "wooden_two_layer_shelf": 245.0,
}


def main() -> None:
    """Reads the command line and draws."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the page and its pictures")
    parser.add_argument("--objects", action="store_true", help="objects and their sheet")
    parser.add_argument("--tasks", action="store_true", help="tasks")
    parser.add_argument("--suite", nargs="*", default=None, help="suites of the tasks; all when left out")
    parser.add_argument("--names", nargs="*", default=None, help="only a sheet of these categories")
    parser.add_argument(
        "--out", type=Path, default=None, help="the sheet; docs/images/objects.png by default"
    )
    parser.add_argument("--size", type=int, default=200, help="pixels per object")
    parser.add_argument("--columns", type=int, default=10, help="objects in a row of the sheet")
    parser.add_argument(
        "--collision", action="store_true", help="only a sheet, with what collides drawn over it"
    )
    parser.add_argument(
        "--far", action="store_true", help="only a sheet, from the benchmark's camera at 128 pixels"
    )
    args = parser.parse_args()
    names, out = args.names or object_names(), args.out or args.docs / "images" / "objects.png"
    everything = not (args.objects or args.tasks or args.suite)
    if args.far or args.names or args.collision:
        models = [get_object(name) for name in names]
        if args.far:
            tiles = [from_agentview(model).repeat(2, axis=0).repeat(2, axis=1) for model in models]
        else:
            tiles = [portrait(model, size=args.size, collision=args.collision) for model in models]
        save(sheet(tiles, names, args.columns), out)
    else:
        if everything or args.objects:
            draw_objects(args.docs, out, args.size, args.columns)
        if everything or args.tasks or args.suite:
            for suite in args.suite or suite_names():
                draw_tasks(args.docs, suite)


def draw_objects(docs: Path, out: Path, size: int, columns: int) -> None:
    """A picture of each category, and the sheet of all."""
    names, tiles = object_names(), []
    for name in names:
        tiles.append(portrait(get_object(name), size=size))
        save(Image.fromarray(tiles[-1]), docs / f"images/gallery/objects/{name}.jpg")
    save(sheet(tiles, names, columns), out)
    print(f"{len(names)} objects drawn")


def draw_tasks(docs: Path, suite: str) -> None:
    """A picture of each task's first initial state; a suite that consists of others has none of its own."""
    for task in get_suite(suite).tasks:
        if task.suite == suite:
            file = docs / f"images/gallery/tasks/{task.suite}-{task.index}.jpg"
            save(Image.fromarray(first_view(task)), file)
    print(f"{suite} drawn")


def first_view(task: Task, size: int = 256) -> np.ndarray:
    """The first initial state of a task as `agentview` sees it, (size, size, 3) uint8."""
    env = BatchEnv(task, 1, camera_size=(2 * size, 2 * size))  # and shrunk, as the portraits are
    try:
        if shipped_path(task.suite).exists():
            env.reset(options={"init_state": 0})
        else:  # the same state, without the other 49
            env.reset(options={"start": generate_init_states(task, env.scene, 1)})
        picture = env.observer.render(0, "agentview")
    finally:
        env.close()
    return shrunk(picture, size)


def portrait(model: ObjectModel, *, size: int, collision: bool = False) -> np.ndarray:
    """One object standing on a floor, seen from the front and above.

    Args:
        model: drawn in its rest orientation.
        size: width and height of the picture, pixels.
        collision: draw what collides half transparent over the visual.

    Returns:
        Picture (size, size, 3) uint8.
    """
    scene = studio(2 * size)  # drawn at twice the size and shrunk: smooth edges whatever the renderer offers
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = (0.4,) * 3, (0.35,) * 3
    scene.attach(model.spec, prefix="object_", frame=scene.worldbody.add_frame(quat=model.rest_quat()))
    compiled, data = posed(scene)
    low, high = bounds(compiled, data)
    scene.geom("floor").pos = (0, 0, low[2] - 1e-4)
    middle, extent = (low + high) / 2, float(np.linalg.norm(high - low))
    azimuth = ELSEWHERE.get(model.category, FRONT)
    behind = np.deg2rad(azimuth - 35)  # over the photographer's left shoulder
    towards = np.array([0.6 * np.cos(behind), 0.6 * np.sin(behind), -0.8])
    scene.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=middle - 3 * extent * towards,
        dir=towards,
        diffuse=(0.5,) * 3,
    )
    scene.stat.extent, scene.stat.center = extent, middle
    compiled, data = posed(scene)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance = middle, 1.45 * extent
    camera.azimuth, camera.elevation = azimuth, -28.0
    option = visual_option()
    option.geomgroup[0] = collision
    compiled.geom_rgba[(compiled.geom_group == 0) & (compiled.geom_bodyid > 0), 3] = 0.4
    with mujoco.Renderer(compiled, 2 * size, 2 * size) as renderer:
        renderer.update_scene(data, camera, option)
        picture = renderer.render()
    return shrunk(picture, size)


def from_agentview(model: ObjectModel, size: int = 128) -> np.ndarray:
    """One object on the floor before the robot, as the camera `agentview` of the floor scenes sees it.

    Returns:
        Picture (size, size, 3) uint8.
    """
    scene = studio(size)
    scene.visual.headlight.ambient, scene.visual.headlight.diffuse = (0.1,) * 3, (0.4,) * 3
    scene.worldbody.add_light(pos=(1, 1, 4), dir=(0, -0.15, -1), diffuse=(0.8,) * 3, castshadow=False)
    scene.worldbody.add_camera(
        name="agentview", pos=(0.897, 0, 0.65), quat=(0.618, 0.343, 0.343, 0.618), fovy=45
    )
    frame = scene.worldbody.add_frame(pos=(0, 0, -model.bottom_offset[2]), quat=model.rest_quat())
    scene.attach(model.spec, prefix="object_", frame=frame)
    compiled, data = posed(scene)
    with mujoco.Renderer(compiled, size, size) as renderer:
        renderer.update_scene(data, "agentview", visual_option())
        return renderer.render()


def sheet(tiles: Sequence[np.ndarray], names: Sequence[str], columns: int) -> Image.Image:
    """Pictures (n, n, 3) in rows, each with its name below."""
    size, caption = len(tiles[0]), 22
    columns = min(columns, len(tiles))
    rows = -(-len(tiles) // columns)
    image = Image.new("RGB", (columns * size, rows * (size + caption)), (255, 255, 255))
    draw, fonts = ImageDraw.Draw(image), [ImageFont.load_default(points) for points in range(14, 7, -1)]
    for index, (tile, name) in enumerate(zip(tiles, names, strict=True)):
        x, y = size * (index % columns), (size + caption) * (index // columns)
        image.paste(Image.fromarray(tile), (x, y))
        font = next((font for font in fonts if font.getlength(name) < size - 6), fonts[-1])
        draw.text((x + size / 2, y + size + caption / 2), name, (20, 20, 20), font, anchor="mm")
    return image


def studio(size: int) -> mujoco.MjSpec:
    """A floor and room for pictures of this many pixels."""
    scene = mujoco.MjSpec()
    scene.visual.global_.offwidth = scene.visual.global_.offheight = size
    scene.visual.quality.shadowsize, scene.visual.map.shadowclip = 4096, 3.0
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    scene.worldbody.add_geom(name="floor", type=plane, size=(0, 0, 0.1), rgba=FLOOR_COLOR, group=VISUAL_GROUP)
    return scene


def posed(scene: mujoco.MjSpec) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A model, and its joints at zero."""
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def visual_option() -> mujoco.MjvOption:
    """Only what is seen in the benchmark's pictures."""
    option = mujoco.MjvOption()
    option.geomgroup[:], option.sitegroup[:] = 0, 0
    option.geomgroup[VISUAL_GROUP] = 1
    return option


def bounds(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around everything that is seen of the object, each (3,), metres."""
    points = np.concatenate(list(_visual_points(model, data)))
    return points.min(axis=0), points.max(axis=0)


def _visual_points(model: mujoco.MjModel, data: mujoco.MjData) -> Iterator[np.ndarray]:
    for geom in np.flatnonzero((model.geom_group == VISUAL_GROUP) & (model.geom_bodyid > 0)):
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            start = model.mesh_vertadr[mesh := model.geom_dataid[geom]]
            local = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
        else:
            middle, half = np.split(model.geom_aabb[geom], 2)
            local = middle + half * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        yield local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]


def shrunk(picture: np.ndarray, size: int) -> np.ndarray:
    """A picture at half the size or less, without jagged edges."""
    return np.asarray(Image.fromarray(picture).resize((size, size), Image.Resampling.BOX))


def save(image: Image.Image, path: Path) -> None:
    """Small files: JPEG at quality 85, or whatever the name asks for, optimised."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, optimize=True, **({"quality": 85} if path.suffix == ".jpg" else {}))


if __name__ == "__main__":
    main()
