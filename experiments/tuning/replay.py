"""Measure what algorithms keep and learn on held-out demonstrations, with what they store and what a step costs.

    python experiments/tuning/replay.py "algo=er algo.memory.budget=1000" "algo=compressed_er algo.budget=950000"

Two tasks of LIBERO-Object are learned with 30 demonstrations each, in 160 steps of 64 windows, by the small ResNet-T on
images of 64 pixels. Kept and learned are the mean absolute errors of the actions on ten other demonstrations of the
first and of the second task, after the second.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from torch import Tensor

from libero_env.tasks import get_suite
from lifelong.algorithms import Algorithm
from lifelong.data import SequenceVLDataset
from lifelong.data.demonstrations import find_demos
from lifelong.policies.base import Policy
from lifelong.seeding import generator, seeded
from lifelong.settings import Configuration, plain_data
from lifelong.training.costs import step_costs, stored_bytes
from lifelong.training.fit import fit
from lifelong.types import Batch

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
FIXED = (
    *("preset=laptop", "benchmark=libero_object", "policy=bc_transformer_small", "data.demos=40"),
    *("train.epochs=1", "train.steps_per_epoch=160", "train.warmup_steps=10"),
)
LEARNED, MEASURED, CHUNK = 30, 512, 128  # demonstrations; held-out windows; windows of a forward pass


def configured(words: list[str]) -> Configuration:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        return Configuration(plain_data(compose("config", [*FIXED, *words])))


def open_tasks(count: int) -> tuple[list[SequenceVLDataset], list[Batch]]:
    """Return the windows to learn from and those to measure on, of each task."""
    config, tasks = configured([]), get_suite("libero_object").tasks[:count]
    languages, data = config.build("language").embed([task.language for task in tasks]), config.build("data")
    spec, training, held_out = data.spec(languages.shape[1]), [], []
    for k, path in enumerate(find_demos(tasks, [data.demos] * count, data, True)):
        few, every = (
            SequenceVLDataset.from_file(path, spec=spec, language=languages[k], task_id=k, limit=limit)
            for limit in (LEARNED, data.demos)
        )
        left = len(every) - len(few)
        held_out.append(
            every.batch(len(few) + torch.linspace(0, left - 1, min(left, MEASURED)).round().long())
        )
        training.append(few)
    return training, held_out


@torch.no_grad()
def error(algorithm: Algorithm, policy: Policy, task: int, batch: Batch) -> float:
    with algorithm.policy_for(task, policy) as acting:
        acting.eval()
        parts = [batch.rows(rows) for rows in torch.arange(len(batch)).split(CHUNK)]
        errors: list[Tensor] = [(acting.predict(p) - p.actions).abs().flatten(1).mean(1) for p in parts]
    return round(float(torch.cat(errors).mean()), 4)


def measure(
    words: list[str], seed: int, training: list[SequenceVLDataset], held_out: list[Batch]
) -> dict[str, Any]:
    """Learn the tasks and return the errors after each, what is stored, and what a step of the last one costs."""
    config = configured(words)
    algorithm: Algorithm = config.build("algo")
    algorithm.set_augmentation(config.build("augmentation"))
    spec = config.build("data").spec(training[0].language.numel())
    with seeded(seed, 0):
        policy: Policy = config.build("policy", spec=spec)
    errors = []
    for task, windows in enumerate(training):
        algorithm.begin_task(task, windows, policy)
        for number, phase in enumerate(algorithm.phases()):
            algorithm.begin_phase(phase, policy)
            settings = replace(config.build("train"), epochs=1)
            fit(
                policy,
                windows,
                algorithm,
                settings=settings,
                seed=(seed, 1, task, number),
                augment=algorithm.augment,
            )
            algorithm.end_phase(phase, policy)
        with seeded(seed, 2, task, 1):
            algorithm.end_task(task, windows, policy, generator(seed, 2, task))
        errors.append([error(algorithm, policy, k, held_out[k]) for k in range(task + 1)])
    costs = step_costs(policy, algorithm, training[-1], 64)
    return {"words": words, "seed": seed, "errors": errors, "stored_bytes": stored_bytes(algorithm), **costs}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="+", help="overrides of one configuration, in one word")
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--tasks", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    training, held_out = open_tasks(options.tasks)
    for seed in map(int, options.seeds.split(",")):
        for overrides in options.overrides:
            print(json.dumps(measure(overrides.split(), seed, training, held_out)), flush=True)


if __name__ == "__main__":
    main()
