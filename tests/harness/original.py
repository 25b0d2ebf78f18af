"""LIBERO's policies and ours with the same weights: the map of names, the process that runs LIBERO's code.

Every tensor of ours is one of theirs up to its shape and the order of its entries. The orders differ where entries
have none of their own: of a token's entries, sine and cosine codes alternate here and lie in two halves there; scale
and shift of FiLM are swapped; keypoints are (x, y) pairs here and all rows, then all columns there; the LSTM reads the
instruction before the proprioception here and after it there.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.policies.base import Policy
from lifelong.settings import build
from lifelong.types import Batch, Observation, PolicySpec
from tests.harness.configs import composed

SPEC = PolicySpec(language_dim=768, seq_len=10)  # of the published runs
QUICK = PolicySpec(language_dim=768, seq_len=4, image_size=(64, 64))  # the same networks on smaller pictures
POLICIES = ("bc_transformer", "bc_rnn", "bc_vilt")
SCRIPT = Path(__file__).parent / "peer_scripts" / "original_learning.py"
MISSING = (
    "LIBERO's code is not at hand: set LIBERO_ORIGINAL_SOURCE to a checkout of Lifelong-Robot-Learning/LIBERO and "
    "LIBERO_ORIGINAL_PYTHON to an interpreter with its packages (experiments/paper/README.md says which)"
)


@dataclass(frozen=True)
class Entry:
    """A tensor of ours and its counterpart.

    Attributes:
        ours: Its name here.
        theirs: Its name there.
        orders: By axis, which of our entries are theirs, in their order.
        shape: Their shape, where it is another.
    """

    ours: str
    theirs: str
    orders: tuple[tuple[int, Tensor], ...] = ()
    shape: tuple[int, ...] | None = None

    def to_theirs(self, value: Tensor) -> Tensor:
        """Return our tensor as theirs."""
        for axis, order in self.orders:
            value = value.index_select(axis, order)
        return value if self.shape is None else value.reshape(self.shape)

    def to_ours(self, value: Tensor, shape: torch.Size) -> Tensor:
        """Return their tensor as ours."""
        value = value.reshape(shape)
        for axis, order in self.orders:
            value = value.index_select(axis, order.argsort())
        return value


def halves(size: int) -> Tensor:
    """Return the order of (even entries, odd entries)."""
    return torch.cat([torch.arange(0, size, 2), torch.arange(1, size, 2)])


TOKEN = halves(64)  # entries of a token over time


def name_map(policy: Policy, name: str) -> list[Entry]:
    """Return the entries of all weights and running statistics of a policy of the original's sizes."""
    entries = [entry for view in range(2) for entry in _encoder(policy, name, view)]
    if name == "bc_rnn":
        entries += _linear("language.linear", "language_encoder.projection.0")
        entries += _rnn(policy)
        return entries + _head(policy, None)
    rows = ((0, TOKEN),)
    theirs = "language_encoder" if name == "bc_transformer" else "language_encoder_temporal"
    entries += _linear("language.linear", f"{theirs}.projection.0", rows)
    for number, reading in enumerate(("joint_states", "gripper_states")):
        entries += _linear(f"proprio.linears.{reading}", f"extra_encoder.encoders.{number}.0", rows)
    entries += _layers("transformer", "temporal_transformer", 4, TOKEN)
    if name == "bc_vilt":
        entries += _linear("spatial_language.linear", "language_encoder_spatial.projection.0")
        entries += _linear("spatial.project", "spatial_down_sample", rows)
        entries += _layers("spatial", "spatial_transformer", 7, None)
        parts = {"read": "spatial_token", "positions": "patch_pos_embed", "modalities": "modality_embed"}
        for ours, there in parts.items():
            entries.append(Entry(f"spatial.{ours}", there, shape=(1, -1, 128)))
    return entries + _head(policy, TOKEN)


def _linear(ours: str, theirs: str, orders: tuple = (), shape: tuple[int, ...] | None = None) -> list[Entry]:
    """Return the entries of a layer with weight and bias; the bias has the rows' order."""
    rows = tuple(pair for pair in orders if pair[0] == 0)
    weight = Entry(f"{ours}.weight", f"{theirs}.weight", orders, shape)
    return [weight, Entry(f"{ours}.bias", f"{theirs}.bias", rows)]


def _norm(ours: str, theirs: str) -> list[Entry]:
    names = ("weight", "bias", "running_mean", "running_var")
    return [Entry(f"{ours}.{n}", f"{theirs}.{n}") for n in names]


def _encoder(policy: Policy, name: str, view: int) -> Iterator[Entry]:
    ours, theirs = f"encoders.{policy.spec.views[view]}", f"encoders.{view}"
    if name == "bc_vilt":
        yield Entry(f"{ours}.stem.0.weight", f"{theirs}.conv.0.weight")
        yield from _norm(f"{ours}.stem.1", f"{theirs}.conv.1")
        yield from _linear(f"{ours}.project", f"{theirs}.proj")
        yield from _norm(f"{ours}.norm", f"{theirs}.bn")
        return
    yield Entry(f"{ours}.stem.0.weight", f"{theirs}.resnet18_base.0.weight")
    yield from _norm(f"{ours}.stem.1", f"{theirs}.resnet18_base.1")
    for number in range(4):
        block, there = f"{ours}.blocks.{number}", f"{theirs}.block_{number + 1}"
        for part in (1, 2):
            yield Entry(f"{block}.conv{part}.weight", f"{there}.conv{part}.weight")
            yield from _norm(f"{block}.norm{part}", f"{there}.bn{part}")
        if number == 2:
            yield Entry(f"{block}.shortcut.0.weight", f"{there}.downsample.0.weight")
            yield from _norm(f"{block}.shortcut.1", f"{there}.downsample.1")
        channels = 64 if number < 2 else 128
        swapped = torch.arange(2 * channels).roll(channels)
        film = f"{ours}.films.{number}.project"
        yield from _linear(film, f"{theirs}.lang_proj{number + 1}", ((0, swapped),))
    softmax = f"{theirs}.projection_layer.spatial_softmax._spatial_conv"
    yield from _linear(f"{ours}.readout.heat", softmax, shape=(32, 128, 1, 1))
    orders: tuple = ((1, halves(64).roll(32)),)  # rows are y, columns x
    if name == "bc_transformer":
        orders = ((0, TOKEN), *orders)
    yield from _linear(f"{ours}.project", f"{theirs}.projection_layer.projection", orders)


def _layers(ours: str, theirs: str, count: int, order: Tensor | None) -> list[Entry]:
    rows = () if order is None else ((0, order),)
    columns = () if order is None else ((1, order),)
    entries = []
    for number in range(count):
        here, there = f"{ours}.layers.{number}", f"{theirs}.layers.{number}"
        entries += _linear(f"{here}.attention_norm", f"{there}.0.norm", rows)
        entries.append(Entry(f"{here}.qkv.weight", f"{there}.1.qkv.weight", columns))
        entries += _linear(f"{here}.out", f"{there}.1.output_layer.0", rows)
        entries += _linear(f"{here}.mlp_norm", f"{there}.2.norm", rows)
        entries += _linear(f"{here}.mlp.0", f"{there}.3.net.0", columns)
        entries += _linear(f"{here}.mlp.3", f"{there}.3.net.3", rows)
    return entries


def _rnn(policy: Policy) -> list[Entry]:
    images, language, readings = torch.arange(128 + 32 + 9).split([128, 32, 9])
    order = torch.cat([images, readings, language])
    names = [n for n, _ in policy.named_parameters() if n.startswith("rnn.")]
    return [Entry(n, n, ((1, order),) if n == "rnn.weight_ih_l0" else ()) for n in names]


def _head(policy: Policy, order: Tensor | None) -> list[Entry]:
    columns = () if order is None else ((1, order),)
    entries = _linear("head.trunk.0", "policy_head.share.0", columns)
    for ours, theirs in (("trunk.2", "share.2"), ("trunk.4", "share.4"), ("means", "mean_layer")):
        entries += _linear(f"head.{ours}", f"policy_head.{theirs}")
    entries += _linear("head.stds", "policy_head.logstd_layer")
    return entries + _linear("head.logits", "policy_head.logits_layer")


# --- the same weights and the same batch


def our_policy(name: str, spec: PolicySpec = SPEC, dropout: bool = False) -> Policy:
    """Return a policy as `preset=paper compat=libero` builds it, with weights that are the same everywhere."""
    config = composed("preset=paper", "compat=libero", f"policy={name}")
    for part in ("temporal", "spatial"):
        if not dropout and part in config.policy:
            config.policy[part].dropout = 0.0
        if not dropout and "drop_path" in config.policy.get(part, {}):
            config.policy[part].drop_path = 0.0
    policy: Policy = build(config.policy, spec=spec)
    fill(policy)
    return policy


@torch.no_grad()
def fill(policy: Policy) -> None:
    """Give all weights and running statistics numbers of a size that keeps features alive, the same everywhere."""
    draws = np.random.RandomState(0)
    tensors = {n: t for n, t in policy.state_dict().items() if t.is_floating_point()}
    for name in sorted(tensors):
        t = tensors[name]
        drawn = torch.from_numpy(draws.standard_normal(tuple(t.shape))).to(t.dtype)
        if name.endswith("running_var"):
            t.copy_(1 + 0.5 * drawn.tanh())
        elif t.dim() == 1 and name.endswith("weight"):  # of norms
            t.copy_(1 + 0.1 * drawn)
        elif t.dim() == 1:
            t.copy_(0.1 * drawn)
        else:
            t.copy_(drawn / t[0].numel() ** 0.5)


def smooth_batch(spec: PolicySpec, number: int, windows: int = 2, steps: int | None = None) -> Batch:
    """Return a batch of smooth pictures, readings and actions, the same everywhere.

    The first seeds were chosen for gradients that float32 determines: computed with other kernels they are the same to
    1e-4. Where a unit is at the kink of a ReLU, rounding decides about its share of the gradient.
    """
    draws, steps = np.random.RandomState(106 + number), steps or spec.seq_len
    coarse = torch.from_numpy(draws.random_sample((windows * 2, 3 * steps, 8, 8)))
    smooth = torch.nn.functional.interpolate(coarse, size=spec.image_size, mode="bilinear")
    smooth = smooth.view(windows, 2, steps, 3, *spec.image_size).permute(0, 2, 1, 4, 5, 3)

    def real(*size: int) -> Tensor:
        return torch.from_numpy(draws.standard_normal(size)).float()

    images = (255 * smooth).round().to(torch.uint8).contiguous()
    readings = {name: real(windows, steps, size) for name, size in spec.proprio.items()}
    observation = Observation(images, readings, real(windows, spec.language_dim).tanh())
    ids = torch.arange(windows)
    return Batch(observation, real(windows, steps, spec.action_dim).tanh(), torch.zeros_like(ids), ids)


def with_images(batch: Batch, images: Tensor) -> Batch:
    """Return a batch with other pictures."""
    return replace(batch, observation=replace(batch.observation, images=images))


def our_algorithm(name: str) -> Algorithm:
    """Return an algorithm as `preset=paper compat=libero` builds it."""
    return build(composed("preset=paper", "compat=libero", f"algo={name}").algo)


# --- the process that runs LIBERO's code


def original() -> tuple[Path, Path]:
    """Return the interpreter and the checkout of LIBERO's code, or skip the test that asks."""
    source = os.environ.get("LIBERO_ORIGINAL_SOURCE")
    python = os.environ.get("LIBERO_ORIGINAL_PYTHON", sys.executable)
    if not source or not (Path(source) / "libero" / "lifelong" / "models" / "modules").is_dir():
        pytest.skip(MISSING)
    return Path(python), Path(source)


def run_original(
    policy: Policy, name: str, parts: str, given: Mapping[str, Batch], **values: np.ndarray
) -> dict[str, np.ndarray]:
    """Run parts of `original_learning.py`, its functions, with a policy's weights; return what it found.

    `given` are batches by the names that the parts have for them, and `values` what else they need.
    """
    python, source = original()
    tensors = policy.state_dict()
    job: dict[str, np.ndarray] = {"parts": np.array(parts), "policy": np.array(name), **values}
    job["seq_len"], job["columns"] = np.array(policy.spec.seq_len), TOKEN.numpy()
    for entry in name_map(policy, name):
        job[f"weight/{entry.theirs}"] = entry.to_theirs(tensors[entry.ours]).contiguous().numpy()
    for label, batch in given.items():
        seen = batch.observation
        job[f"{label}/images"] = seen.images.flip(3).numpy()  # bottom row first
        job |= {f"{label}/{n}": v.numpy() for n, v in seen.proprio.items()}
        job |= {f"{label}/language": seen.language.numpy(), f"{label}/actions": batch.actions.numpy()}
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder) / "job.npz", Path(folder) / "found.npz"
        np.savez(files[0], **job)
        command = [str(python), "-W", "ignore", str(SCRIPT), str(source), *map(str, files)]
        clean = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")} | {"OMP_NUM_THREADS": "1"}
        done = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False, env=clean)
        assert done.returncode == 0, f"{done.stdout[-2000:]}\n{done.stderr[-6000:]}"
        with np.load(files[1]) as stored:
            return dict(stored)


def in_our_names(policy: Policy, name: str, found: Mapping[str, np.ndarray], kind: str) -> dict[str, Tensor]:
    """Return their tensors of a kind under our names, in our shapes and orders."""
    shapes = {n: t.shape for n, t in policy.state_dict().items()}
    start = f"{kind}/"
    given = {n.removeprefix(start): torch.as_tensor(t) for n, t in found.items() if n.startswith(start)}
    entries = [entry for entry in name_map(policy, name) if entry.theirs in given]
    return {entry.ours: entry.to_ours(given[entry.theirs], shapes[entry.ours]) for entry in entries}
