"""Where does the expert begin again in demonstrations of a task, and how long do they become?

    python experiments/expert/retries.py libero_goal/3 libero_spatial/4 --demos 20

The starts, motion styles and noise are those of the first demonstrations of `libero demos generate`.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from unittest.mock import patch

import numpy as np

from libero_env.demos.config import DemoConfig
from libero_env.demos.record import DemoRecorder
from libero_env.expert import Expert
from libero_env.expert.expert import Attempt
from libero_env.sim.state import StateView
from libero_env.tasks import find_tasks

AFTERMATH = ("release", "withdraw", "rest")  # phases of a skill that has already given up its attempt


@contextmanager
def counted_retries() -> Iterator[Counter[str]]:
    """Count, while active, the skills and phases from which experts begin again."""
    counts: Counter[str] = Counter()
    act = Expert.act

    def counting_act(self: Expert, view: StateView) -> np.ndarray:
        skill, phase, retries = type(self.skill).__name__, self.phase, self.retries
        if phase not in AFTERMATH or skill == "PickPlace":
            vars(self)["active"] = f"{skill}.{phase}"
        action = act(self, view)
        if self.retries > retries:
            counts[vars(self).get("active", phase)] += 1
        return action

    with patch.object(Expert, "act", counting_act):
        yield counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("tasks", nargs="+", help="tasks or suites")
    parser.add_argument("--demos", type=int, default=20, help="attempts for each task (default: %(default)s)")
    parser.add_argument("--still", action="store_true", help="without noise on the actions")
    args = parser.parse_args()
    print("| task | success | steps | without a retry | retries, after |\n|---|---:|---:|---:|---|")
    for task in find_tasks(args.tasks):
        recorder = DemoRecorder(DemoConfig(task, (64, 64), disturb=not args.still))
        attempts: list[Attempt] = []
        with counted_retries() as counts:
            while len(attempts) < args.demos:
                numbers = [(k, 0) for k in range(len(attempts), args.demos)]
                attempts += [attempt for _, attempt in recorder.attempt(numbers)]
        recorder.close()
        success = np.mean([attempt.success for attempt in attempts])
        steps = np.mean([len(attempt) for attempt in attempts])
        clean = np.mean([attempt.retries == 0 for attempt in attempts])
        where = ", ".join(f"{name} {n}" for name, n in counts.most_common()) or "none"
        print(
            f"| {task.id} {task.language} | {success:.0%} | {steps:.0f} | {clean:.0%} | {where} |", flush=True
        )


if __name__ == "__main__":
    main()
