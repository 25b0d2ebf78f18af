"""Record depth, segmentation and a burner that is on, in the original's environments.

    LIBERO_CONFIG_PATH=CONFIGURATION python experiments/parity/record_pictures.py STATE.npz... --out FOLDER

Runs in the original's environment, see experiments/benchmarks/README.md. STATE.npz has `suite`, `task_id`, `state` and
`fixtures` (JSON: name -> position and quaternion wxyz). `tests/libero/data` has what this wrote for two of them.

Elements are named so that another model of the same scene has them too: `geom:BODY:K` is the k-th visual geom of
a body, `site:NAME` a site.
"""

import argparse
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")
import numpy as np

from libero.libero import benchmark, get_libero_path
from libero.libero.envs import OffScreenRenderEnv

CAMERAS = ("agentview", "robot0_eye_in_hand")
SIZE = 64
GEOM, SITE = 5, 6  # MuJoCo's mjOBJ_GEOM and mjOBJ_SITE


def element_names(model: Any) -> dict[tuple[int, int], str]:
    """Name the visual geoms and the sites of a model: (kind, index) -> name."""
    names, count = {}, Counter()
    for geom in range(model.ngeom):
        if model.geom_group[geom] == 1:
            body = model.body(model.geom_bodyid[geom]).name
            names[GEOM, geom] = f"geom:{body}:{count[body]}"
            count[body] += 1
    return names | {(SITE, site): f"site:{model.site(site).name}" for site in range(model.nsite)}


def numbers(picture: np.ndarray, names: dict[tuple[int, int], str], known: list[str]) -> np.ndarray:
    """Return the index in `known`, which grows, of the element of each pixel; -1 for the background."""
    out = np.full(picture.shape[:2], -1, np.int16)
    for kind, index in np.unique(picture.reshape(-1, 2), axis=0):
        name = names.get((int(kind), int(index)))
        if name is not None:
            if name not in known:
                known.append(name)
            out[(picture == (kind, index)).all(-1)] = known.index(name)
    return out


def record(path: Path) -> dict[str, Any]:
    """Return what the original shows of one state."""
    z = np.load(path)
    task = benchmark.get_benchmark_dict()[str(z["suite"])]().get_task(int(z["task_id"]))
    bddl = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
    env = OffScreenRenderEnv(bddl_file_name=bddl, camera_heights=SIZE, camera_widths=SIZE, camera_depths=True)
    env.seed(0)
    env.reset()
    sim, names = env.sim, element_names(env.sim.model._model)
    for name, pose in json.loads(str(z["fixtures"])).items():
        body = sim.model.body_name2id(env.env.fixtures_dict[name].root_body)
        sim.model.body_pos[body], sim.model.body_quat[body] = pose[:3], pose[3:]
    kept = {key: z[key] for key in ("suite", "task_id", "state", "fixtures", "mujoco")}
    obs, known = env.set_init_state(z["state"]), []
    for camera in CAMERAS:
        kept[f"{camera}_depth"] = obs[f"{camera}_depth"][..., 0]
        picture = sim.render(camera_name=camera, width=SIZE, height=SIZE, segmentation=True)
        kept[f"{camera}_segmentation"] = numbers(picture, names, known)
    knobs = [j for j in sim.model.joint_names if j and j.endswith("stove_1_button")]
    if knobs:
        kept["state_on"] = z["state"].copy()
        kept["state_on"][1 + sim.model.get_joint_qpos_addr(knobs[0])] = 1.0
        obs = env.set_init_state(kept["state_on"])
        kept |= {f"{camera}_on": obs[f"{camera}_image"] for camera in CAMERAS}
    env.close()
    return {**kept, "elements": np.array(known)}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("states", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    for path in args.states:
        np.savez_compressed(args.out / path.name, **record(path))
        print(args.out / path.name)


if __name__ == "__main__":
    main()
