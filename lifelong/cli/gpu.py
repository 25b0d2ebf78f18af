"""What `libero doctor --gpu` has PyTorch do on the GPU, each in a separate process: python -m lifelong.cli.gpu NAME."""

import sys
from dataclasses import replace
from functools import partial

import torch

from libero_env.health import COMPILE_SECONDS, Finding, run_probe
from lifelong.algorithms import Sequential
from lifelong.cli.runs import check_torch
from lifelong.data.dataset import SequenceVLDataset
from lifelong.data.fake import fake_observation
from lifelong.nn import DeterministicHead, ResNetFiLMEncoder
from lifelong.policies import BCMLP
from lifelong.seeding import seeded
from lifelong.training import FitSettings
from lifelong.training.fit import fit
from lifelong.types import PolicySpec

TOLERANCE = 1e-3  # relative, of losses on both devices
_SPEC = PolicySpec(image_size=(32, 32), seq_len=1)


def examine() -> list[Finding]:
    """Return findings about PyTorch on the GPU; the checks are left out where it does not see one."""
    seen = replace(check_torch(), essential=True)
    if not torch.cuda.is_available():
        return [replace(seen, ok=False)]
    return [seen, *(check(name, "cuda") for name in PROBES)]


def check(name: str, device: str) -> Finding:
    """Run one of the probes on a device."""
    done, text = run_probe(["-m", "lifelong.cli.gpu", name, device], COMPILE_SECONDS)
    _, remedy, essential = PROBES[name]
    return Finding(name, text, bool(done), remedy, essential)


def multiply_in_bf16(device: str) -> str:
    """Multiply matrices under autocast."""
    a = torch.eye(64, device=device)
    with torch.autocast(a.device.type, torch.bfloat16):
        product = a @ a
    if product.dtype != torch.bfloat16 or not torch.equal(product.float(), a):
        raise SystemExit("products under autocast are wrong")
    if a.is_cuda and not torch.cuda.is_bf16_supported(including_emulation=False):
        raise SystemExit("this GPU only emulates it")
    return "products are right"


def compile_kernel(device: str) -> str:
    """Compile a function."""
    x = torch.linspace(-3, 3, 1000, device=device)
    error = (torch.compile(lambda x: (x.sin() + 0.5).relu())(x) - (x.sin() + 0.5).relu()).abs().max()
    if not error < 1e-5:
        raise SystemExit(f"it differs from the function by {error:.0e}")
    return "equals the function"


def train_three_steps(device: str) -> str:
    """Train a small policy on both devices."""
    losses = [_loss("cpu"), _loss(device)]
    text = f"after three training steps the loss is {losses[1]:.6f}, on the processor {losses[0]:.6f}"
    if not abs(losses[1] - losses[0]) <= TOLERANCE * abs(losses[0]):
        raise SystemExit(text)
    return text


def copy_to_host(device: str) -> str:
    """Copy a batch to the host behind work that takes long, and read it at once."""
    expected = _windows().batch(torch.arange(16))
    batch, size = expected.to(device), 2 if device == "cpu" else 8192
    work = torch.ones(size, size, device=device)
    for _ in range(10):
        work = work @ work / size
    if not torch.equal(batch.to("cpu").actions, expected.actions):
        raise SystemExit("a batch was read before it had arrived")
    return "batches arrive before they are read"


PROBES = {  # what is run, the remedy, whether nothing works without it
    "bf16": (multiply_in_bf16, "train with train.precision=fp32", False),
    "compiled kernel": (compile_kernel, "leave train.compile unset; see PyTorch's notes on Triton", False),
    "training step": (train_three_steps, "report this; train with device=cpu", True),
    "copies to the host": (copy_to_host, "report this; train with data.memory=host", True),
}


def _windows() -> SequenceVLDataset:
    """Return 16 windows of two cameras."""
    draws = torch.Generator().manual_seed(0)
    seen = fake_observation(_SPEC, 16, draws)
    readings = {name: values[:, 0] for name, values in seen.proprio.items()}
    actions, last = torch.rand(16, 7, generator=draws) * 2 - 1, torch.full((16,), 15)
    return SequenceVLDataset(seen.images[:, 0], readings, actions, last, seen.language[0], 0, 1)


def _loss(device: str) -> float:
    """Return the loss of three training steps on a device."""
    encoder = partial(ResNetFiLMEncoder, width=8, stage_blocks=[1], stem_pool=False)
    head = partial(DeterministicHead, hidden=8, layers=1)
    with seeded(0):
        policy = BCMLP(spec=_SPEC, image_embed=8, text_embed=4, encoder=encoder, head=head).to(device)
    found: list[float] = []
    settings = FitSettings(epochs=1, steps_per_epoch=3, batch_size=8, precision="fp32")
    fit(
        policy,
        _windows().to(device),
        Sequential(),
        settings=settings,
        seed=(0,),
        on_epoch=lambda end: found.append(end.loss),
    )
    return found[-1]


if __name__ == "__main__":
    print(PROBES[sys.argv[1]][0](sys.argv[2]))
