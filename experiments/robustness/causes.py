"""Why episodes failed, told by looking at them, beside what the decision tree says.

    python experiments/robustness/causes.py record eval/er/conditions/object=1@step20:20 ... --out causes   # 20 of them
    python experiments/robustness/causes.py draw --out causes      # sheets of pictures, without the tree's answers
    python experiments/robustness/causes.py compare --out causes   # labels.csv beside this file against the tree

`record` runs failed episodes of results again; `draw` shows them in random order, four a sheet.
"""

import argparse
import csv
import json
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from libero_env.mujoco_compat import mujoco
from libero_env.sim.causes import CAUSES
from libero_env.sim.render import Renderer, RenderTarget
from libero_env.sim.scene import build_scene
from libero_env.tasks import get_task
from libero_eval.evaluation_file import EvaluationResult
from libero_eval.plan import plan_evaluation
from libero_eval.requests import EvalRequest
from lifelong.evaluation.rollout import run_episodes

LABELS = Path(__file__).with_name("labels.csv")
CAMERAS = ("agentview", "robot0_eye_in_hand")
MOMENTS = (
    0.1,
    0.2,
    0.26,
    0.32,
    0.38,
    0.44,
    0.5,
    0.58,
    0.68,
    0.84,
    1.0,
)  # shares of an episode that are shown
SIZE, ROWS = 112, 4  # pixels; episodes of a sheet


def record(folder: Path, count: int, out: Path, draws: random.Random) -> None:
    """Run some failed episodes of a result again; write their poses, and what the tree says."""
    result = EvaluationResult.read(folder)
    failed = [
        (task.task, start)
        for task in draws.sample(result.tasks, len(result.tasks))
        for start, won in zip(task.init_states, task.successes, strict=True)
        if not won
    ][:count]
    request = EvalRequest(policy=str(folder), out=out / "none", threads=1, despite=("source",))
    evaluation = plan_evaluation(request)
    starts = result.init_states  # all, for a policy's bits may depend on how many act together
    for task in dict.fromkeys(name for name, _ in failed):
        env: Any = evaluation.env(get_task(task), len(starts))
        poses: list[np.ndarray] = []
        step = env.step

        def keep(actions, env=env, step=step, poses=poses):
            found = step(actions)
            poses.append(env.simulations.fields["qpos"].copy())
            return found

        env.step = keep
        with evaluation.actor(env.task, starts) as actor:
            if hasattr(actor, "watch"):
                actor.watch(env)
            done = run_episodes(
                actor,
                env,
                starts,
                horizon=evaluation.protocol.steps(env.task),
                settle_steps=evaluation.protocol.settle_steps,
                settle_action=evaluation.protocol.episode.settle_action,
            )
        before = next(one for one in result.tasks if one.task == task)
        for i, (start, one) in enumerate(zip(starts, done.episodes, strict=True)):
            if (task, start) not in failed:
                continue
            name = f"{folder.parents[1].name} {folder.name} {task.replace('/', '-')} {start}"
            again = one.actions == before.actions[before.init_states.index(start)]
            about = {
                "policy": folder.parents[1].name,
                "condition": folder.name,
                "task": task,
                "start": start,
                "instruction": before.instruction,
                "cause": one.failure.cause if one.failure else "success",
                "same actions as in the result": again,
            }
            (out / f"{name}.json").write_text(json.dumps(about))
            simulations, moves = env.simulations, np.array(poses)[-one.length :, i]
            placed = {"bodies": simulations.fixture_bodies, "fixtures": simulations.fixtures[i]}
            np.savez_compressed(out / f"{name}.npz", qpos=moves, **placed)
        env.close()


def draw(out: Path) -> None:
    """Write sheets of the recorded episodes, and `index.csv`, where they are to be labelled."""
    names = sorted(path.stem for path in out.glob("*.npz"))
    random.Random(0).shuffle(names)
    rows = [json.loads((out / f"{name}.json").read_text()) for name in names]
    with open(out / "index.csv", "w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(("number", "policy", "condition", "task", "start", "label"))
        for number, row in enumerate(rows):
            table.writerow((number, *(row[key] for key in ("policy", "condition", "task", "start")), ""))
    strips = {}
    for task in sorted({row["task"] for row in rows}):
        scene = build_scene(get_task(task).problem)
        with Renderer(scene.model, 3 * SIZE, 3 * SIZE) as renderer:
            for number, (name, row) in enumerate(zip(names, rows, strict=True)):
                if row["task"] == task:
                    strips[number] = _strip(
                        scene, renderer, np.load(out / f"{name}.npz"), f"{number}: {row['instruction']}"
                    )
    for first in range(0, len(names), ROWS):
        sheet = np.concatenate([strips[n] for n in range(first, min(first + ROWS, len(names)))])
        Image.fromarray(sheet).save(out / f"sheet{first // ROWS:02d}.png")


def _strip(scene, renderer, episode, caption: str) -> np.ndarray:
    data, columns = mujoco.MjData(scene.model), []
    scene.model.body_pos[episode["bodies"]] = episode["fixtures"][:, :3]
    scene.model.body_quat[episode["bodies"]] = episode["fixtures"][:, 3:]
    steps = (np.array(MOMENTS) * (len(episode["qpos"]) - 1)).round().astype(int)
    for step in steps:
        data.qpos[:] = episode["qpos"][step]
        mujoco.mj_forward(scene.model, data)
        views = []
        for camera in CAMERAS:
            image = np.empty((3 * SIZE, 3 * SIZE, 3), np.uint8)
            renderer.render(data, [RenderTarget(renderer.camera_id(camera), rgb=image)])
            cut = slice(45, -15) if camera == "agentview" else slice(None)  # what is far is left out
            view = Image.fromarray(np.ascontiguousarray(image[cut, cut]))
            views.append(np.asarray(view.resize((SIZE, SIZE), Image.Resampling.LANCZOS)))
        columns.append(np.concatenate(views))
    strip = Image.fromarray(
        np.pad(np.concatenate(columns, axis=1), ((14, 0), (0, 0), (0, 0)), constant_values=255)
    )
    ImageDraw.Draw(strip).text((2, 1), f"{caption}; steps {', '.join(map(str, steps))}", fill=(0, 0, 0))
    return np.asarray(strip)


def compare(out: Path) -> None:
    """Print how often the tree says each cause, by what was seen."""
    with open(LABELS, newline="") as file:
        labels = {
            tuple(row[key] for key in ("policy", "condition", "task", "start")): row["label"]
            for row in csv.DictReader(file)
        }
    counts, same = Counter(), 0
    for path in sorted(out.glob("*.json")):
        row = json.loads(path.read_text())
        label = labels.get((row["policy"], row["condition"], row["task"], str(row["start"])), "")
        if label:
            counts[label, row["cause"]] += 1
            same += row["same actions as in the result"]
    seen = [cause for cause in CAUSES if any(cause in pair for pair in counts)]
    print("| seen \\ tree |", " | ".join(seen), "|\n|---|" + "---:|" * len(seen))
    for label in seen:
        print(f"| {label} |", " | ".join(str(counts[label, cause] or "") for cause in seen), "|")
    agreed = sum(counts[cause, cause] for cause in seen)
    print(f"{agreed} of {counts.total()} agree; {same} episodes have the actions of their result")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "draw", "compare"))
    parser.add_argument("results", nargs="*", help="FOLDER:COUNT of failures")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    if args.what == "record":
        draws = random.Random(0)
        for text in args.results:
            folder, _, count = text.rpartition(":")
            record(Path(folder), int(count), args.out, draws)
    else:
        {"draw": draw, "compare": compare}[args.what](args.out)


if __name__ == "__main__":
    main()
