"""Cost of an observation with two cameras: fast, faithful, faithful with nothing left out, and the original's.

    python experiments/benchmarks/drawing.py --original ~/original/bin/python --config ~/original-config

README.md says how to make the original's environment; without `--original` its row is left out. The models are the
original's (`--assets`; by default those that are installed). All rows draw the same state of a task from `agentview`
and `robot0_eye_in_hand`, in turn; each counts with its fastest round. Run it on an idle machine; on a busy one, the
CPU time of all threads is a better measure where pictures are drawn in software.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")
CAMERAS, SIZES = ("agentview", "robot0_eye_in_hand"), (128, 256)


def fastest(calls: dict[str, Callable[[], Any]], rounds: int) -> dict[str, list[float]]:
    """Return the shortest elapsed time and the shortest CPU time of each call, ms; the calls take turns."""
    times = {name: [float("inf")] * 2 for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            begin = time.perf_counter(), time.process_time()
            call()
            spent = time.perf_counter() - begin[0], time.process_time() - begin[1]
            times[name] = [min(t, 1e3 * s) for t, s in zip(times[name], spent, strict=True)]
    return times


def ours(args: argparse.Namespace, size: int) -> dict[str, list[float]]:
    """Return the times of this package, ms, with images of size x size pixels."""
    import mujoco
    import numpy as np

    from libero_env.assets.pack import select_pack
    from libero_env.sim.render import Renderer, RenderTarget
    from libero_env.sim.scene import build_scene, initial_qpos
    from libero_env.tasks import get_task

    calls, renderers = {}, []
    for name, drawing, cull in (
        ("fast", "fast", True),
        ("faithful", "faithful", True),
        ("faithful, nothing left out", "faithful", False),
    ):
        scene = build_scene(get_task(args.task).problem, select_pack(args.assets), drawing=drawing)
        data = mujoco.MjData(scene.model)
        data.qpos[:] = initial_qpos(scene) if args.state is None else args.state[1 : 1 + scene.model.nq]
        mujoco.mj_forward(scene.model, data)
        renderer = Renderer(scene.model, size, size, faithful=drawing == "faithful", cull=cull)
        targets = [
            RenderTarget(renderer.camera_id(camera), np.empty((size, size, 3), np.uint8))
            for camera in CAMERAS
        ]
        renderers.append(renderer)
        calls[name] = lambda renderer=renderer, data=data, targets=targets: renderer.render(data, targets)
        calls[name]()
    times = fastest(calls, args.rounds)
    for renderer in renderers:
        renderer.close()
    return times


def of_the_original(args: argparse.Namespace) -> dict[str, list[float]]:
    """Return the original's times by image size, ms; this process is its environment's."""
    from libero.libero import benchmark, get_libero_path
    from libero.libero.envs import OffScreenRenderEnv

    suite, index = args.task.split("/")
    task = benchmark.get_benchmark_dict()[suite]().get_task(int(index))
    file = os.path.join(get_libero_path("bddl_files"), task.problem_folder, task.bddl_file)
    times = {}
    for size in SIZES:
        env = OffScreenRenderEnv(bddl_file_name=file, camera_heights=size, camera_widths=size)
        env.seed(0)
        env.reset()
        if args.state is not None:
            env.set_init_state(args.state)

        def draw(env: Any = env, size: int = size) -> None:
            for camera in CAMERAS:
                env.sim.render(camera_name=camera, width=size, height=size)

        draw()
        times[str(size)] = fastest({"original": draw}, args.rounds)["original"]
        env.close()
    return times


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="libero_goal/0")
    parser.add_argument(
        "--state", type=Path, help="npz with `state`: [time, qpos, qvel]; default: the arm at rest"
    )
    parser.add_argument("--assets", default="original")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--original", help="interpreter of the original's environment")
    parser.add_argument("--config", help="its LIBERO_CONFIG_PATH")
    parser.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    path = args.state
    if path is not None:
        import numpy as np

        args.state = np.load(path)["state"]
    if args.inside:
        print("TIMES " + json.dumps(of_the_original(args)))
        return
    rows = {size: ours(args, size) for size in SIZES}
    if args.original:
        command = [args.original, str(Path(__file__).resolve()), "--inside", "--task", args.task]
        command += ["--rounds", str(args.rounds), *(["--state", str(path.resolve())] if path else [])]
        variables = {**os.environ, "LIBERO_CONFIG_PATH": args.config}
        done = subprocess.run(command, env=variables, capture_output=True, text=True, cwd="/")
        line = next((text for text in done.stdout.splitlines() if text.startswith("TIMES ")), None)
        if line is None:
            sys.exit(done.stderr[-2000:])
        for size, value in json.loads(line.removeprefix("TIMES ")).items():
            rows[int(size)]["the original"] = value
    print(f"| two cameras, {args.task} | {' | '.join(f'{size}², ms | CPU' for size in SIZES)} |")
    print("|---|" + "---:|---:|" * len(SIZES))
    for name in rows[SIZES[0]]:
        print(f"| {name} | {' | '.join(f'{t:.0f}' for size in SIZES for t in rows[size][name])} |")


if __name__ == "__main__":
    main()
