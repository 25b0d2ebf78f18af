"""Throughput of the back end `warp` against the number of simulations, what a step consists of, and memory.

    python experiments/benchmarks/gpu.py                                    # 1 to 4,096 simulations on the first GPU
    python experiments/benchmarks/gpu.py --backend warp,device=cpu --worlds 1 4 16 --steps 3 --size 64

For each number of simulations, without pictures and with those of two cameras: control steps per second of all
together, the time of each part of a step, memory, and the part that takes most. Then the fixed cost of a step and that
of a further simulation, from a straight line through the times. Each size is measured by a process of its own. Times
are of the wall clock on a GPU, and CPU time on the processor, where one thread does all of it.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.sim.backend import Backend

WORLDS = (1, 4, 16, 64, 256, 512, 1024, 2048, 4096)


@dataclass(frozen=True)
class Measurement:
    """Median times [s] of the parts of a step of so many simulations, and memory [bytes]."""

    worlds: int
    pictures: bool
    physics: float
    goals: float
    observing: float
    drawing: float
    whole: float
    reset: float
    first: float
    device: str
    device_bytes: int
    host_bytes: int

    @property
    def limit(self) -> str:
        parts = {k: getattr(self, k) for k in ("physics", "goals", "observing", "drawing")}
        parts["all else"] = self.whole - sum(parts.values())
        name = max(parts, key=parts.__getitem__)
        return f"{name} {100 * parts[name] / self.whole:.0f} %"


def timed(function: Callable[[], object], repeats: int, clock: Callable[[], float]) -> float:
    times = []
    for _ in range(repeats):
        begin = clock()
        function()
        times.append(clock() - begin)
    return float(np.median(times))


def measure(args: argparse.Namespace, worlds: int, pictures: bool) -> Measurement:
    import warp as wp

    cameras = ("agentview", "robot0_eye_in_hand") if pictures else ()
    env = BatchEnv(
        args.task,
        worlds,
        backend=args.backend,
        cameras=cameras,
        camera_size=(args.size, args.size),
        horizon=10**6,
    )
    simulations: Any = env.simulations  # those of the back end
    device, ids = simulations.device, np.arange(worlds)
    starts = {"init_state": ids % 50}
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (worlds, 7))
    # of the processor one thread works, beside others
    clock = time.perf_counter if device.is_cuda else time.process_time
    begin = clock()
    env.reset(options=starts)
    env.step(actions)  # compiles, and captures the graph
    first, free = clock() - begin, device.free_memory if device.is_cuda else 0

    def physics() -> None:
        simulations.step(ids, actions)
        wp.synchronize_device(device)

    def observe() -> None:
        simulations.fields.clear()  # copies on the host, which a step makes again
        env.proprioception()

    images = env.observer.empty_images()
    return Measurement(
        worlds=worlds,
        pictures=pictures,
        physics=timed(physics, args.steps, clock),
        goals=timed(lambda: env.goals.check(ids), args.steps, clock),
        observing=timed(observe, args.steps, clock),
        drawing=timed(lambda: env.observer.render_cameras(ids, images), args.steps, clock)
        if pictures
        else 0.0,
        whole=timed(lambda: env.step(actions), args.steps, clock),
        reset=timed(lambda: env.reset(options=starts), 1, clock),
        first=first,
        device=f"{device.name} ({device.alias})",
        device_bytes=device.total_memory - free if device.is_cuda else 0,
        host_bytes=1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
    )


def show(found: list[Measurement]) -> None:
    print(f"device: {found[0].device}; host: {os.cpu_count()} cores")
    print(
        "| simulations | pictures | steps/s | step | physics | goals | observing | drawing | reset | memory | limit |"
    )
    print("|---:|---|---:|---:|---:|---:|---:|---:|---:|---:|---|")
    for m in found:
        times = (m.whole, m.physics, m.goals, m.observing, m.drawing, m.reset)
        memory = (m.device_bytes or m.host_bytes) / 1e9
        print(
            f"| {m.worlds} | {'two' if m.pictures else 'none'} | {m.worlds / m.whole:.1f} | "
            + " | ".join(f"{1e3 * t:.1f} ms" for t in times)
            + f" | {memory:.2f} GB | {m.limit} |"
        )
    for pictures in (False, True):
        rows = [m for m in found if m.pictures == pictures]
        if len(rows) > 1:
            slope, fixed = np.polyfit([m.worlds for m in rows], [m.whole for m in rows], 1)
            print(
                f"{'with' if pictures else 'without'} pictures a step costs {1e3 * fixed:.1f} ms and "
                f"{1e3 * slope:.3f} ms for each simulation"
            )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="libero_object/0")
    parser.add_argument("--backend", default="warp", help="with settings, such as warp,device=cuda:1")
    parser.add_argument("--worlds", type=int, nargs="+", default=WORLDS)
    parser.add_argument("--steps", type=int, default=20, help="repetitions, of which the median counts")
    parser.add_argument("--size", type=int, default=128, help="edge of a picture, pixels")
    parser.add_argument("--one", nargs=2, type=int, metavar=("WORLDS", "PICTURES"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    backend = Backend.read(args.backend)
    backend.require_installed()
    if not backend.device:
        import warp

        if not warp.get_cuda_device_count():
            sys.exit("error: there is no GPU; --backend warp,device=cpu measures the processor, for hours")
    if args.one:
        print(json.dumps(asdict(measure(args, args.one[0], bool(args.one[1])))))
        return
    found = []
    for pictures in (0, 1):
        for worlds in args.worlds:
            command = [sys.executable, __file__, *sys.argv[1:], "--one", str(worlds), str(pictures)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:  # such as memory that does not suffice: larger ones are not tried
                print(f"{worlds} simulations: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
                break
            found.append(Measurement(**json.loads(done.stdout.splitlines()[-1])))
            print(found[-1], file=sys.stderr, flush=True)
    if not found:
        sys.exit("error: nothing was measured")
    show(found)


if __name__ == "__main__":
    main()
