"""What weight averaging between tasks promises, as properties."""

import pytest
import torch

from lifelong.algorithms import Averaging, Sequential
from lifelong.checkpoints import check
from lifelong.errors import ConfigError
from tests.harness import sequences
from tests.harness.algorithms import learn
from tests.harness.fakes import DeepPolicy, Windows


def policy() -> DeepPolicy:
    torch.manual_seed(0)
    return DeepPolicy()


def weights(found: torch.nn.Module) -> dict[str, torch.Tensor]:
    """Return copies of weights and statistics, without counts of batches."""
    return {name: v.clone() for name, v in found.state_dict().items() if v.is_floating_point()}


def solutions_and_ends(algorithm: Averaging, tasks: int) -> tuple[list[dict], list[dict]]:
    """Return the weights before and after each task's end, with fine-tuning between them."""
    acting, solutions, ends = policy(), [], []
    plain = algorithm.end_task

    def end_task(task, dataset, found, generator) -> None:
        solutions.append(weights(found))
        plain(task, dataset, found, generator)
        ends.append(weights(found))

    algorithm.end_task = end_task  # type: ignore[method-assign]
    for task in range(tasks):
        learn(algorithm, acting, task)
    return solutions, ends


def test_after_every_task_the_weights_are_the_mean_of_the_solutions() -> None:
    solutions, ends = solutions_and_ends(Averaging(), 4)
    for count, end in enumerate(ends, start=1):
        for name, value in end.items():
            mean = torch.stack([solution[name] for solution in solutions[:count]]).mean(0)
            torch.testing.assert_close(value, mean, rtol=1e-5, atol=1e-6)
    assert any(not torch.equal(ends[3][name], value) for name, value in solutions[3].items())


def test_with_a_share_of_one_it_is_fine_tuning_to_the_bit_and_with_zero_nothing_moves() -> None:
    plain, averaged, frozen = policy(), policy(), policy()
    learners = Sequential(), Averaging(share=1.0), Averaging(share=0.0)
    for task in range(3):
        for learner, found in zip(learners, (plain, averaged, frozen), strict=True):
            learn(learner, found, task)
        if task == 0:
            first = weights(frozen)
    sequences.assert_same(dict(averaged.state_dict()), dict(plain.state_dict()))
    sequences.assert_same(weights(frozen), first)


@pytest.mark.parametrize(("share", "base", "expected"), [
    (None, 1, (1, 1 / 2, 1 / 3, 1 / 4)),
    (None, 0, (1 / 2, 1 / 3, 1 / 4, 1 / 5)),  # the pretrained policy counts as one
    (None, 2, (1, 1, 1 / 2, 1 / 3)), (0.3, 1, (1, 0.3, 0.3, 0.3)), (0.3, 0, (0.3, 0.3, 0.3, 0.3)),
])  # fmt: skip
def test_shares_of_the_tasks(share, base, expected) -> None:
    learner = Averaging(share=share, base_tasks=base)
    assert tuple(learner.share_of(k) for k in range(1, 5)) == expected


def test_parts_of_the_policy_have_shares_of_their_own() -> None:
    found = torch.nn.Sequential(torch.nn.Linear(1, 1), torch.nn.Linear(1, 1))
    learner, draws = Averaging(share=0.5, parts={"0.*": 0.25, "*": 1.0}, base_tasks=0), torch.Generator()
    for p in found.parameters():
        p.data.fill_(0.0)
    learner.begin_task(0, Windows(0), found)
    for p in found.parameters():
        p.data.fill_(4.0)
    learner.end_task(0, Windows(0), found, draws)
    assert [p.item() for p in found.parameters()] == [1.0, 1.0, 4.0, 4.0]
    with pytest.raises(
        ConfigError, match=r"algo\.parts=\['wings'\] matches no weight of the policy, which has 0"
    ):
        Averaging(parts={"wings": 0.5}).begin_task(0, Windows(0), found)


def test_statistics_of_batch_normalisation_are_averaged_and_counts_are_not() -> None:
    found = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))
    learner, draws = Averaging(share=0.5, base_tasks=0), torch.Generator()
    learner.begin_task(0, Windows(0), found)
    found[1].running_mean.fill_(4.0)
    found[1].num_batches_tracked.fill_(7)
    learner.end_task(0, Windows(0), found, draws)
    assert found[1].running_mean.tolist() == [2.0, 2.0]
    assert found[1].num_batches_tracked == 7


def test_nothing_is_kept_from_task_to_task_but_a_number() -> None:
    learner, acting = Averaging(), policy()
    for task in range(2):
        learn(learner, acting, task)
    assert learner.state_dict() == {"tasks": 2, "before": None}
    learner.share = 1.0  # the start of a trial is shared with those of other shares
    learner.begin_task(2, Windows(2), acting)
    assert learner.before is not None
    check(learner.state_dict(), Averaging.state_form, "state", acting)
