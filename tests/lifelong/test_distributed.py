"""Data-parallel training: the losses of one process, equal weights on all ranks, and a common end."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from lifelong import checkpoints
from lifelong.errors import ConfigError
from lifelong.training.distributed import Ranks, process_group
from tests.harness import ranks_worker as worker

pytestmark = pytest.mark.usefixtures("uncounted")
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> tuple[Path, subprocess.CompletedProcess]:
    """Let two processes learn, of which the second is killed afterwards."""
    folder = tmp_path_factory.mktemp("two")
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    command += [worker.__file__, folder]
    env = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=600, check=False
    )
    return folder, done


@pytest.fixture(scope="module")
def learned(two) -> Path:
    folder, done = two
    assert {p.name for p in folder.glob("learned_*")} == {"learned_0", "learned_1"}, done.stderr
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("algo", worker.ALGORITHMS)
def test_two_processes_learn_as_one_with_the_same_batch(algo, learned, tmp_path):
    whole, _ = worker.learn(algo, tmp_path, Ranks())
    split = json.loads((learned / f"{algo}.json").read_text())
    assert len(split) >= worker.STEPS
    assert split == pytest.approx(whole, rel=1e-5)
    assert split[-1] != split[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "algo", [*worker.ALGORITHMS, *(f"{algo}-dropout" for algo in worker.CHANGING_GRADIENTS)]
)
def test_all_processes_end_with_the_same_weights(algo, learned):
    first, second = (checkpoints.load(learned / f"{algo}_{rank}.safetensors") for rank in (0, 1))
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


@pytest.mark.slow
def test_communication_between_processes(learned):
    assert {p.name for p in learned.glob("talked_*")} == {"talked_0", "talked_1"}


@pytest.mark.slow
def test_a_killed_process_ends_all(two, learned):
    _, done = two
    assert done.returncode != 0
    assert "another process of this run has ended" in done.stderr or "SIGKILL" in done.stderr
    assert not (learned / "went_on").exists()


@pytest.mark.parametrize("size", [1, 2, 3, 8])
@pytest.mark.parametrize("count", [1, 7, 32])
def test_every_row_belongs_to_one_rank_and_shares_are_even(size, count):
    rows = [range(count)[Ranks(rank, size).local_rows(count)] for rank in range(size)]
    assert [i for part in rows for i in part] == list(range(count))
    assert max(map(len, rows)) - min(map(len, rows)) <= 1


def test_a_single_process_communicates_with_nobody():
    value, made = torch.ones(3), []
    with process_group() as ranks:
        assert ranks == Ranks() and ranks.first
        ranks.barrier()
        assert ranks.broadcast(made.append, 5) is None and made == [5]
        assert torch.equal(ranks.sum(value), torch.ones(3))


def test_invalid_devices_are_named(monkeypatch):
    with pytest.raises(ConfigError, match="valid: auto, cpu, cuda"):
        Ranks().device("tpu")
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="no Metal device"):
        Ranks().device("mps")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert Ranks().device("auto") == torch.device("cpu")
    with pytest.raises(ConfigError, match="finds no GPU"):
        Ranks().device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for ranks, name in ((Ranks(2, 3, 2), "cuda"), (Ranks(0, 2, 0), "cuda:1")):
        with pytest.raises(ConfigError, match="need a GPU each"):
            ranks.device(name)
