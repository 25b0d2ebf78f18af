"""Learning on a GPU: on a pretended one, in processes of their own, and on a real one where there is one.

The pretended GPU computes on the CPU under CUDA's rules and counts what a GPU would be asked; see
`tests.harness.pretended_gpu`. What a step may ask at most is what it asked when this was written, and a tenth more.
"""

import json
import os
import shutil
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
PINNED = next(
    line.strip() for line in (ROOT / "constraints.txt").read_text().splitlines() if line.startswith("torch==")
)
# policy:algorithms; of none: all. Other algorithms do nothing there that they do not with the first.
LEARNED = (
    "bc_mlp_small",
    "bc_transformer:er,lwf,mlr,dmpel,clare",
    "bc_rnn:er,iscil",
    "bc_transformer_flow:er,lwf,dmpel",
    "bc_vilt:m2distill,lora",
)
# launches of a step, and of its augmentation
MOST = {"preset=paper": (1090, 95), "preset=paper,compat=libero": (835, 320)}
WAITS_OF_A_STEP = {"dmpel": 1}  # which experts count; of all others none
WAITS_OF_AN_ACTION = 4  # the action, and a mixture's three parameters
CHOICES_OF_AN_ACTION = {
    "iscil": 1,
    "clare": 15,
}  # of experts: once, and once for each layer that has a choice


@cache
def asked(device: str, *words: str) -> list[list]:
    """Run `tests.harness.gpu_learning` in a process of its own, and return what it prints of each command."""
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU")
    if device == "pretended" and torch.version.cuda is not None:
        pytest.skip("a GPU is pretended with PyTorch for CPUs")
    if device == "pretended" and torch.__version__.partition("+")[0] != PINNED.removeprefix("torch=="):
        pytest.skip(f"a GPU is pretended with {PINNED}")
    if device == "pretended" and shutil.which("g++") is None:
        pytest.skip("a GPU is pretended with g++")
    # on some virtual machines bfloat16 kills the process otherwise
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "ONEDNN_MAX_CPU_ISA": "AVX512_CORE_BF16"}
    command = [sys.executable, "-m", "tests.harness.gpu_learning", device, *words]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return [
        [json.loads(line) for line in part.splitlines() if line.startswith(("{", "0", "1"))]
        for part in done.stdout.split("--\n")
    ]


def pretended() -> list[list]:
    """Ask the pretended GPU for all that these tests need, in one process."""
    return asked("pretended", "learn", *LEARNED, "--", "step", *MOST, "--", "late", "--", "faults")


def test_learning_asks_of_a_gpu_what_it_can_do() -> None:
    found = pretended()[0]
    assert {learned["policy"] for learned in found} == {word.partition(":")[0] for word in LEARNED}
    for learned in found:
        name = learned["algorithm"]
        both = (learned["policy"], name)
        assert learned["unsafe"] == learned["waits_in_optimizers"] == learned["uploads_in_loss"] == [], both
        fresh, resumed = learned["waits"]
        assert max(len(fresh), len(resumed)) <= WAITS_OF_A_STEP.get(name, 0), (both, fresh, resumed)
        action = learned["waits_of_an_action"]
        assert len(action) <= WAITS_OF_AN_ACTION + CHOICES_OF_AN_ACTION.get(name, 0), (both, action)


def test_a_step_of_the_published_protocol_asks_no_more_of_a_gpu() -> None:
    for found, (launches, of_augmentation) in zip(pretended()[1], MOST.values(), strict=True):
        assert found["waits"] == []
        assert 500 < found["launches"] <= launches
        assert 50 < found["launches_of_augmentation"] <= of_augmentation


def test_the_pretended_gpu_finds_planted_faults() -> None:
    (found,) = pretended()[3]
    assert "same device" in found["mixed"] and "numpy" in found["numpy"] and "generator" in found["generator"]
    assert found["late"] == "1" and int(found["counters"]) > 0


@pytest.mark.gpu
@pytest.mark.parametrize("policy", ["bc_mlp_small"])  # has no dropout, which draws on the device
def test_a_gpu_learns_as_the_cpu(policy: str) -> None:
    on_gpu, on_cpu = (asked(device, "learn", policy)[0] for device in ("cuda", "cpu"))
    for ours, theirs in zip(on_gpu, on_cpu, strict=True):
        assert ours["losses"] == pytest.approx(theirs["losses"], rel=1e-2), ours["algorithm"]
        assert ours["waits_in_optimizers"] == [], ours["algorithm"]


@pytest.mark.parametrize("device", ["pretended", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_memories_of_windows_on_a_gpu_are_those_of_the_cpu(device: str) -> None:
    assert (pretended()[2] if device == "pretended" else asked(device, "late")[0]) == [0]
