"""Are starts what the tasks say, and do they stay so? All 50 of each of the 130 tasks, ten idle control steps each.

python experiments/init_states/check.py                                        # the project's own states
python experiments/init_states/check.py --states DIR [--assets DIR] [--settling FILE]   # the original's
"""

import argparse
import json
from pathlib import Path

import numpy as np

from libero_env.assets.pack import Pack, select_pack
from libero_env.init_states.pickles import read_states
from libero_env.init_states.placement import start_errors
from libero_env.init_states.store import load_init_states
from libero_env.sim.engine import make_simulations
from libero_env.sim.predicates import evaluate
from libero_env.sim.scene import Scene, build_scene
from libero_env.sim.state import StateView
from libero_env.tasks import Task, get_suite

SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")
IDLE_STEPS = 10
STILL, FARTHER = 0.005, 0.02  # m: our own states; the original's, beyond what they move in the original


def main() -> None:
    """Reads the command line, prints a line for each task with a fault, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--states", type=Path, help="folder of the original's .pruned_init files")
    parser.add_argument("--assets", help="builtin, or the folder of the original's models")
    parser.add_argument("--settling", type=Path, help="how far things move in the original, JSON")
    parser.add_argument("--suites", nargs="*", default=SUITES)
    parser.add_argument("--threads", type=int, default=0)
    args = parser.parse_args()
    pack = select_pack(args.assets)
    allowed = json.loads(args.settling.read_text()) if args.settling else None
    tasks = [task for name in args.suites for task in get_suite(name).tasks]
    worst, faulty, states = 0.0, 0, 0
    for task in tasks:
        scene = build_scene(task.problem, pack)
        rows = original_rows(args.states, task) if args.states else load_init_states(task, scene)
        moved, faults = check(scene, rows, own=args.states is None, threads=args.threads)
        if args.states is None:
            faults += [f"{name} moves {d:.4f} m" for name, d in moved.items() if d > STILL]
        elif allowed is not None:
            drift = allowed[task.id]["drift_m"]
            faults += [
                f"{name} moves {d:.3f} m, {drift[name]:.3f} in the original"
                for name, d in moved.items()
                if d > drift[name] + FARTHER
            ]
        worst, states, faulty = max(worst, *moved.values()), states + len(rows), faulty + bool(faults)
        if faults:
            print(f"{task.id} {task.name}: {'; '.join(sorted(set(faults)))}", flush=True)
    print(
        f"{describe(args, pack)}: {len(tasks)} tasks, {states} states, {faulty} tasks with faults; "
        f"the farthest that anything moves in {IDLE_STEPS} idle steps: {1000 * worst:.2f} mm"
    )


def describe(args: argparse.Namespace, pack: Pack) -> str:
    """Which states, with which models."""
    models = "builtin" if pack.name == "builtin" else "original"
    return f"{'own' if args.states is None else 'original'} states, {models} pack"


def original_rows(folder: Path, task: Task) -> np.ndarray:
    """The original's states of a task, (50, 1 + nq + nv)."""
    return read_states(folder / task.suite / f"{task.name}.pruned_init")


def check(scene: Scene, rows: np.ndarray, *, own: bool, threads: int) -> tuple[dict[str, float], list[str]]:
    """How far each object moves at most, m, and what is wrong with the states before and after."""
    qpos, qvel, fixtures = scene.split_states(rows)
    ids = range(len(rows))
    simulations = make_simulations(scene.model, len(rows), threads, scene.fixture_bodies.tolist())
    simulations.reset(ids, qpos, qvel, fixtures=fixtures if fixtures.shape[1] else None)
    views = [StateView(scene, simulations, i) for i in ids]
    before = [{name: view.body_pos(name) for name in scene.objects} for view in views]
    faults = faults_of(views, own)
    for _ in range(IDLE_STEPS):
        simulations.step(ids, np.zeros((len(rows), 7)))
    faults += faults_of(views, own)
    moved = {
        name: max(
            float(np.linalg.norm(v.body_pos(name) - b[name])) for v, b in zip(views, before, strict=True)
        )
        for name in scene.objects
    }
    simulations.close()
    return moved, faults


def faults_of(views: list[StateView], own: bool) -> list[str]:
    """Own states must be as the init atoms say; of the original's only the goal is asked."""
    if own:
        return [fault for view in views for fault in start_errors(view)]
    return ["the goal holds already" for view in views if evaluate(view.scene.problem.goal, view)]


if __name__ == "__main__":
    main()
