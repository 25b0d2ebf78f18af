"""Draws every workspace of the builtin pack, empty, from a camera of the benchmark.

MUJOCO_GL=egl python experiments/objects/arenas.py [--out docs/images/arenas.png] [--scene blue] [--camera galleryview]
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image

from libero_env.assets.arena import WORKSPACES, add_arena, add_mount, load_workspace
from libero_env.assets.robot import add_panda
from libero_env.sim.render import Renderer, RenderTarget


def main() -> None:
    """Reads the command line and writes the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images/arenas.png"))
    parser.add_argument("--size", type=int, default=256, help="pixels per workspace")
    parser.add_argument("--camera", default="agentview")
    parser.add_argument("--robot", action="store_true", help="with the arm, all joints at zero")
    for kind in ("floor", "wall", "scene"):
        parser.add_argument(f"--{kind}", default=None, help=f"name of a {kind} style")
    args = parser.parse_args()
    properties = {kind: name for kind in ("floor", "wall", "scene") if (name := getattr(args, kind))}
    tiles = [draw(name, properties, args.camera, args.size, args.robot) for name in WORKSPACES]
    rows = [np.concatenate(tiles[i : i + 3], axis=1) for i in range(0, len(tiles), 3)]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate(rows)).save(args.out, optimize=True)
    print(f"{', '.join(WORKSPACES)} drawn to {args.out}")


def draw(category: str, properties: dict[str, str], camera: str, size: int, robot: bool) -> np.ndarray:
    """One workspace, (size, size, 3) uint8."""
    spec, workspace = mujoco.MjSpec(), load_workspace(category)
    spec.compiler.degree = False
    spec.visual.global_.offwidth = spec.visual.global_.offheight = size
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.1] * 3, [0.4] * 3
    add_arena(spec, workspace, properties)
    add_mount(spec, workspace)
    if robot:
        add_panda(spec, workspace.robot_base_pos)
    model = spec.compile()
    data, frame = mujoco.MjData(model), np.empty((size, size, 3), np.uint8)
    mujoco.mj_forward(model, data)
    with Renderer(model, size, size) as renderer:
        renderer.render(data, [RenderTarget(renderer.camera_id(camera), frame)])
    return frame


if __name__ == "__main__":
    main()
