"""What the environment costs, as ratios within one process: python experiments/benchmarks/env_speed.py

Every figure is the best of several repeats, because machines are shared; the control step is compared with bare
`mj_step` calls on the same model from the same moving state, in turn. Pin it to one core with `taskset -c 0` for the
physics; leave it two for the pictures. `--only facade` compares the original's names with native code, in processor
time and in turn, and, where TorchRL is installed, says what of its step is ours.
"""

import argparse
import importlib.util
import json
import os
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


def processor_ms(*functions: Callable[[], object], repeats: int) -> list[float]:
    """Processor time of the fastest call of each function, called in turn."""
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repeats):
        for function, found in zip(functions, times, strict=True):
            start = time.process_time()
            function()
            found.append(time.process_time() - start)
    return [1e3 * min(found) for found in times]


def facade_beside_native(task: str, size: int, rounds: int) -> dict[str, object]:
    """Processor time of the package `libero` and of `LiberoEnv`: step, resets; two pictures, builtin models."""
    from libero.libero import benchmark
    from libero.libero.envs import OffScreenRenderEnv

    suite, index = benchmark.get_benchmark(task.split("/")[0])(), int(task.split("/")[1])
    state, file = suite.get_task_init_states(index)[0], suite.get_task_bddl_file_path(index)
    facade = OffScreenRenderEnv(bddl_file_name=file, camera_heights=size, camera_widths=size)
    native = LiberoEnv(task, camera_size=(size, size))
    seeds = iter(range(10**6))
    ways: dict[str, tuple[Callable[[], object], Callable[[], object]]] = {
        "to_stored_state": (
            lambda: facade.set_init_state(state),
            lambda: native.reset(options={"init_state": 0}),
        ),
        "to_new_placement": (facade.reset, lambda: native.reset(seed=next(seeds))),
    }
    facade.seed(0), facade.reset(), native.reset(seed=next(seeds))
    found = {way: processor_ms(*both, repeats=rounds) for way, both in ways.items()}
    steps = []
    for _ in range(rounds):
        rng = np.random.default_rng(0)
        for start in ways["to_stored_state"]:
            start()
        actions = rng.uniform(-0.5, 0.5, (25, 7))
        pairs = [(lambda a=a: facade.step(a), lambda a=a: native.step(a)) for a in actions]
        steps.append([processor_ms(*pair, repeats=1) for pair in pairs])
    found["step"] = np.min(steps, axis=0).mean(axis=0).tolist()
    drawing = facade.env.drawing
    facade.close()
    native.close()
    table = {way: {"facade_ms": a, "native_ms": b, "ratio": a / b} for way, (a, b) in found.items()}
    return {"task": task, "size": size, "drawing": drawing, **table}


def torchrl_step(size: int, repeats: int) -> dict[str, float]:
    """Processor time of a step of TorchRL's own `LiberoEnv` with two pictures, and how much of it is ours."""
    from torchrl.envs import LiberoEnv as TorchRLEnv

    env = TorchRLEnv(
        *TASK.split("/"), camera_height=size, camera_width=size, wrist_camera="robot0_eye_in_hand"
    )
    inner, ours, whole, tensors = env._env, [], [], env.reset()
    step = inner.step

    def timed(action: object) -> object:
        start = time.process_time()
        result = step(action)
        ours.append(time.process_time() - start)
        return result

    inner.step = timed
    for _ in range(repeats):
        tensors["action"] = env.action_spec.rand()
        start = time.process_time()
        tensors = env.step(tensors)["next"]
        whole.append(time.process_time() - start)
    env.close()
    return {"step_ms": 1e3 * float(np.median(whole)), "ours_ms": 1e3 * float(np.median(ours))}


def facade(repeats: int) -> dict[str, object]:
    """The package `libero` beside native code."""
    os.environ["LIBERO_ASSETS"] = "builtin"  # it would use the original's models where they are installed
    rows = [
        facade_beside_native(task, size, max(repeats // 25, 3))
        for task in (TASK, "libero_goal/3")
        for size in (64, 128)
    ]
    installed = importlib.util.find_spec("torchrl") is not None
    return {"facade": rows, **({"torchrl": torchrl_step(64, repeats)} if installed else {})}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=200)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--only", choices=["facade"])
    args = parser.parse_args()
    figures = facade(args.repeats) if args.only else environment(args.repeats, args.batch)
    print(
        json.dumps({"mujoco": mujoco.__version__, **figures}, indent=1, default=lambda x: round(float(x), 4))
    )


def environment(repeats: int, batch: int) -> dict[str, object]:
    """What native environments cost."""
    return {
        "step": step_ratio(repeats),
        "cameras_128": camera_rate(128, max(repeats // 25, 3)),
        "cameras_64": camera_rate(64, max(repeats // 25, 3)),
        f"batch_{batch}_steps_per_s": batch_rate(batch, 20),
        "reset_to_init_state_ms": reset_ms(20),
        "build": build_seconds(3),
    }


if __name__ == "__main__":
    main()
