"""The back end `warp` against `mujoco`: free motion, the truth of predicates, the expert's success.

    python experiments/warp/parity.py motion --out motion.jsonl
    python experiments/warp/parity.py truths --recordings RECORDINGS --out truths.jsonl
    python experiments/warp/parity.py expert --out expert.jsonl

Each line of a file is a task; what a file has is not done again, so that a killed command goes on.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.expert import Expert, Shapes
from libero_env.sim.backend import Backend
from libero_env.sim.engine import Goals, make_simulations
from libero_env.sim.scene import build_scene
from libero_env.sim.simulation import Simulations
from libero_env.sim.state import StateView
from libero_env.tasks import get_task
from libero_env.tasks.expression import And, Atom

MOTION = ["libero_spatial/0", "libero_object/3", "libero_object/7", "libero_goal/0", "libero_goal/5"]
MOTION += ["libero_10/3", "libero_10/9", "libero_90/1", "libero_90/20", "libero_90/60"]
EXPERT = ["libero_object/3", "libero_spatial/0", "libero_goal/5", "libero_90/1"]
STEPS, MAX_STEPS, BATCH = 50, 600, 50


def motion(task: str, warp: Backend) -> dict[str, object]:
    """Largest differences of positions [m, rad] over `STEPS` control steps in which the arm touches nothing."""
    env = BatchEnv(task, 2, cameras=(), observations=(), num_threads=1)
    seed, actions = next((seed, a) for seed in range(100) if (a := free_actions(env, seed)) is not None)
    ours = make_simulations(env.scene.model, 2, fixture_bodies=env.scene.fixture_bodies, backend=warp)
    theirs = env.simulations
    env.reset(options={"init_state": [0, 1]})
    ours.reset([0, 1], theirs.fields["qpos"], theirs.fields["qvel"], fixtures=theirs.fixtures)
    largest = {"arm": 0.0, "fingers": 0.0, "objects": 0.0, "grip_site": 0.0}
    for action in actions:
        for simulations in (ours, theirs):
            simulations.step([0, 1], action)
        apart = np.abs(ours.fields["qpos"] - theirs.fields["qpos"])
        site = np.abs(ours.fields["site_xpos"] - theirs.fields["site_xpos"])[:, theirs.arm.site]
        found = (apart[:, :7].max(), apart[:, 7:9].max(), apart[:, 9:].max(initial=0.0), site.max())
        largest = {k: max(value, float(new)) for (k, value), new in zip(largest.items(), found, strict=True)}
    return {"steps": STEPS, "seed": seed, **largest}


def free_actions(env: BatchEnv, seed: int) -> list[np.ndarray] | None:
    """Smooth motions of two simulations, upwards in the mean; None where the robot touches something."""
    rng, robot, found = np.random.default_rng(seed), env.scene.bodies["robot"], []
    env.reset(options={"init_state": [0, 1]})
    for step in range(STEPS):
        if step % 10 == 0:
            action = rng.uniform(-0.5, 0.5, (2, 7))
            action[:, 2], action[:, 6] = 0.3 * np.abs(action[:, 2]), np.sign(action[:, 6])
        env.simulations.step([0, 1], action)
        pairs = np.concatenate([env.simulations.contact_geoms(i) for i in (0, 1)])
        if (np.isin(env.scene.model.geom_bodyid[pairs], robot).sum(1) == 1).any():
            return None
        found.append(action)
    return found


def truths(path: Path, warp: Backend) -> dict[str, object]:
    """Number of truths that differ between the back ends in recorded states, and from the original's."""
    with np.load(path) as z:
        states, atoms, recorded = z["qpos"], json.loads(str(z["atoms"])), z["truth"].astype(bool)
        poses, task = json.loads(str(z["fixtures"])), f"{z['suite']}/{int(z['task_id'])}"
    scene = build_scene(get_task(task).problem)
    fixtures = np.array([poses[name] for name in scene.fixtures]).reshape(-1, 7)
    goals = [Atom(name.capitalize(), tuple(args)) for name, *args in atoms]
    told = {}
    for name, back_end in (("mujoco", Backend()), ("warp", warp)):
        simulations = make_simulations(scene.model, BATCH, 1, scene.fixture_bodies, back_end)
        views = [StateView(scene, simulations, i) for i in range(BATCH)]
        checker = Goals(And(tuple(goals)), goals, views, "original")
        rows = [
            _truths_of(simulations, checker.check, part, fixtures)
            for part in np.split(states, len(states) // BATCH)
        ]
        told[name] = np.concatenate(rows)
        if name == "warp":
            assert not checker.one_by_one, "every atom is evaluated in all simulations at once"
        simulations.close()
    differ = np.argwhere(told["warp"] != told["mujoco"])
    return {
        "task": task,
        "states": len(states),
        "atoms": len(atoms),
        "true": int(told["mujoco"].sum()),
        "differ": len(differ),
        "differ_in": sorted({" ".join(atoms[k]) for _, k in differ}),
        "mujoco_differs_from_original": int((told["mujoco"] != recorded).sum()),
        "warp_differs_from_original": int((told["warp"] != recorded).sum()),
    }


def _truths_of(
    simulations: Simulations, check: Callable, states: np.ndarray, fixtures: np.ndarray
) -> np.ndarray:
    ids = np.arange(len(states))
    simulations.reset(
        ids, states, np.zeros((len(ids), simulations.model.nv)), fixtures=np.stack([fixtures] * len(ids))
    )
    return check(ids)[1]


def expert(task: str, warp: Backend, starts: Sequence[int]) -> dict[str, object]:
    """Success of the expert from stored starts on both back ends."""
    found: dict[str, object] = {"starts": list(starts)}
    for name, back_end in (("mujoco", Backend()), ("warp", warp)):
        env = BatchEnv(task, len(starts), cameras=(), observations=(), num_threads=1, backend=back_end)
        env.reset(options={"init_state": list(starts)})
        shapes, begin = Shapes(env.scene), time.perf_counter()
        experts = [Expert(env.task, np.random.default_rng([0, start]), shapes=shapes) for start in starts]
        won, over, steps = np.zeros(len(starts), bool), np.zeros(len(starts), bool), 0
        while steps < MAX_STEPS and not over.all():
            ids, actions = np.flatnonzero(~over), np.zeros((len(starts), 7))
            for i in ids:
                actions[i] = experts[i].act(env.views[i])
            env.simulations.step(ids, actions)
            won[ids] = env.goals.check(ids)[0]
            over |= won | np.array([bool(one.failure_reason) for one in experts])
            steps += 1
        found[name] = won.tolist()
        found[f"{name}_seconds"] = round(time.perf_counter() - begin, 1)
        found[f"{name}_steps"] = steps
        env.close()
    return found


def resume(path: Path, keys: Sequence[str], measure: Callable[[str], dict[str, object]]) -> list[dict]:
    """Measure what a file of lines does not have, and return all of its lines."""
    done = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    for key in keys:
        if key not in [one["key"] for one in done]:
            done.append({"key": key, **measure(key)})
            print(json.dumps(done[-1]), flush=True)
            with path.open("a") as file:
                file.write(json.dumps(done[-1]) + "\n")
    return [one for one in done if one["key"] in keys]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("motion", "truths", "expert"))
    parser.add_argument(
        "--backend", default="warp", help="with settings, such as warp,device=cpu (default: warp)"
    )
    parser.add_argument("--out", type=Path, required=True, help="file of results, one line for each task")
    parser.add_argument("--tasks", nargs="+", help="(default: ten for motion, four for the expert)")
    parser.add_argument("--starts", type=int, default=25, help="of each task, for the expert (default: 25)")
    parser.add_argument("--recordings", type=Path, help="folder with the states recorded from the original")
    args = parser.parse_args()
    warp = Backend.read(args.backend)
    if args.what == "motion":
        found = resume(args.out, args.tasks or MOTION, lambda task: motion(task, warp))
        largest = {k: max(one[k] for one in found) for k in ("arm", "fingers", "objects", "grip_site")}
        print(f"{len(found)} tasks, {STEPS} control steps; largest differences:", largest)
    elif args.what == "truths":
        paths = {path.name: path for path in sorted(args.recordings.glob("*-predicates.npz"))}
        found = resume(args.out, list(paths), lambda name: truths(paths[name], warp))
        total = sum(one["states"] * one["atoms"] for one in found)
        states, differ = (sum(one[k] for one in found) for k in ("states", "differ"))
        print(f"{states} states, {total} truths: {differ} differ between warp and mujoco")
    else:
        found = resume(args.out, args.tasks or EXPERT, lambda task: expert(task, warp, range(args.starts)))
        won = {name: [w for one in found for w in one[name]] for name in ("mujoco", "warp")}
        same = sum(a == b for a, b in zip(won["mujoco"], won["warp"], strict=True))
        print(
            f"{len(won['warp'])} starts: mujoco {sum(won['mujoco'])}, warp {sum(won['warp'])}, same outcome {same}"
        )


if __name__ == "__main__":
    main()
