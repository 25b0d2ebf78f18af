"""Repeat recordings in the original itself, with its torques changed in their last digits, and print how far it strays.

Runs in an environment of the original; see README.md. It shows how much of the difference that `replay.py` prints after
contact is contact's own: another processor or another LAPACK changes the last digits of the torques likewise.

    python sensitivity.py [--change 1e-14] RECORDING.npz [...]
"""

import argparse
import json
from pathlib import Path

import numpy as np
from record import make_env, start_afresh


def deviations(path: Path, change: float) -> np.ndarray:
    """Return the largest difference of the robot's joints after each control step, (T,), rad or m."""
    with np.load(path, allow_pickle=False) as stored:
        recording = {key: stored[key] for key in stored.files}
    env = make_env(str(recording["suite"]), int(recording["task_id"]), seed=0)
    for name, pose in json.loads(str(recording["fixtures"])).items():
        body = env.sim.model.body_name2id(env.env.fixtures_dict[name].root_body)
        env.sim.model.body_pos[body], env.sim.model.body_quat[body] = pose[:3], pose[3:]
    model = env.sim.model
    start_afresh(env, recording["moments"][0][: 1 + model.nq + model.nv])
    controller, rng = env.env.robots[0].controller, np.random.default_rng(0)
    run = controller.run_controller
    controller.run_controller = lambda: run() * (1.0 + change * rng.uniform(-1.0, 1.0, 7))
    off = []
    for t, action in enumerate(recording["actions"] / 64.0):
        env.step(action)
        off.append(np.abs(np.array(env.sim.data.qpos[:9]) - recording["robot_qpos"][t]).max())
    env.close()
    return np.array(off)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument(
        "--change", type=float, default=1e-14, help="relative change of the torques; 0 for none"
    )
    args = parser.parse_args()
    for path in args.recordings:
        off = deviations(path, args.change)
        parted = int(np.argmax(off > 1e-6)) if (off > 1e-6).any() else None
        print(f"{path.stem}: at most {off.max():.0e}, over 1e-6 from {parted}", flush=True)


if __name__ == "__main__":
    main()
