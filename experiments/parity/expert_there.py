"""Execute the episodes of `expert_here.py` in the original, and print how many succeed there.

Runs in an environment of the original (hf-libero, robosuite 1.4.0), or through this project's facade; see README.md.

    python expert_there.py FOLDER [--out results.json]

An episode starts from the same state, with the fixtures where they were. Its actions end with success here: where the
original is not there yet, it holds still for up to a second more, which is counted apart. Episodes whose result is in
the file are not run again.
"""

import argparse
import json
from pathlib import Path

import mujoco
import numpy as np
from record import make_env, robosuite_version, start_afresh

HOLD_STEPS = 20  # after the last action, in which what was let go may still fall into place


def execute(env, episode: dict[str, np.ndarray]) -> dict[str, object]:
    """Return the outcome of an episode's actions in the original."""
    model = env.sim.model
    for name, pose in zip(episode["fixture_names"], episode["fixtures"], strict=True):
        body = model.body_name2id(env.env.fixtures_dict[str(name)].root_body)
        model.body_pos[body], model.body_quat[body] = pose[:3], pose[3:]
    start_afresh(env, episode["start"])
    reached, steps = None, len(episode["actions"])
    for t, action in enumerate(episode["actions"]):
        if env.step(action)[2] and reached is None:
            reached = t + 1
    nq, end = model.nq, np.array(env.sim.get_state().flatten())
    hold = np.append(np.zeros(6), episode["actions"][-1, 6])
    while reached is None and steps < len(episode["actions"]) + HOLD_STEPS:
        steps += 1
        if env.step(hold)[2]:
            reached = steps
    off = np.abs(end - episode["end"])[1 : 1 + nq]
    return {
        "steps_here": len(episode["actions"]),
        "steps_there": reached,
        "robot_difference": float(off[:9].max()),
        "object_difference": float(off[9:].max(initial=0.0)),
        "mujoco_here": str(episode["mujoco"]),
        "mujoco_there": mujoco.__version__,
        "robosuite_there": robosuite_version(),
        "robot": str(episode["robot"]),
    }


def table(results: dict[str, dict]) -> str:
    """Return a Markdown table of the outcomes, one row for each suite."""
    lines = [
        "| suite | episodes | succeed there | at the same step | up to 20 steps later, holding still |",
        "|---|---|---|---|---|",
    ]
    suites = sorted({name.rsplit("-", 2)[0] for name in results})
    for suite in [*suites, ""]:
        rows = [r for name, r in results.items() if name.startswith(suite)]
        late = [r["steps_there"] - r["steps_here"] for r in rows if r["steps_there"] is not None]
        counts = (len(rows), sum(n <= 0 for n in late), sum(n == 0 for n in late), sum(n > 0 for n in late))
        lines.append(f"| {suite or 'all'} | " + " | ".join(map(str, counts)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results.json"))
    args = parser.parse_args()
    results = json.loads(args.out.read_text()) if args.out.exists() else {}
    made, env = None, None
    for path in sorted(args.folder.glob("*.npz")):
        with np.load(path) as stored:
            episode = {key: stored[key] for key in stored.files}
        if not episode["success"] or path.stem in results:
            continue
        task = (str(episode["suite"]), int(episode["task_id"]))
        if task != made:
            if env is not None:
                env.close()
            made, env = task, make_env(*task, seed=0)
        results[path.stem] = execute(env, episode)
        print(path.stem, results[path.stem], flush=True)
        args.out.write_text(json.dumps(results, indent=1))
    print(table(results))


if __name__ == "__main__":
    main()
