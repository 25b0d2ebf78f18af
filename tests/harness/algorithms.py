"""Learning with an algorithm on small random tasks, of pairs and of frames."""

import torch

from lifelong.algorithms import Algorithm
from lifelong.seeding import generator, seeded
from lifelong.training.fit import fit
from lifelong.training.settings import FitSettings
from lifelong.types import Batch, Observation
from tests.harness import policies, sequences
from tests.harness.fakes import LinearPolicy, Windows

SETTINGS = FitSettings(epochs=2, batch_size=8, lr=1e-2, weight_decay=0.1, precision="fp32")
SMALL = FitSettings(epochs=2, batch_size=8, lr=1e-2, precision="fp32")
POLICIES = {
    f"bc_{kind}": getattr(policies, f"small_{kind}") for kind in ("transformer", "rnn", "vilt", "mlp")
}
MIXING = ("bc_transformer", "bc_rnn", "bc_vilt")  # over time


def make_policy(kind: str = "bc_transformer", head: str = "gmm", spec=sequences.SPEC):
    with seeded(3):
        return POLICIES[kind](spec, head)


def learn(algorithm: Algorithm, policy, task: int, dataset=None, settings: FitSettings = SETTINGS) -> None:
    """Learn a task from beginning to end, as `TaskSequence` does; by default one of pairs."""
    dataset = Windows(task) if dataset is None else dataset
    with seeded(task):
        algorithm.begin_task(task, dataset, policy)
    for number, phase in enumerate(algorithm.phases()):
        algorithm.begin_phase(phase, policy)
        fit(policy, dataset, algorithm, settings=settings, seed=(task, number), augment=algorithm.augment)
        algorithm.end_phase(phase, policy)
    algorithm.end_task(task, dataset, policy, generator(task))


def learn_frames(algorithm: Algorithm, policy, *tasks: int, settings: FitSettings = SMALL) -> None:
    """Learn tasks of frames from beginning to end."""
    for task in tasks:
        learn(algorithm, policy, task, sequences.dataset(task), settings)


def everything(task: int) -> Batch:
    """All windows of a task of frames."""
    return sequences.dataset(task).batch(torch.arange(20))


def predict(algorithm: Algorithm, policy, batch: Batch, task: int = 0) -> torch.Tensor:
    with torch.no_grad(), algorithm.policy_for(task, policy) as acting:
        return acting.eval().predict(batch)


def frame(observation: Observation, step: int) -> Observation:
    """One step of windows."""
    at = slice(step, step + 1)
    proprio = {k: v[:, at] for k, v in observation.proprio.items()}
    return Observation(observation.images[:, at], proprio, observation.language)


def outputs(algorithm: Algorithm, policy, task: int) -> torch.Tensor:
    with torch.no_grad(), algorithm.policy_for(task, policy) as acting:
        acting.eval()
        return acting(Windows(task).features[:, None])


def by_hand(policy: LinearPolicy, data: Windows) -> torch.Tensor:
    """Gradient of each window's squared error with respect to the weight: 2 (Wx + b - y) x^T."""
    error = data.features @ policy.linear.weight.T + policy.linear.bias - data.targets
    return 2 * error[:, :, None] * data.features[:, None, :]  # (N, A, D)


def assert_resumed_equals_uninterrupted(
    folder, algo, monkeypatch, make_context=None, last: int = sequences.TASKS - 1, first: int = 1
):
    """Learn the sequence uninterrupted, and killed again and again; return how many processes that took.

    The first process is killed at its `first` write, the others at their fourth to eighth.
    """
    make_context = make_context or sequences.run_context
    uninterrupted = make_context(folder / "whole", algo)
    sequences.sequence(uninterrupted).run()
    records, state = sequences.outcome(folder / "whole", uninterrupted.directory.log, last)
    starts, resumed = _killed_repeatedly(folder / "killed", algo, monkeypatch, make_context, first)
    assert starts > 2
    same_records, same_state = sequences.outcome(folder / "killed", resumed.directory.log, last)
    assert same_records == records
    sequences.assert_same(same_state, state)
    return starts


def _killed_repeatedly(path, algo, monkeypatch, make_context, first):
    """Learn the sequence in processes that are killed; return how many there were, and the context of the last."""
    starts, writes = 0, first
    while True:
        starts += 1
        assert starts < 100
        with monkeypatch.context() as patch:
            p = make_context(path, algo)
            killer = sequences.Killer(patch, writes)
            patch.setattr(p.directory.log, "append", killer.guard(p.directory.log.append))
            try:
                sequences.sequence(p).run()
                return starts, p
            except sequences.Killed:
                writes = 4 + starts % 5
