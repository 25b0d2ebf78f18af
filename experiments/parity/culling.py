"""Draw random states of many tasks with and without what cameras cannot show; no bit may differ.

    python experiments/parity/culling.py --states 5 --every 10

Draws `--states` random states of every `--every`-th of the 130 tasks, both drawings, both cameras, 128² and 256²:
pictures and depth. The arm, drawers and doors are anywhere in their range, objects anywhere around the table.
"""

import argparse
import sys

import mujoco
import numpy as np

from libero_env.assets.pack import select_pack
from libero_env.sim.render import Renderer, RenderTarget
from libero_env.sim.scene import Scene, build_scene
from libero_env.sim.scene_spec import DRAWINGS, FAITHFUL
from libero_env.tasks import Task, get_suite

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
CAMERAS = ("agentview", "robot0_eye_in_hand")


def random_qpos(model: mujoco.MjModel, rng: np.random.Generator) -> np.ndarray:
    """Return positions (nq,) anywhere in the range of the joints."""
    qpos = model.qpos0.copy()
    for joint, kind in enumerate(model.jnt_type):
        at = model.jnt_qposadr[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            qpos[at : at + 3] = rng.uniform([-0.6, -0.6, 0.0], [0.4, 0.6, 1.3])
            qpos[at + 3 : at + 7] = rng.normal(size=4)
        elif model.jnt_limited[joint]:
            qpos[at] = rng.uniform(*model.jnt_range[joint])
    return qpos


def differing(scene: Scene, size: int, states: np.ndarray) -> int:
    """Return how many pictures or depths differ."""
    count, data = 0, mujoco.MjData(scene.model)
    renderers = [
        Renderer(scene.model, size, size, faithful=scene.drawing == FAITHFUL, cull=cull)
        for cull in (False, True)
    ]
    for qpos in states:
        data.qpos[:] = qpos
        mujoco.mj_forward(scene.model, data)
        drawn = []
        for renderer in renderers:
            targets = [
                RenderTarget(
                    renderer.camera_id(camera),
                    np.empty((size, size, 3), np.uint8),
                    np.empty((size, size), np.float32),
                )
                for camera in CAMERAS
            ]
            renderer.render(data, targets)
            drawn.append([array for t in targets for array in (t.rgb, t.depth)])
        count += sum(not np.array_equal(a, b) for a, b in zip(*drawn, strict=True))
    for renderer in renderers:
        renderer.close()
    return count


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--states", type=int, default=5)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--assets", default="original")
    args = parser.parse_args()
    tasks: list[Task] = [task for suite in SUITES for task in get_suite(suite).tasks][:: args.every]
    rng, pack, total, bad = np.random.default_rng(0), select_pack(args.assets), 0, 0
    for task in tasks:
        for drawing in DRAWINGS:
            scene = build_scene(task.problem, pack, drawing=drawing)
            states = np.array([random_qpos(scene.model, rng) for _ in range(args.states)])
            wrong = sum(differing(scene, size, states) for size in (128, 256))
            total, bad = total + 2 * 2 * len(CAMERAS) * len(states), bad + wrong
            print(f"{task.id} {drawing}: {wrong} differ", flush=True)
    print(f"{total - bad} of {total} pictures and depths are equal")
    sys.exit(int(bad > 0))


if __name__ == "__main__":
    main()
