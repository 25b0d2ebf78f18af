"""What copies of demonstrations under perturbations buy: one task learned with and without them, in as many steps.

    python experiments/robustness/augmentation.py --suite libero_goal --task 8 --perturb camera=0.5,light=0.5

Each policy is evaluated plainly and under each of the perturbations alone, from the same starts; draws of evaluations
are none of those of the copies. Results are kept in `--out`; what is there is not measured again. Words with `=` are
overrides of the configuration.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from scipy.stats import binomtest

from libero_env.envs.batch import BatchEnv
from libero_env.perturbations import parse_perturbations
from lifelong.algorithms import Sequential
from lifelong.composition import config_folder
from lifelong.data.demonstrations import DemoDatasets, demo_copies, find_demos
from lifelong.evaluation.rollout import rollout
from lifelong.policies.base import Policy
from lifelong.seeding import seeded
from lifelong.settings import Configuration, plain_data
from lifelong.training.fit import fit

STARTS = range(40)
ARMS = {"recorded": 0, "copies": 1}


def learn(words: Sequence[str], seed: int, conditions: Sequence[str]) -> dict[str, Any]:
    """Learn one task from scratch, and return its successes under each condition.

    Args:
        words: Overrides of the configuration, with the task and the copies.
        seed: Seed of weights and batches.
        conditions: Perturbations of each evaluation, as text; empty for none.
    """
    words = ["threads=1", f"seed={seed}", *words]
    with initialize_config_dir(str(config_folder().resolve()), version_base="1.3"):
        config = Configuration(plain_data(compose("config", words)))
    torch.set_num_threads(1)
    data, horizon = config.build("data"), config.build("eval").horizon
    tasks, counts = config.build("benchmark").sequence()[:1], [data.demos]
    paths = find_demos(tasks, counts, data, False)
    copies = demo_copies(paths, tasks, counts, [()], data, False)
    languages = config.build("language").embed([task.language for task in tasks])
    spec = data.spec(languages.shape[1])
    learned = DemoDatasets(paths, counts, spec, languages, data, torch.device("cpu"), copies)[0]
    with seeded(seed, 0):
        policy: Policy = config.build("policy", spec=spec)
    began = time.process_time()
    settings, augment = config.build("train"), config.build("augmentation")
    fit(policy, learned, Sequential(), settings=settings, seed=(seed, 1, 0, 0), augment=augment)
    result: dict[str, Any] = {"words": words, "windows": len(learned)}
    result["training_seconds"] = time.process_time() - began
    for perturb in conditions:
        env = BatchEnv(
            tasks[0],
            len(STARTS),
            num_threads=1,
            camera_size=spec.image_size,
            horizon=horizon,
            drawing=data.drawing,
            perturb=perturb,
        )
        try:
            done = rollout(policy, env, STARTS, language=languages[0], horizon=horizon, settle_steps=0)
        finally:
            env.close()
        result[perturb or "plain"] = [episode.success for episode in done.episodes]
    return result


def compared(without: Sequence[bool], with_copies: Sequence[bool]) -> str:
    """Return wins and losses of the copies over the starts, and their sign test."""
    pairs = list(zip(with_copies, without, strict=True))
    wins, losses = sum(a > b for a, b in pairs), sum(a < b for a, b in pairs)
    p = binomtest(wins, wins + losses).pvalue if wins + losses else 1.0
    return f"{wins} wins, {losses} losses, p = {p:.3g}"


def main() -> None:
    """Measure both arms, and print a row for each condition."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--suite", default="libero_goal")
    parser.add_argument("--task", type=int, default=8, help="index in the suite")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--perturb", default="camera=0.5,light=0.5")
    parser.add_argument("--out", type=Path, default=Path("runs/augmentation"))
    args, words = parser.parse_known_args()
    conditions = ["", *map(str, parse_perturbations(args.perturb))]
    found = {}
    for arm, copies in ARMS.items():
        path = args.out / f"{args.suite}-{args.task}.seed{args.seed}.{arm}.json"
        if not path.exists():
            own = [f"benchmark={args.suite}", f"benchmark.tasks=[{args.task}]"]
            own += [f"data.perturb='{args.perturb}'", f"data.perturb_copies={copies}"]
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(learn([*own, *words], args.seed, conditions)))
        found[arm] = json.loads(path.read_text())
        print(f"{arm}: {found[arm]['windows']} windows, {found[arm]['training_seconds']:.0f} s", flush=True)
    for name in (one or "plain" for one in conditions):
        without, with_copies = (found[arm][name] for arm in ARMS)
        rates = f"{sum(without)} -> {sum(with_copies)} of {len(STARTS)}"
        print(f"{name}: {rates} ({compared(without, with_copies)})", flush=True)


if __name__ == "__main__":
    main()
