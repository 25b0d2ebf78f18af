"""Windows equal a naive reference; memory keeps its budget; broken files are refused."""

import numpy as np
import pytest
import torch

from libero_env.demos.read import Episode
from lifelong.data import ReplayMemory, SequenceVLDataset, fake_batch
from lifelong.errors import DataError
from lifelong.types import PolicySpec

SPEC = PolicySpec(image_size=(6, 8), language_dim=4, seq_len=5)
LENGTHS = (7, 1, 4, 12)


def make_demo(name: str, steps: int, rng: np.random.Generator, spec: PolicySpec = SPEC) -> Episode:
    obs = {v: rng.integers(0, 256, (steps, *spec.image_size, 3), dtype=np.uint8) for v in spec.views}
    obs |= {k: rng.normal(size=(steps, d)) for k, d in spec.proprio.items()}
    actions = rng.uniform(-1, 1, (steps, spec.action_dim))
    return Episode(actions, np.zeros((steps, 0)), obs=obs, name=name)


def make_dataset(task_id: int = 0, lengths: tuple[int, ...] = LENGTHS, seed: int = 0) -> SequenceVLDataset:
    rng = np.random.default_rng(seed)
    demos = [make_demo(f"demo_{i}", n, rng) for i, n in enumerate(lengths)]
    return SequenceVLDataset.from_demos(demos, spec=SPEC, language=torch.arange(4.0), task_id=task_id)


def test_every_window_equals_a_naive_reference() -> None:
    rng = np.random.default_rng(3)
    demos = [make_demo(f"demo_{i}", n, rng) for i, n in enumerate(LENGTHS)]
    dataset = SequenceVLDataset.from_demos(demos, spec=SPEC, language=torch.arange(4.0), task_id=2)
    assert len(dataset) == sum(LENGTHS)
    assert dataset.demos == len(LENGTHS)
    batch = dataset.batch(torch.arange(len(dataset)))
    window = 0
    for demo in demos:
        for start in range(len(demo.actions)):
            for step in range(SPEC.seq_len):
                t = min(start + step, len(demo.actions) - 1)  # past the end the last frame repeats
                assert batch.padding()[window, step] == (start + step >= len(demo.actions))
                np.testing.assert_array_equal(batch.actions[window, step], demo.actions[t].astype(np.float32))
                for v, view in enumerate(SPEC.views):
                    np.testing.assert_array_equal(
                        batch.observation.images[window, step, v], demo.obs[view][t]
                    )
                for key in SPEC.proprio:
                    expected = demo.obs[key][t].astype(np.float32)
                    np.testing.assert_array_equal(batch.observation.proprio[key][window, step], expected)
            window += 1
    assert (batch.task_ids == 2).all()
    assert torch.equal(batch.window_ids, torch.arange(len(dataset)))
    assert torch.equal(batch.observation.language, torch.arange(4.0).expand(len(dataset), 4))


def test_padding_goes_with_its_windows() -> None:
    dataset = make_dataset()
    batch = dataset.batch(torch.arange(len(dataset)))
    last = batch.rows(torch.tensor([len(dataset) - 1, 0])).to("cpu")
    assert last.padding()[0].tolist() == [False] + [True] * (SPEC.seq_len - 1) and not last.padding()[1].any()
    unknown = fake_batch(SPEC, 1, torch.Generator().manual_seed(0))
    assert unknown.is_pad is None and unknown.join(unknown).is_pad is None
    unknown = type(last)(last.observation, last.actions, last.task_ids, last.window_ids)
    assert last.join(unknown).padding()[2:].any().item() is False
    assert torch.equal(unknown.join(last).padding()[2:], last.padding())


def test_a_batch_keeps_the_requested_order_and_is_a_copy() -> None:
    dataset = make_dataset()
    indices = torch.tensor([9, 0, 9, 3])
    batch = dataset.batch(indices)
    assert torch.equal(batch.window_ids, indices)
    assert torch.equal(batch.actions[0], batch.actions[2])
    before = dataset.images.clone()
    batch.observation.images.zero_()
    assert torch.equal(dataset.images, before)


@pytest.mark.parametrize("index", [-1, sum(LENGTHS)])
def test_window_indices_out_of_range_are_refused(index: int) -> None:
    with pytest.raises(DataError, match="must lie in"):
        make_dataset().batch(torch.tensor([0, index]))


@pytest.mark.parametrize(("change", "message"), [
    ({"image_size": (8, 8)}, r"agentview_rgb.*image_size"),
    ({"action_dim": 6}, r"actions is .*expected \(T, 6\)"),
    ({"proprio": {"ee_pos": 3}}, r"ee_pos is missing; it has"),
    ({"proprio": {"joint_states": 6}}, r"joint_states"),
    ({"language_dim": 5}, r"language"),
])  # fmt: skip
def test_demonstrations_that_do_not_fit_the_spec_are_refused(change: dict, message: str) -> None:
    demo = make_demo("demo_0", 3, np.random.default_rng(0))
    base = {"image_size": (6, 8), "language_dim": 4, "seq_len": 5}
    with pytest.raises(DataError, match=message):
        SequenceVLDataset.from_demos([demo], spec=PolicySpec(**(base | change)), language=torch.zeros(4))


@pytest.mark.parametrize("budget", [1, 7, 30, 1000])
def test_memory_is_never_over_budget_and_splits_it_evenly(budget: int) -> None:
    memory, generator = ReplayMemory(budget), torch.Generator().manual_seed(0)
    for task in range(5):
        memory.add(make_dataset(task), generator)
        assert len(memory) == min(budget, sum(LENGTHS) * (task + 1))
        assert max(memory.shares.values()) - min(memory.shares.values()) <= 1
        assert len(memory.sample(9, generator)) == 9


def test_shares_that_small_tasks_do_not_need_are_given_to_the_others() -> None:
    memory, generator = ReplayMemory(20), torch.Generator().manual_seed(0)
    memory.add(make_dataset(0, lengths=(3,)), generator)
    memory.add(make_dataset(1), generator)
    assert memory.shares == {0: 3, 1: 17}


def test_memory_is_a_uniform_sample_of_a_task_also_after_shrinking() -> None:
    counts, generator = torch.zeros(sum(LENGTHS)), torch.Generator().manual_seed(0)
    dataset, other = make_dataset(0), make_dataset(1)
    for _ in range(600):
        memory = ReplayMemory(12)
        memory.add(dataset, generator)
        memory.add(other, generator)
        counts[memory.state_dict()["indices"]["0"]] += 1
    expected = 600 * 6 / sum(LENGTHS)
    assert (counts - expected).abs().max() < 5 * expected**0.5


def test_samples_come_from_memory_without_repeats_while_it_lasts() -> None:
    memory, generator = ReplayMemory(10), torch.Generator().manual_seed(0)
    for task in range(3):
        memory.add(make_dataset(task, seed=task), generator)
    kept = {(int(t), int(w)) for t, ws in memory.state_dict()["indices"].items() for w in ws}
    batch = memory.sample(10, generator)
    drawn = list(zip(batch.task_ids.tolist(), batch.window_ids.tolist(), strict=True))
    assert set(drawn) == kept
    assert len(memory.sample(23, generator)) == 23


def test_memory_round_trip() -> None:
    datasets = {task: make_dataset(task, seed=task) for task in range(3)}
    memory, generator = ReplayMemory(11), torch.Generator().manual_seed(0)
    for dataset in datasets.values():
        memory.add(dataset, generator)
    other = ReplayMemory(1)
    other.load_state_dict(memory.state_dict(), datasets)
    draw = lambda m: m.sample(8, torch.Generator().manual_seed(5))  # noqa: E731
    assert torch.equal(draw(memory).observation.images, draw(other).observation.images)
    assert other.budget == 11
    with pytest.raises(DataError, match=r"tasks \[2\]"):
        other.load_state_dict(memory.state_dict(), {0: datasets[0], 1: datasets[1]})
    with pytest.raises(DataError, match="not those of the interrupted run"):
        other.load_state_dict(memory.state_dict(), datasets | {0: make_dataset(0, lengths=(1,))})
    assert torch.equal(draw(memory).actions, draw(other).actions)  # a failed load changes nothing
