"""Why episodes failed, told by looking at them, beside what the decision tree says.

    python experiments/robustness/causes.py choose runs/criteria --count 40   # into causes.npz and labels.csv
    python experiments/robustness/causes.py draw --out sheets    # those without a label, without the tree's answers
    python experiments/robustness/causes.py compare                # labels.csv against the tree

`choose` takes the episodes that `experiments/tuning/criteria.py` has kept, and writes the actions of some failed ones
beside this file, in random order. `draw` and `compare` run these again.
"""

import argparse
import csv
import itertools
import json
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from libero_env.envs.batch import BatchEnv
from libero_env.mujoco_compat import mujoco
from libero_env.sim.causes import CAUSES
from libero_env.sim.render import Renderer, RenderTarget
from lifelong.evaluation.rollout import Episode, run_episodes
from lifelong.settings import BenchmarkSettings

LABELS, ACTIONS = (Path(__file__).with_name(name) for name in ("labels.csv", "causes.npz"))
CAMERAS = ("agentview", "robot0_eye_in_hand")
FIELDS = ("number", "set", "policy", "task", "start", "label", "of")
SIZE, ROWS, MOMENTS = 160, 4, 10  # pixels; episodes of a sheet; pictures of an episode


class Replay:
    """An actor that repeats actions, (T, 7)."""

    action_dim, views, sees_next = 7, (), False

    def __init__(self, actions: np.ndarray):
        self._actions = iter(actions.astype(np.float64))

    def reset(self, num_envs: int) -> None:
        """There is no history."""

    def act(self, obs: Any) -> np.ndarray:
        """Return the next action."""
        return next(self._actions)[None]


def replay(task: str, start: int, actions: np.ndarray) -> tuple[Episode, BatchEnv, np.ndarray]:
    """Run an episode again; return it, its environment, still open, and the positions after each step."""
    env, poses = BatchEnv(task, 1, cameras=(), horizon=len(actions) + 1, num_threads=1), []
    step = env.step

    def kept(chosen: np.ndarray) -> Any:
        found = step(chosen)
        poses.append(env.simulations.fields["qpos"][0].copy())
        return found

    env.step = kept
    done = run_episodes(Replay(actions), env, [start], horizon=len(actions), settle_steps=0)
    return done.episodes[0], env, np.array(poses)


def choose(folder: Path, count: int) -> None:
    """Write failed episodes of several policies, as many of each algorithm and task as there are, in random order."""
    tasks, draws = BenchmarkSettings("libero_object").sequence(), random.Random(0)
    groups: dict[tuple[str, int], list[tuple[str, int, int]]] = {}
    for path in sorted(folder.glob("*-?.json")):
        for k, won in enumerate(json.loads(path.read_text())["success"].get("0", {"won": []})["won"]):
            group = groups.setdefault((path.stem.partition("-")[0], k), [])
            group += [(path.stem, k, start) for start, yes in enumerate(won) if not yes]
    for group in groups.values():
        draws.shuffle(group)
    old = episodes() if LABELS.is_file() else []
    kept = {row["number"]: row.pop("actions") for row in old}
    known = {(row["policy"], row["task"], int(row["start"])) for row in old}
    number_of_set = 1 + max((int(row["set"]) for row in old), default=0)
    chosen: list[tuple[str, int, int]] = []
    while len(chosen) < count and any(groups.values()):
        found = [group.pop() for group in groups.values() if group]
        chosen += [one for one in found if (one[0], tasks[one[1]].id, one[2]) not in known]
    chosen = draws.sample(chosen, min(count, len(chosen)))
    for number, (policy, k, start) in enumerate(chosen, len(old)):
        about = {"policy": policy, "task": tasks[k].id, "start": start, "label": "", "of": ""}
        old.append({"number": number, "set": number_of_set, **about})
        kept[str(number)] = np.load(folder / f"{policy}-{k}.npz")["actions"][:, start]
    with open(LABELS, "w", newline="") as file:
        table = csv.DictWriter(file, FIELDS, lineterminator="\n")
        table.writeheader()
        table.writerows(old)
    np.savez_compressed(ACTIONS, **kept)


def episodes() -> list[dict[str, Any]]:
    """Return the rows of labels.csv with the actions of their episodes."""
    with open(LABELS, newline="") as file, np.load(ACTIONS) as actions:
        return [{**row, "actions": actions[row["number"]]} for row in csv.DictReader(file)]


def draw(out: Path) -> None:
    """Write sheets: ten moments of each episode from two cameras, with the distances of fingertips and objects."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [row for row in episodes() if not row["label"]]
    for first in range(0, len(rows), ROWS):
        strips = [_strip(row) for row in rows[first : first + ROWS]]
        Image.fromarray(np.concatenate(strips)).save(out / f"sheet{first // ROWS:02d}.png")


def _strip(row: dict[str, Any]) -> np.ndarray:
    _, env, poses = replay(row["task"], int(row["start"]), row["actions"])
    scene, data, view, columns, texts = env.scene, env.simulations.data(0), env.views[0], [], []
    wanted = {name for atom in env.goals.atoms for name in map(scene.owner, atom.args)}
    with env, Renderer(scene.model, 3 * SIZE, 3 * SIZE) as renderer:
        for step in np.linspace(0.1, 1, MOMENTS) * (len(poses) - 1):
            data.qpos[:] = poses[round(step)]
            mujoco.mj_forward(scene.model, data)
            views = []
            for camera in CAMERAS:
                image = np.empty((3 * SIZE, 3 * SIZE, 3), np.uint8)
                renderer.render(data, [RenderTarget(renderer.camera_id(camera), rgb=image)])
                cut = slice(60, -20) if camera == "agentview" else slice(None)  # what is far is left out
                shown = Image.fromarray(np.ascontiguousarray(image[cut, cut]))
                views.append(np.asarray(shown.resize((SIZE, SIZE), Image.Resampling.LANCZOS)))
            columns.append(np.concatenate(views))
            tip, width = data.site_xpos[env.simulations.arm.site], np.abs(view.finger_pos).sum()
            far = {n: np.linalg.norm(data.body(f"{n}_main").xpos - tip) for n in scene.objects}
            near = sorted((n for n in far if n not in wanted), key=far.__getitem__)[:2]
            named = [n for n in far if n in wanted and "basket" not in n] + near
            texts.append(
                [f"{round(step)}: fingers {1000 * width:.0f} mm"]
                + [f"{n[:-2]} {100 * far[n]:.1f}" for n in named]
            )
    strip = Image.fromarray(
        np.pad(np.concatenate(columns, axis=1), ((66, 0), (0, 0), (0, 0)), constant_values=255)
    )
    pen = ImageDraw.Draw(strip)
    pen.text((2, 1), f"{row['number']}: {env.task.language}", fill=(180, 0, 0))
    for i, lines in enumerate(texts):
        pen.multiline_text((2 + i * SIZE, 13), "\n".join(lines), fill=(0, 0, 0), spacing=1)
    return np.asarray(strip)


def compare() -> None:
    """Print how often the tree says each cause, by what was seen, and what it says otherwise."""
    for number, group in itertools.groupby(episodes(), key=lambda row: row["set"]):
        counts, told = Counter(), []
        for row in group:
            episode, env, _ = replay(row["task"], int(row["start"]), row["actions"])
            env.close()
            cause = episode.failure.cause if episode.failure else "success"
            counts[row["label"], cause] += 1
            if row["label"] != cause:
                told.append(f"{row['number']}: {row['label']} {row['of']}, tree {cause}")
        seen = [cause for cause in CAUSES if any(cause in pair for pair in counts)]
        print(f"\n| set {number}: seen \\ tree |", " | ".join(seen), "|\n|---|" + "---:|" * len(seen))
        for label in seen:
            print(f"| {label} |", " | ".join(str(counts[label, cause] or "") for cause in seen), "|")
        print(f"{sum(counts[cause, cause] for cause in seen)} of {counts.total()} agree", *told, sep="\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("choose", "draw", "compare"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--out", type=Path, default=Path("sheets"))
    args = parser.parse_args()
    if args.what == "choose":
        choose(args.folder, args.count)
    else:
        draw(args.out) if args.what == "draw" else compare()


if __name__ == "__main__":
    main()
