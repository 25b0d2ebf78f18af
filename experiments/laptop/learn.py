"""Learn single tasks from scratch; measure the held-out error, the success from the same starts, and where it misses.

    python experiments/laptop/learn.py 80-demos --tasks 0 5 --demos 110 data.demos=80
    python experiments/laptop/learn.py 40-demos --tasks 0 5 --demos 110 data.demos=40
    python experiments/laptop/learn.py 80-demos --compare 40-demos

Results are kept in `--out`, a file for each name, task and seed; what is there is not measured again. Words with `=`
are overrides of the configuration. The last demonstrations of `--demos` are held out.
"""

import argparse
import json
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from scipy.stats import binomtest
from torch import Tensor

from libero_env.demos.read import Episode, read_demos
from libero_env.envs.batch import BatchEnv
from lifelong.algorithms import Sequential
from lifelong.composition import config_folder
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.demonstrations import find_demos
from lifelong.evaluation.rollout import rollout
from lifelong.policies.base import Policy
from lifelong.seeding import seeded
from lifelong.settings import Configuration, plain_data
from lifelong.training.fit import fit

HELD_OUT = 30  # demonstrations
BEFORE, AFTER = 12, 4  # steps around the first closing of the fingers that are near the grasp
STARTS = range(40)


class Grasps:
    """Environment that notes where the fingers first close, relative to the goal's first object.

    Attributes:
        closings: Simulation to the object's position from the grip site, [m], when the first closing action came.
    """

    def __init__(self, env: BatchEnv):
        self._env = env
        self.closings: dict[int, list[float]] = {}
        words = [word for atom in env.atoms for word in re.split(r"[^\w]+", atom)]
        self._object = next((word for word in words if word in env.scene.objects), None)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def step(self, actions: np.ndarray) -> tuple:
        """Step all simulations; see `BatchEnv`."""
        for i in np.flatnonzero(self._env.running & (actions[:, 6] > 0)).tolist() if self._object else ():
            view = self._env.views[i]
            self.closings.setdefault(i, (view.body_pos(self._object) - view.eef_pos).round(4).tolist())
        return self._env.step(actions)


def learn(words: Sequence[str], suite: str, task: int, seed: int, demos: int) -> dict[str, Any]:
    """Learn one task from scratch and return what was measured."""
    words = [f"benchmark={suite}", f"benchmark.tasks=[{task}]", f"seed={seed}", "threads=1", *words]
    with initialize_config_dir(str(config_folder().resolve()), version_base="1.3"):
        config = Configuration(plain_data(compose("config", words)))
    data, settings = config.build("data"), config.build("train")
    if data.demos > demos - HELD_OUT:
        raise SystemExit(
            f"error: data.demos={data.demos} and {HELD_OUT} held out are more than --demos {demos}"
        )
    torch.set_num_threads(1)
    found = config.build("benchmark").sequence()[0]
    path = find_demos([found], [demos], data, False)[0]
    language = config.build("language").embed([found.language])[0]
    spec = data.spec(len(language))
    read = read_demos(path, [*spec.views, *spec.proprio], demos, pairing="aligned")
    learned = SequenceVLDataset.from_demos(read[: data.demos], spec=spec, language=language)
    with seeded(seed, 0):
        policy: Policy = config.build("policy", spec=spec)
    began, losses = time.process_time(), []
    fit(
        policy,
        learned,
        Sequential(),
        settings=settings,
        seed=(seed, 1, 0, 0),
        augment=config.build("augmentation"),
        on_epoch=lambda end: losses.append(end.loss),
    )
    result = {"words": words, "training_seconds": time.process_time() - began, "loss": losses[-1]}
    result |= held_out_error(policy, read[-HELD_OUT:], language)
    horizon = config.build("eval").horizon
    env = BatchEnv(found, len(STARTS), num_threads=1, camera_size=spec.image_size, horizon=horizon)
    try:
        grasps = Grasps(env)
        outcome = rollout(policy, grasps, STARTS, language=language, horizon=horizon, settle_steps=0)
    finally:
        env.close()
    result["successes"] = [episode.success for episode in outcome.episodes]
    result["closings"] = [grasps.closings.get(i) for i in STARTS]
    return result


def held_out_error(policy: Policy, demos: Sequence[Episode], language: Tensor) -> dict[str, float]:
    """Return the mean absolute error of the actions of demonstrations, on all frames and on those near the grasp."""
    data = SequenceVLDataset.from_demos(demos, spec=replace(policy.spec, seq_len=1), language=language)
    policy.eval()
    with torch.no_grad():
        predicted = torch.cat(
            [policy.predict(data.batch(i))[:, 0] for i in torch.arange(len(data)).split(500)]
        )
    error, near, start = (predicted - data.actions).abs(), [], 0
    for demo in demos:
        closing = int(np.argmax(demo.actions[:, 6] > 0))
        near += range(start + max(0, closing - BEFORE), start + min(closing + AFTER, len(demo)))
        start += len(demo)
    wrong = (predicted[:, 6] > 0) != (data.actions[:, 6] > 0)
    return {
        "held_out": error.mean().item(),
        "held_out_near": error[near].mean().item(),
        "fingers_wrong_near": wrong[near].float().mean().item(),
    }


def compare(folder: Path, ours: str, other: str) -> str:
    """Return wins and losses over the tasks, seeds and starts that two names have in common, and their sign test."""
    a, b = [], []
    for path in sorted(folder.glob(f"{ours}.*.json")):
        against = folder / path.name.replace(ours, other, 1)
        if against.exists():
            a += json.loads(path.read_text())["successes"]
            b += json.loads(against.read_text())["successes"]
    wins, losses = (sum(x > y for x, y in zip(*pair, strict=True)) for pair in ((a, b), (b, a)))
    p = binomtest(wins, wins + losses).pvalue if wins + losses else 1.0
    return (
        f"{ours} {sum(a)}, {other} {sum(b)} of {len(a)}: {wins} wins, {losses} losses, sign test p = {p:.3f}"
    )


def main() -> None:
    """Measure what the command line asks for, or compare what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("name")
    parser.add_argument("--suite", default="libero_object")
    parser.add_argument("--tasks", type=int, nargs="+", default=[5], help="positions in the suite's order 0")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--demos", type=int, default=110, help="recorded, with those that are held out")
    parser.add_argument("--out", type=Path, default=Path("runs/laptop"))
    parser.add_argument("--compare", nargs="+", default=[], metavar="NAME")
    args, words = parser.parse_known_args()
    for other in args.compare:
        print(compare(args.out, args.name, other))
    for task, seed in [(t, s) for t in args.tasks for s in args.seeds if not args.compare]:
        path = args.out / f"{args.name}.{args.suite}-{task}.seed{seed}.json"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(learn(words, args.suite, task, seed, args.demos)))
        result = json.loads(path.read_text())
        shown = {key: round(value, 4) for key, value in result.items() if isinstance(value, float)}
        print(f"{path.stem}: {sum(result['successes'])}/{len(result['successes'])} {shown}", flush=True)


if __name__ == "__main__":
    main()
