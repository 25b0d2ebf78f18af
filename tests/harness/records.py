"""Records of runs for tests."""

from collections.abc import Sequence

from lifelong.results.provenance import start_record
from lifelong.results.records import EvalRecord, RunRecord


def run_start(tasks: Sequence[str], **changes) -> RunRecord:
    """Return the record that a run of these tasks starts with, with other facts where they are given."""
    facts = {"algo": "er", "benchmark": "libero_object", "policy": "small", "seed": 1, "preset": ""}
    facts |= {"tasks": list(tasks), "instructions": list(tasks), "config": {"seed": 1}}
    return start_record(**(facts | changes))


def evaluation(
    phase: str, learned: int, epoch: int, task: int, wins: int, episodes: int = 4, **changes
) -> EvalRecord:
    """Return the record of an evaluation whose first episodes succeed."""
    values = {"successes": tuple(i < wins for i in range(episodes)), "init_states": tuple(range(episodes))}
    values |= {"lengths": tuple(100 + i for i in range(episodes)), "seconds": 1.5}
    return EvalRecord(phase=phase, learned=learned, epoch=epoch, task=task, **(values | changes))
