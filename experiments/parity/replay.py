"""Replay recordings of `record.py` and print how far this project strays from the original.

    python replay.py --assets FOLDER RECORDING.npz [...]

For each recording: the largest difference of the arm's and the fingers' joints [rad, m] before the robot touches
anything, in the whole recording, and in segments of half a second, each of which begins in a recorded state; that of
the other coordinates in segments; and the first control step at which joints differ by more than 1e-6. The robot is
that of the recording's robosuite.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.sim.scene import Scene

ROBOT_OF = {"1.4.0": "libero", "1.4.1": "robosuite-1.4.1"}
TOUCHES = ("self", "link7", "table", "objects")  # bits of `touches`, as in record.py
STRIDE = 10  # control steps between two moments of a file
TOLERANCE = 1e-6
NUM_ROBOT = 9  # joints of arm and fingers


@dataclass(frozen=True)
class Deviation:
    """Differences between a recording and its replay.

    Attributes:
        robot: Largest difference of the robot's joints after each control step, (T,), rad or m.
        robot_segments: The same where each segment begins in a recorded state, (T,).
        others: Largest difference of the other coordinates at the end of each segment but the last.
        touches: What the original's robot touched in each control step, (T,), bits of `TOUCHES`.
    """

    robot: np.ndarray
    robot_segments: np.ndarray
    others: np.ndarray
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
        touched = ", ".join(f"{n} {((self.touches >> i) & 1).sum()}" for i, n in enumerate(TOUCHES))
        free, within = self.free_steps, int((self.robot_segments < TOLERANCE).sum())
        return (
            f"free {self.robot[:free].max(initial=0.0):.0e} ({free} steps); whole {self.robot.max():.0e}, over 1e-6 "
            f"from {self.parted}; segments: {within}/{len(self.robot)} steps within 1e-6, median "
            f"{np.median(self.robot_segments):.0e}, at most {self.robot_segments.max():.0e}, other coordinates "
            f"{self.others.max(initial=0.0):.0e}; steps touching: {touched}"
        )


def replay(
    path: Path, assets: str | Path | None, robot: str | None = None, steps: int | None = None
) -> Deviation:
    """Execute the actions of a recording from its start, and from each recorded moment, and compare.

    Args:
        path: Recording.
        assets: The original's asset folder.
        robot: Model of the arm; by default that of the recording's robosuite.
        steps: Number of control steps; by default all.
    """
    with np.load(path, allow_pickle=False) as stored:
        recording = {key: stored[key] for key in stored.files}
    task = f"{recording['suite']}/{int(recording['task_id'])}"
    env = BatchEnv(task, 1, assets=assets, cameras=(), robot=robot or ROBOT_OF[str(recording["robosuite"])])
    actions, recorded = recording["actions"][:steps] / 64.0, recording["robot_qpos"][:steps]
    moments = _states(env.scene, recording)
    nq, simulations = env.scene.model.nq, env.simulations
    others = []

    def run(restart: bool) -> np.ndarray:
        off = []
        for t, action in enumerate(actions):
            if t == 0 or restart and t % STRIDE == 0:
                if t:
                    found = simulations.get_state(0)[1 : 1 + nq]
                    others.append(
                        np.abs(found - moments[t // STRIDE][1 : 1 + nq])[NUM_ROBOT:].max(initial=0.0)
                    )
                simulations.set_state(0, moments[t // STRIDE])
            simulations.step([0], action[None])
            off.append(np.abs(simulations.fields["qpos"][0][:NUM_ROBOT] - recorded[t]).max())
        return np.array(off)

    deviation = Deviation(run(False), run(True), np.array(others), recording["touches"][:steps])
    env.close()
    return deviation


def _states(scene: Scene, recording: dict[str, np.ndarray]) -> np.ndarray:
    """Return the recorded moments as states of this project's simulations, which also hold the fixtures' poses."""
    model, moments = scene.model, recording["moments"]
    stored = json.loads(str(recording["fixtures"]))
    fixtures = np.array([stored[name] for name in scene.fixtures]).ravel()
    before = 1 + model.nq + model.nv
    rows = np.tile(fixtures, (len(moments), 1))
    return np.concatenate([moments[:, :before], rows, moments[:, before:]], axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("recordings", type=Path, nargs="+")
    parser.add_argument("--assets", type=Path, required=True)
    parser.add_argument("--robot", help="libero or robosuite-1.4.1; by default the recording's")
    args = parser.parse_args()
    print(f"MuJoCo {mujoco.__version__}")
    free = whole = within = total = 0
    for path in args.recordings:
        found = replay(path, args.assets, args.robot)
        free += found.parted is None or found.parted >= found.free_steps
        whole += found.parted is None
        within, total = within + int((found.robot_segments < TOLERANCE).sum()), total + len(found.robot)
        print(f"{path.stem}: {found}", flush=True)
    number = len(args.recordings)
    print(
        f"within 1e-6 before the first touch: {free} of {number} recordings; to the end: {whole} of {number}; "
        f"in segments of half a second: {within} of {total} steps"
    )


if __name__ == "__main__":
    main()
