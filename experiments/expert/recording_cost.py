"""Measure where the processor time of recording goes, by phase, in one process.

OMP_NUM_THREADS=1 python experiments/expert/recording_cost.py [--task libero_object/0] [--n 20] [--size 64]

A phase is a function; the time of another phase that it calls is not counted in it. Machine code is compiled before.
"""

import argparse
import functools
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import mujoco.batch

from libero_env.demos import observe, record, write
from libero_env.demos.config import DemoConfig
from libero_env.demos.generate import RecordingJob, make_demos
from libero_env.envs import batch
from libero_env.expert import expert
from libero_env.init_states import placement
from libero_env.sim import culling, render

PHASES: list[tuple[Any, str, str]] = [
    (record.DemoRecorder, "_place", "starts: sampled and settled"),
    (placement, "settle", "starts: sampled and settled"),
    (record, "run_experts", "attempts: control and the rest"),
    (expert.Expert, "act", "attempts: expert"),
    (batch.BatchEnv, "_check_goals", "attempts: goals"),
    (mujoco.batch.Batch, "step", "attempts: physics"),
    (observe.StateRenderer, "render_states", "pictures: states and the rest"),
    (culling.Culling, "apply", "pictures: culling"),
    (render.Renderer, "_open", "opening, compiling scenes"),
    (render.mujoco, "mjr_render", "pictures: OpenGL"),
    (render.mujoco, "mjr_readPixels", "pictures: OpenGL"),
    (observe.StateRenderer, "model_xml", "files: the scene as MJCF"),
    (write.DemoWriter, "_write_observations", "files: compression"),
    (write.DemoWriter, "write", "files: the rest"),
    (write.DemoWriter, "finish", "files: the rest"),
]
TIMES: dict[str, float] = defaultdict(float)
_open: list[list[Any]] = []  # phases that are running: name, and when they were looked at last


def timed(owner: Any, name: str, phase: str) -> None:
    """Replace a function by one that adds its processor time to a phase."""
    function = getattr(owner, name)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        now = time.process_time()
        if _open:
            TIMES[_open[-1][0]] += now - _open[-1][1]
        _open.append([phase, now])
        try:
            return function(*args, **kwargs)
        finally:
            now = time.process_time()
            TIMES[phase] += now - _open.pop()[1]
            if _open:
                _open[-1][1] = now

    setattr(owner, name, call)


def recorded(task: str, n: int, size: int) -> float:
    """Return the processor time of recording n demonstrations of a task, [s]."""
    config = DemoConfig(task, (size, size))
    with tempfile.TemporaryDirectory() as folder:
        job = RecordingJob(config, Path(folder) / "demo.hdf5")
        started = time.process_time()
        make_demos([job], n, workers=1, progress=False)
        return time.process_time() - started


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="libero_object/0")
    parser.add_argument("--n", type=int, default=20)
    parser.add_argument("--size", type=int, default=64)
    args = parser.parse_args()
    recorded(args.task, 1, args.size)
    for phase in PHASES:
        timed(*phase)
    total = recorded(args.task, args.n, args.size)
    TIMES["opening, compiling scenes"] += total - sum(TIMES.values())
    for phase in sorted(TIMES):
        print(f"| {phase} | {1000 * TIMES[phase] / args.n:.1f} |")
    print(f"| all | {1000 * total / args.n:.1f} |")


if __name__ == "__main__":
    main()
