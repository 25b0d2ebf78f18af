"""What the environment costs, as ratios within one process: python experiments/benchmarks/env_speed.py

Every figure is the best of several repeats, because machines are shared; the control step is compared with bare
`mj_step` calls on the same model from the same moving state, in turn. Pin it to one core with `taskset -c 0` for the
physics; leave it two for the pictures.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable

import mujoco
import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.envs.env import LiberoEnv
from libero_env.timing import SUBSTEPS

TASK = "libero_object/0"


def best(function: Callable[[], object], repeats: int) -> float:
    """Seconds of the fastest call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def step_ratio(repeats: int) -> dict[str, float]:
    """A control step without cameras against 25 bare `mj_step` from the same state, alternating."""
    env = LiberoEnv(TASK, cameras=())
    env.reset(options={"init_state": 0})
    rng = np.random.default_rng(0)
    bare = mujoco.MjData(env.scene.model)
    ours, theirs = [], []
    for _ in range(repeats):
        action = rng.uniform(-1, 1, 7)
        data = env.simulations.data(0)
        bare.qpos[:], bare.qvel[:], bare.ctrl[:] = data.qpos, data.qvel, data.ctrl
        bare.qacc_warmstart[:] = data.qacc_warmstart
        mujoco.mj_forward(env.scene.model, bare)
        start = time.perf_counter()
        for _ in range(SUBSTEPS):
            mujoco.mj_step(env.scene.model, bare)
        middle = time.perf_counter()
        env.step(action)
        ours.append(time.perf_counter() - middle)
        theirs.append(middle - start)
    env.close()
    return {
        "control_step_ms": 1e3 * float(np.median(ours)),
        "bare_25_mj_step_ms": 1e3 * float(np.median(theirs)),
        "ratio_of_medians": float(np.median(ours) / np.median(theirs)),
        "median_of_ratios": float(np.median(np.array(ours) / np.array(theirs))),
    }


def camera_rate(size: int, repeats: int) -> dict[str, float]:
    """Steps per second with two cameras: the best run of 25 steps in motion, and the median."""
    env = LiberoEnv(TASK, camera_size=(size, size))
    env.reset(options={"init_state": 0})
    rng = np.random.default_rng(0)
    rates = []
    for _ in range(repeats):
        start = time.perf_counter()
        for _ in range(25):
            env.step(rng.uniform(-0.5, 0.5, 7))
        rates.append(25 / (time.perf_counter() - start))
    drawing = best(lambda: env.observer.render_cameras([0], env.observer.empty_images()), 5 * repeats)
    env.close()
    median = float(np.median(rates))
    return {"steps_per_s_best": max(rates), "steps_per_s_median": median, "draw_both_ms": 1e3 * drawing}


def batch_rate(num: int, repeats: int) -> float:
    """Control steps per second of all simulations together, without cameras."""
    env = BatchEnv(TASK, num, cameras=())
    env.reset(options={"init_state": np.arange(num)})
    rng = np.random.default_rng(0)
    seconds = best(lambda: env.step(rng.uniform(-1, 1, (num, 7))), repeats)
    env.close()
    return num / seconds


def reset_ms(repeats: int) -> float:
    """Reset to an initial state with both 128x128 pictures."""
    env = LiberoEnv(TASK)
    env.reset(options={"init_state": 0})
    seconds = best(lambda: env.reset(options={"init_state": 1}), repeats)
    env.close()
    return 1e3 * seconds


def build_seconds(repeats: int) -> dict[str, float]:
    """Building the environment in a fresh process: all of it after the imports, and the imports."""
    code = (
        "import time; a = time.perf_counter(); from libero_env.envs.env import LiberoEnv; b = time.perf_counter(); "
        f"env = LiberoEnv('{TASK}'); c = time.perf_counter(); env.reset(options={{'init_state': 0}}); "
        "print(b - a, c - b, time.perf_counter() - c)"
    )
    rows = [
        [
            float(x)
            for x in subprocess.run(
                [sys.executable, "-c", code], capture_output=True, check=True
            ).stdout.split()
        ]
        for _ in range(repeats)
    ]
    imports, build, first_reset = np.min(rows, axis=0)
    return {"import_s": imports, "build_s": build, "first_reset_s": first_reset}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--batch", type=int, default=16)
    args = parser.parse_args()
    figures = {
        "mujoco": mujoco.__version__,
        "step": step_ratio(args.repeats),
        "cameras_128": camera_rate(128, max(args.repeats // 25, 3)),
        "cameras_64": camera_rate(64, max(args.repeats // 25, 3)),
        f"batch_{args.batch}_steps_per_s": batch_rate(args.batch, 20),
        "reset_to_init_state_ms": reset_ms(20),
        "build": build_seconds(3),
    }
    print(json.dumps(figures, indent=1, default=lambda x: round(float(x), 4)))


if __name__ == "__main__":
    main()
