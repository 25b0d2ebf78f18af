"""Which windows are replayed, which are kept, and that a memory holds no other frames."""

import gc
import weakref

import pytest
import torch

from lifelong.algorithms import MIR
from lifelong.algorithms.mir import interference
from lifelong.data.memory import FirstWindows, PhaseMemory, ReplayMemory
from lifelong.data.windows import (
    JoinedWindows,
    StageWindows,
    WindowSubset,
    frame_moments,
    frames_of,
    gripper_phases,
)
from lifelong.errors import ConfigError, DataError
from lifelong.seeding import generator
from tests.harness.algorithms import by_hand, learn_frames, make_policy
from tests.harness.fakes import LinearPolicy, Windows
from tests.harness.sequences import assert_same, dataset


class PerWindow(LinearPolicy):
    """Squared error of a linear map, of each window."""

    def window_losses(self, batch):
        out = self.linear(batch.observation.proprio["x"])
        return (out - batch.actions).square().sum(-1).flatten()


def errors(policy, weight, bias, data):
    return ((data.features @ weight.T + bias - data.targets) ** 2).sum(1)


def test_interference_is_what_a_gradient_step_adds_to_each_windows_loss():
    """Aljundi et al. 2019, section 3.1, worked by hand for a linear map: theta_v = theta - rate gradient."""
    torch.manual_seed(0)
    policy, new, old, rate = PerWindow(), Windows(0), Windows(1), 0.1
    weight, bias = (p.detach().clone() for p in policy.linear.parameters())
    error = new.features @ weight.T + bias - new.targets
    moved = weight - rate * by_hand(policy, new).mean(0).detach(), bias - rate * 2 * error.mean(0)
    expected = errors(policy, *moved, old) - errors(policy, weight, bias, old)
    rows = torch.arange(20)
    found = interference(policy, new.batch(rows), old.batch(rows), rate)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)
    assert torch.equal(policy.linear.weight, weight) and policy.linear.weight.grad is None

    algorithm = MIR(memory=ReplayMemory(20), ratio=0.25, candidates=4, rate=rate)  # all 20 are drawn
    algorithm.memory.add(old, generator(0))
    algorithm.mode_train(policy)
    mixed = algorithm.mix(new.batch(rows), generator(1))
    assert len(mixed) == 25 and torch.equal(mixed.window_ids[:20], rows)
    assert set(mixed.window_ids[20:].tolist()) == set(expected.topk(5).indices.tolist())


def test_mir_refuses_a_memory_that_says_how_many_windows_are_drawn():
    with pytest.raises(ConfigError, match=r"algo.memory.batch_size and algo.candidates both say"):
        MIR(memory=FirstWindows(10, batch_size=4))
    assert MIR(memory=FirstWindows(10)).candidates == 5


def test_frames_without_readings_have_their_actions():
    readings, actions = frames_of(dataset(0), ())
    assert readings.shape == (len(actions), 0) and len(frame_moments([(readings, actions)])[0]) == 7


def test_without_a_choice_mir_draws_as_er_does():
    policy, algorithm = make_policy(), MIR(memory=ReplayMemory(10), candidates=1)
    learn_frames(algorithm, policy, 0)
    algorithm.mode_train(policy)
    mixed = algorithm.mix(dataset(1).batch(torch.arange(4)), generator(3))
    drawn = algorithm.memory.sample(4, generator(3)).window_ids
    assert sorted(mixed.window_ids[4:].tolist()) == sorted(drawn.tolist())


def with_commands(commands, ends):
    """A dataset of frames with these commands of the gripper, and these last frames of demonstrations."""
    data, frames = dataset(0), len(commands)
    actions = torch.zeros(frames, 7)
    actions[:, -1] = torch.tensor(commands)
    starts = [0, *(end + 1 for end in ends[:-1])]
    last = torch.cat([torch.full((e - s + 1,), e) for s, e in zip(starts, ends, strict=True)])
    images = torch.randint(0, 256, (frames, *data.images.shape[1:]), generator=generator(5)).to(torch.uint8)
    proprio = {"x": torch.rand(frames, 2, generator=generator(6))}
    return type(data)(images, proprio, actions, last, data.language, 0, data.seq_len)


def test_phases_end_where_the_gripper_is_told_to_move():
    data = with_commands([-1.0, -1, 1, 1, -1, 1, 1, -1], [4, 7])
    assert gripper_phases(data).tolist() == [0, 0, 1, 1, 2, 0, 0, 1]
    chosen = torch.tensor([7, 2, 4])
    assert gripper_phases(WindowSubset(data, chosen)).tolist() == [1, 1, 2]
    assert gripper_phases(JoinedWindows([data, data])).tolist() == [0, 0, 1, 1, 2, 0, 0, 1] * 2
    with pytest.raises(DataError, match="Windows does not say where its demonstrations end"):
        gripper_phases(Windows(0))


@pytest.mark.parametrize(("budget", "counts"), [(6, [2, 2, 2]), (11, [5, 2, 4]), (20, [14, 2, 4])])
def test_a_memory_by_phase_has_as_many_windows_of_each(budget, counts):
    data = with_commands([-1.0] * 14 + [1.0] * 2 + [-1.0] * 4, [19])
    memory = PhaseMemory(budget)
    memory.add(data, generator(1))
    assert torch.bincount(gripper_phases(data)[memory.tasks[0]]).tolist() == counts
    later = dataset(1)
    memory.add(later, generator(2))
    kept = torch.bincount(gripper_phases(data)[memory.tasks[0]]).tolist()
    assert max(kept) - min(kept) <= 1 or kept[1] == 2  # still even, as far as there are windows


def test_candidates_are_no_copies_where_the_memory_has_enough_windows():
    algorithm, policy = MIR(memory=ReplayMemory(20)), PerWindow()
    algorithm.memory.add(Windows(1), generator(0))
    algorithm.mode_train(policy)
    for size, replayed in ((16, 16), (30, 20)):  # of 80 and of 150 candidates
        mixed = algorithm.mix(Windows(0, size=size).batch(torch.arange(size)), generator(1))
        assert len(mixed) == 2 * size and len(mixed.window_ids[size:].unique()) == replayed


@pytest.mark.parametrize("batch_size", [None, 3])
def test_the_first_windows_are_those_of_each_task_of_a_stage(batch_size):
    memory = FirstWindows(4, batch_size)
    memory.add(StageWindows([Windows(0), Windows(1, size=3), Windows(2)], 2), generator(0))
    memory.add(Windows(3), generator(0))
    blurred = StageWindows([WindowSubset(Windows(4), torch.arange(5, 20)), Windows(5, size=2)], 4)
    memory.add(blurred, generator(0))
    kept = {task: windows.tolist() for task, windows in memory.tasks.items()}
    assert kept == {2: [*range(4), *range(20, 23), *range(23, 27)], 3: [*range(4)], 4: [*range(4), 15, 16]}


STAGES = {
    "a task": lambda task: dataset(task),
    "a stage": lambda task: StageWindows([dataset(task), dataset(task + 5)], task),
    "a blurred stage": lambda task: StageWindows(
        [
            WindowSubset(dataset(task), torch.arange(0, 20, 3)),
            WindowSubset(dataset(task + 5), torch.arange(9)),
        ],
        task,
    ),
}


@pytest.mark.parametrize("make", STAGES.values(), ids=STAGES)
@pytest.mark.parametrize("memory", [ReplayMemory(7), ReplayMemory(12), PhaseMemory(9), FirstWindows(4)])
def test_a_memory_holds_the_frames_of_its_windows_only(make, memory):
    memory = type(memory)(memory.budget)
    sources = {task: make(task) for task in (1, 2, 3)}
    for task, source in sources.items():
        memory.add(source, generator(task))
    for task, held in memory._held.items():
        ids = memory.tasks[task]
        given, wanted = held.batch(torch.arange(len(held))), sources[task].batch(ids)
        assert_same(vars(given.observation), vars(wanted.observation))
        for name in ("actions", "task_ids", "window_ids", "is_pad"):
            assert torch.equal(getattr(given, name), getattr(wanted, name)), name
    held_sets = [held.dataset for held in memory._held.values()]
    sizes = [len(part) for one in held_sets for part in getattr(one, "datasets", (one,))]
    assert sum(sizes) == memory.count_frames() < 20 * 3
    whole = weakref.ref(sources[1])
    del sources, source, given, wanted
    gc.collect()
    assert whole() is None

    again = type(memory)(1)
    again.load_state_dict(memory.state_dict(), {task: make(task) for task in (1, 2, 3)})
    assert again.count_frames() == memory.count_frames()
    assert_same(*(vars(one.sample(9, generator(4)).observation) for one in (again, memory)))


def test_a_task_without_a_share_keeps_next_to_nothing():
    memory = ReplayMemory(1)
    for task in range(3):
        memory.add(dataset(task), generator(task))
    assert len(memory) == 1
    assert sum(len(held.dataset) for held in memory._held.values()) <= 3 * 3  # frames of a window
