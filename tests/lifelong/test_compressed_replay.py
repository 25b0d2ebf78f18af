"""What a memory of compressed frames promises, and replay from it."""

import io
from dataclasses import replace

import pytest
import torch
from PIL import Image

from lifelong import checkpoints
from lifelong.algorithms import ER, CompressedER
from lifelong.algorithms.base import load_algorithm
from lifelong.data import SequenceVLDataset
from lifelong.data.compressed import CompressedMemory, compress
from lifelong.data.memory import ReplayMemory
from lifelong.errors import CheckpointError, DataError
from lifelong.seeding import generator
from lifelong.streams import StageWindows
from lifelong.training.costs import stored_bytes
from lifelong.training.fit import fit
from tests.harness import sequences
from tests.harness.algorithms import SETTINGS
from tests.harness.policies import small_transformer

BUDGET = 27_000


class Gone(dict):
    """Datasets of demonstrations that do not exist any more."""

    def __missing__(self, task):
        raise AssertionError(f"the demonstrations of task {task} were read")


def scene(task: int, frames: int = 60, steps: int = 1, side: int = 32) -> SequenceVLDataset:
    """Smooth pictures of two views, in three demonstrations."""
    draws = generator(task, 7)
    coarse = torch.rand(frames * 2, 3, 4, 4, generator=draws)
    images = torch.nn.functional.interpolate(coarse, size=(side, side), mode="bilinear") * 255
    ends = torch.arange(frames) // (frames // 3) * (frames // 3) + frames // 3 - 1
    return SequenceVLDataset(
        images.byte().movedim(1, -1).view(frames, 2, side, side, 3).contiguous(),
        {"x": torch.randn(frames, 2, generator=draws)},
        torch.rand(frames, 7, generator=draws) * 2 - 1,
        ends.clamp(max=frames - 1),
        torch.randn(4, generator=draws),
        task,
        steps,
    )


def filled(tasks: int, budget: int = BUDGET, steps: int = 1, **settings) -> CompressedMemory:
    memory = CompressedMemory(budget, **settings)
    for task in range(tasks):
        memory.add(scene(task, steps=steps), generator(task))
    return memory


def original(batch, steps: int = 1):
    """Return the same windows from the demonstrations."""
    parts = [
        scene(int(t), steps=steps).batch(i[None])
        for t, i in zip(batch.task_ids, batch.window_ids, strict=True)
    ]
    return parts[0].join(*parts[1:])


# --- what is kept


@pytest.mark.parametrize("tasks", [1, 2, 5, 9])
@pytest.mark.parametrize("steps", [1, 5])
def test_the_bytes_never_exceed_the_budget_and_are_shared_evenly(tasks, steps):
    memory = filled(tasks, steps=steps)
    assert memory.nbytes() <= BUDGET
    sizes = [windows.nbytes() for windows in memory.tasks.values()]
    assert max(sizes) <= BUDGET // tasks
    next_window = 700 if steps == 1 else 2600  # bytes that it takes at most
    assert len(memory) == 60 or min(sizes) > BUDGET // tasks - next_window
    algorithm = CompressedER(budget=BUDGET)
    algorithm.memory = memory
    assert stored_bytes(algorithm) == memory.nbytes()  # what the records of costs say


@pytest.mark.parametrize("steps", [1, 4])
@pytest.mark.parametrize("keep_decoded", [True, False])
def test_windows_are_those_of_the_demonstrations_but_for_the_pictures(steps, keep_decoded):
    memory = filled(3, budget=60_000, steps=steps, keep_decoded=keep_decoded)
    batch = memory.sample(40, generator(1))
    kept = original(batch, steps)
    assert torch.equal(batch.actions, kept.actions)
    assert torch.equal(batch.padding(), kept.padding())
    assert torch.equal(batch.observation.proprio["x"], kept.observation.proprio["x"])
    assert torch.equal(batch.observation.language, kept.observation.language)
    assert torch.equal(batch.window_ids, kept.window_ids)
    assert batch.observation.images.shape == kept.observation.images.shape
    assert batch.observation.images.dtype == torch.uint8
    error = (batch.observation.images.float() - kept.observation.images.float()).abs()
    assert error.mean() < 8  # of 255
    assert error.flatten(1).mean(1).max() < 16
    other = (batch.observation.images.float() - kept.observation.images.flip(2).float()).abs()
    assert other.flatten(1).mean(1).min() > 30  # had the views been exchanged


def test_a_better_quality_has_a_smaller_error_and_more_bytes():
    errors, sizes = [], []
    for quality in (10, 50, 95):
        windows = compress(scene(0), torch.arange(60), 10**6, quality)
        seen = windows.pictures(torch.arange(60)).float()
        errors.append(float((seen - scene(0).images.float()).square().mean()))
        sizes.append(windows.nbytes())
    assert errors == sorted(errors, reverse=True) and sizes == sorted(sizes)


def test_neighbouring_windows_share_their_frames():
    windows = filled(2, budget=100_000, steps=5).tasks[0]
    assert len(windows) == 60 and len(windows.ends) == 60
    short = filled(6, budget=20_000, steps=5).tasks[0]
    assert 4 < len(short) < 60
    assert len(short.ends) < 2.5 * len(short)  # of five steps


def test_a_smaller_share_is_a_prefix_of_the_larger_one():
    many, few = filled(2).tasks[0], filled(6).tasks[0]
    assert 0 < len(few) < len(many)
    assert torch.equal(few.window_ids, many.window_ids[: len(few)])
    assert torch.equal(few.codes, many.codes[: len(few.codes)])


def test_every_window_is_as_likely_to_be_kept():
    counts = torch.zeros(60)
    for seed in range(60):
        memory = CompressedMemory(4_000)
        memory.add(scene(0), generator(seed))
        counts[memory.tasks[0].window_ids.long()] += 1
    share = float(counts.sum() / 60 / 60)
    spread = (60 * share * (1 - share)) ** 0.5
    assert 0.02 < share < 0.5
    assert (counts - 60 * share).abs().max() < 4.5 * spread


def test_draws_are_uniform_over_what_is_held_and_depend_on_the_generator_alone():
    memory = filled(3)
    drawn = memory.sample(len(memory), generator(3))
    held = {(task, int(i)) for task, windows in memory.tasks.items() for i in windows.window_ids}
    assert {(int(t), int(i)) for t, i in zip(drawn.task_ids, drawn.window_ids, strict=True)} == held
    again = filled(3).sample(len(memory), generator(3))
    sequences.assert_same(vars(again.observation), vars(drawn.observation))
    assert not torch.equal(memory.sample(len(memory), generator(4)).window_ids, drawn.window_ids)


def test_instructions_of_tasks_that_are_learned_together_stay_apart():
    joined = StageWindows([scene(0), scene(1)], 1)
    memory = CompressedMemory(200_000)
    memory.add(joined, generator(0))
    batch = memory.sample(120, generator(1))
    expected = joined.batch(batch.window_ids).observation.language
    assert torch.equal(batch.observation.language, expected)
    assert len(memory.tasks[1].languages) == 2


def test_a_share_without_a_window_is_refused_and_says_what_to_change():
    with pytest.raises(
        DataError, match=r"raise algo.budget \(600\), or lower algo.quality or data.image_size"
    ):
        filled(2, budget=600)
    memory = filled(1)
    with pytest.raises(DataError, match="task 0 is in the memory already"):
        memory.add(scene(0), generator(0))
    with pytest.raises(DataError, match="the memory is empty"):
        CompressedMemory(BUDGET).sample(1, generator(0))


def test_a_policy_without_cameras_has_no_pictures():
    blind = replace(scene(0), images=torch.empty(60, 0, 32, 32, 3, dtype=torch.uint8))
    memory = CompressedMemory(BUDGET)
    memory.add(blind, generator(0))
    other = CompressedMemory(1)
    other.load_state_dict(memory.state_dict())
    batch = other.sample(5, generator(0))
    assert batch.observation.images.shape == (5, 1, 0, 32, 32, 3)
    assert torch.equal(batch.actions, blind.batch(batch.window_ids).actions)


# --- its state


def test_the_state_holds_the_frames_and_no_demonstration_is_read(tmp_path):
    algorithm = CompressedER(budget=BUDGET)
    algorithm.memory = filled(3)
    checkpoints.save(tmp_path / "s", algorithm.state_dict())
    other = CompressedER(budget=1)
    load_algorithm(other, checkpoints.load(tmp_path / "s"), Gone(), None, tmp_path / "s")
    assert other.memory.nbytes() == algorithm.memory.nbytes() and other.memory.budget == BUDGET
    sequences.assert_same(other.state_dict(), algorithm.state_dict())
    a, b = (x.memory.sample(9, generator(2)).observation.images for x in (algorithm, other))
    assert torch.equal(a, b)
    for memory in (algorithm.memory, other.memory):
        memory.add(scene(3), generator(5))
    sequences.assert_same(other.state_dict(), algorithm.state_dict())


BREAK = {
    "frames": lambda windows: windows["frames"][0, 0].fill_(10**6),
    "ends": lambda windows: windows["ends"][1].fill_(0),
    "instruction": lambda windows: windows["language_ids"][0].fill_(-1),
    "actions": lambda windows: windows.update(actions=windows["actions"][1:]),
    "task": lambda windows: windows.update(task_id=4),
    "kind": lambda windows: windows.update(codes=windows["codes"].float()),
}


@pytest.mark.parametrize("change", BREAK.values(), ids=BREAK)
def test_a_state_whose_parts_do_not_fit_is_refused(change, tmp_path):
    algorithm = CompressedER(budget=BUDGET)
    algorithm.memory = filled(1)
    checkpoints.save(tmp_path / "s", algorithm.state_dict())
    state = checkpoints.load(tmp_path / "s")
    change(state["memory"]["tasks"][0])
    with pytest.raises(CheckpointError, match="s: the compressed windows of task"):
        load_algorithm(CompressedER(), state, Gone(), None, tmp_path / "s")


def test_a_picture_of_another_kind_or_size_is_refused():
    windows = filled(1).tasks[0]
    size = windows.ends[0].item()
    for file_format, shape in (("PNG", (64, 32)), ("WEBP", (16, 16))):
        file = io.BytesIO()
        Image.new("RGB", shape[::-1]).save(file, file_format)
        code = torch.frombuffer(bytearray(file.getvalue()), dtype=torch.uint8)
        other = replace(
            windows, codes=torch.cat([code, windows.codes[size:]]), ends=windows.ends + len(code) - size
        )
        with pytest.raises(DataError, match="expected 32 x 64 pixels"):
            other.pictures(torch.tensor([0]))
        assert other.pictures(torch.tensor([1])).shape == (1, 2, 32, 32, 3)


# --- replay from it


def test_the_batch_is_followed_by_ratio_times_as_many_earlier_windows():
    algorithm, batch = CompressedER(budget=BUDGET, ratio=0.5), scene(1).batch(torch.arange(8))
    assert algorithm.mix(batch, generator(0)) is batch
    algorithm.end_task(0, scene(0), None, generator(0))
    mixed = algorithm.mix(batch, generator(0))
    assert mixed.task_ids.tolist() == [1] * 8 + [0] * 4
    assert torch.equal(mixed.observation.images[:8], batch.observation.images)


def test_with_a_large_budget_it_is_experience_replay_but_for_the_pictures():
    """With pictures of one colour, which are the same after compression, both learn the same weights."""
    spec = replace(sequences.SPEC, seq_len=1)
    flat = []
    for task in range(2):
        data = scene(task, side=16)
        grey = torch.full_like(data.images[:, :1], 40 * task + 16)
        flat.append(replace(data, images=grey))
    learned = []
    for algorithm in (ER(memory=ReplayMemory(60)), CompressedER(budget=10**6, quality=100)):
        torch.manual_seed(0)
        policy = small_transformer(spec, "deterministic", dropout=0.0)
        for task, dataset in enumerate(flat):
            fit(policy, dataset, algorithm, settings=SETTINGS, seed=(task,))
            algorithm.end_task(task, dataset, policy, generator(task))
        learned.append(policy.state_dict())
    assert learned[0].keys() == learned[1].keys()
    close = [torch.allclose(v, learned[1][n], atol=2e-3) for n, v in learned[0].items()]
    assert all(close)
