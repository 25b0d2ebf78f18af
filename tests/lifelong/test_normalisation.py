"""What policies normalise readings by: constants, or statistics of tasks that the run chooses."""

from dataclasses import replace

import pytest
import torch

from lifelong.algorithms import Averaging, Sequential, SingleTask
from lifelong.errors import PolicyError
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from tests.harness.policies import small_mlp, small_transformer
from tests.harness.sequences import SPEC, dataset, run_context, sequence

pytestmark = pytest.mark.usefixtures("uncounted")
COUNTED = {"first": [0], "latest": [2], "seen": [0, 1, 2], "stream": [0, 1, 2]}
EVAL = EvalSettings(episodes=1, curve="none", select="last", cells="diagonal", horizon=2, precision="fp32")


def context(path, kind, make=small_transformer, spec=SPEC, algorithm=Sequential):
    plain = run_context(path, algorithm)
    data = replace(plain.data, statistics=kind)
    policy = make(replace(spec, measured=data.spec(4).measured))
    return replace(plain, policy=policy, data=data, eval=EVAL, fit=replace(plain.fit, epochs=1))


def readings(tasks):
    return torch.cat([dataset(task).proprio["x"] for task in tasks])


def scaling(policy):
    return getattr(policy.proprio, "scaling", policy.proprio)


@pytest.mark.parametrize("make", [small_transformer, small_mlp])
@pytest.mark.parametrize(("kind", "tasks"), COUNTED.items())
def test_readings_are_normalised_by_the_tasks_that_count(tmp_path, kind, tasks, make):
    made, taken = context(tmp_path, kind, make), []
    normalise = made.policy.normalise
    noted = lambda: taken.append(scaling(made.policy).centre_x.clone())  # noqa: E731
    made.policy.normalise = lambda *a, **k: (normalise(*a, **k), noted())
    sequence(made).run()
    found = scaling(made.policy)
    torch.testing.assert_close(found.centre_x, readings(tasks).mean(0))
    torch.testing.assert_close(found.scale_x, readings(tasks).std(0, unbiased=False))
    first = readings([0, 1, 2] if kind == "stream" else [0]).mean(0)
    torch.testing.assert_close(taken[0], first)  # only `stream` knows of what is to come
    again = context(tmp_path / "again", kind, make).policy
    saved = made.directory.checkpoints
    again.load_state_dict(saved.load_task(saved.task_path(2))["policy"])
    assert torch.equal(scaling(again).centre_x, found.centre_x) and bool(scaling(again).taken)
    normalised = scaling(again)({"x": readings(tasks)})["x"]
    assert normalised.mean().abs() < 1e-4


@pytest.mark.parametrize("kind", ["first", "stream"])
def test_a_policy_that_was_pretrained_keeps_its_first_statistics_but_takes_those_of_the_stream(
    tmp_path, kind
):
    made = context(tmp_path, kind)
    made.policy.normalise(torch.full((4, 9), 3.0), once=True)
    sequence(made).run()
    expected = torch.full((2,), 3.0) if kind == "first" else readings([0, 1, 2]).mean(0)
    torch.testing.assert_close(scaling(made.policy).centre_x, expected)


def test_by_default_nothing_is_measured_or_stored(tmp_path):
    made = context(tmp_path, None)
    assert not any("proprio.scaling" in name for name in made.policy.state_dict())
    sequence(made).run()
    assert scaling(made.policy).centre_x.tolist() == [0.0, 0.0]


def test_what_does_not_vary_keeps_its_size_and_contradictions_are_refused(tmp_path):
    made = context(tmp_path, "first")
    made.policy.normalise(torch.zeros(4, 9), once=False)
    assert scaling(made.policy).scale_x.tolist() == [1.0, 1.0]
    with pytest.raises(PolicyError, match="normalise_proprio=false leaves readings .* and data.statistics"):
        small_transformer(replace(SPEC, measured=True), normalise_proprio=False)
    with pytest.raises(PolicyError, match=r"BCTransformer has no normalise.*set data.statistics=constants"):
        Policy.normalise(made.policy, torch.zeros(4, 9), once=True)


@pytest.mark.parametrize(("kind", "tasks"), COUNTED.items())
def test_going_back_to_the_first_weights_keeps_the_statistics(tmp_path, kind, tasks):
    made = context(tmp_path, kind, algorithm=SingleTask)
    sequence(made).run()
    torch.testing.assert_close(scaling(made.policy).centre_x, readings(tasks).mean(0))


def test_averages_keep_the_statistics_of_the_new_task(tmp_path):
    made = context(tmp_path, "latest", algorithm=lambda: Averaging(share=0.5))
    sequence(made).run()
    torch.testing.assert_close(scaling(made.policy).centre_x, readings([2]).mean(0))
