"""Replay recordings of `record.py` and print how far this project strays from the original.

    python replay.py --assets FOLDER RECORDING.npz [...]

For each recording: the largest difference of the arm's and the fingers' joints before the robot touches anything and in
the whole recording [rad, m], of the objects' coordinates, and the first control step at which joints differ by more
than 1e-6. The robot is that of the recording's robosuite.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from libero_env.envs.world import World

ROBOT_OF = {"1.4.0": "libero", "1.4.1": "robosuite-1.4.1"}
TOUCHES = ("self", "link7", "table", "objects")  # bits of `touches`, as in record.py
STRIDE = 10  # control steps between two complete states of a file
TOLERANCE = 1e-6
NUM_ROBOT = 9  # joints of arm and fingers


@dataclass(frozen=True)
class Deviation:
    """Differences between a recording and its replay.

    Attributes:
        robot: Largest difference of the robot's joints after each control step, (T,), rad or m.
        objects: Largest difference of the other coordinates after every tenth control step, (T // 10,).
        touches: What the original's robot touched in each control step, (T,), bits of `TOUCHES`.
    """

    robot: np.ndarray
    objects: np.ndarray
    touches: np.ndarray

    @property
    def free_steps(self) -> int:
        """Control steps before the robot first touches something."""
        return int(np.argmax(self.touches > 0)) if self.touches.any() else len(self.touches)

    @property
    def parted(self) -> int | None:
        """First control step at which joints differ by more than the tolerance."""
        over = self.robot > TOLERANCE
        return int(np.argmax(over)) if over.any() else None

    def __str__(self) -> str:
        touched = " ".join(f"{n} {((self.touches >> i) & 1).sum()}" for i, n in enumerate(TOUCHES))
        free, steps = self.free_steps, len(self.robot)
        return (
            f"free {self.robot[:free].max(initial=0.0):.0e} ({free} steps), all {self.robot.max():.0e} ({steps}), "
            f"objects {self.objects.max():.0e}, over 1e-6 from {self.parted}; steps touching: {touched}"
        )


def replay(path: Path, assets: str | Path | None, robot: str | None = None) -> Deviation:
    """Execute the actions of a recording from its start and compare.

    Args:
        path: Recording.
        assets: The original's asset folder.
        robot: Model of the arm; by default that of the recording's robosuite.
    """
    with np.load(path, allow_pickle=False) as stored:
        recording = {key: stored[key] for key in stored.files}
    task = f"{recording['suite']}/{int(recording['task_id'])}"
    world = World(task, assets=assets, cameras=(), robot=robot or ROBOT_OF[str(recording["robosuite"])])
    model, start = world.scene.model, recording["start"]
    recorded = json.loads(str(recording["fixtures"]))
    fixtures = np.array([recorded[name] for name in world.scene.fixtures]).reshape(-1, 7)
    qpos, qvel = np.split(start[1:], [model.nq])
    world.simulations.reset([0], qpos[None], qvel[None], float(start[0]), fixtures[None])
    off, coordinates = [], []
    for t, action in enumerate(recording["actions"] / 64.0):
        world.step([0], action[None])
        qpos = world.simulations.fields["qpos"][0]
        off.append(np.abs(qpos[:NUM_ROBOT] - recording["robot_qpos"][t]).max())
        if (t + 1) % STRIDE == 0:
            other = np.abs(qpos - recording["qpos"][t // STRIDE])[NUM_ROBOT:]
            coordinates.append(other.max(initial=0.0))
    world.close()
    return Deviation(np.array(off), np.array(coordinates), recording["touches"])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--assets", type=Path, required=True)
    parser.add_argument("--robot", help="libero or robosuite-1.4.1; by default the recording's")
    args = parser.parse_args()
    print(f"MuJoCo {mujoco.__version__}")
    free = whole = 0
    for path in args.recordings:
        found = replay(path, args.assets, args.robot)
        free += found.parted is None or found.parted >= found.free_steps
        whole += found.parted is None
        print(f"{path.stem}: {found}", flush=True)
    number = len(args.recordings)
    print(
        f"within 1e-6 before the first touch: {free} of {number}; in the whole recording: {whole} of {number}"
    )


if __name__ == "__main__":
    main()
