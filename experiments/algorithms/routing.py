"""Does a run of CLARE choose the adapters that its tasks were learned with, and what would these do?

    python experiments/algorithms/routing.py runs/libero_object/clare/bc_mlp_small_seed1 --tasks 6 9

Prints, for each task and layer, the shares of samples of 20 rollouts that each task's adapter acts on (-1: none), and
the success with the adapters that are chosen and with those that the task was learned with.
"""

import argparse
from collections import Counter, defaultdict
from contextlib import closing
from pathlib import Path

import torch

from libero_eval.relearning import failure_share
from lifelong.algorithms import CLARE
from lifelong.evaluation.restore import LoadedRun, restore
from lifelong.policies.base import Policy

EPISODES = 20


class Watched(CLARE):
    """CLARE that counts what it chooses, and may be told to use a task's own adapters."""

    def __init__(self, algorithm: CLARE):
        self.__dict__.update(algorithm.__dict__)
        self.counts: dict[str, Counter[int]] = defaultdict(Counter)
        self.told: int | None = None

    def route(self, name: str, samples: torch.Tensor) -> torch.Tensor:
        """Return what is chosen for samples, and count it."""
        chosen = super().route(name, samples)
        self.counts[name].update(chosen.tolist())
        return chosen

    def uses(self, task: int, name: str) -> int:
        """Return the task whose adapter a layer was learned with."""
        return self.chosen[task][name]

    def _acting(self) -> int | None:
        return self.told


def success(run: LoadedRun, policy: Policy, task: int) -> float:
    """Return the share of rollouts of a task that succeed."""
    with closing(run.environment(task, EPISODES, run.eval.horizon)) as env:
        return 1 - failure_share(policy, run, task, env, EPISODES)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, help="directory of a finished run of algo=clare")
    parser.add_argument("--tasks", type=int, nargs="+", help="positions of tasks, from 0 (default: all)")
    args = parser.parse_args()
    run = restore(args.run)
    if not isinstance(run.algorithm, CLARE):
        parser.error(f"{args.run} is not a run of algo=clare")
    for task in args.tasks or range(len(run.tasks)):
        watched = Watched(run.algorithm)
        with watched.policy_for(task, run.policy) as policy:
            routed = success(run, policy, task)
        for name, counts in watched.counts.items():
            shares = {t: round(n / counts.total(), 2) for t, n in counts.most_common(3)}
            print(f"  {name:40} learned with {watched.uses(task, name):2}: {shares}")
        watched.told = task
        with watched.policy_for(task, run.policy) as policy:
            own = success(run, policy, task)
        print(f"{run.tasks[task].name}: {routed:.2f} as chosen, {own:.2f} with its own", flush=True)


if __name__ == "__main__":
    main()
