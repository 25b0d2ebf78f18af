"""What ours finds for the weights and batches that LIBERO's code gets too, in the shapes of `original_learning.py`."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import Tensor

from lifelong.algorithms.base import Algorithm
from lifelong.data.windows import JoinedWindows
from lifelong.nn.transformer import TemporalTransformer
from lifelong.policies.base import Policy
from lifelong.seeding import generator
from lifelong.settings import build
from lifelong.training.fit import learning_rate
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step
from lifelong.types import Batch
from tests.harness import original
from tests.harness.algorithms import frame
from tests.harness.configs import composed

Found = dict[str, Tensor]
ROUNDING = 1e-7  # of all tensors' norm: below it a gradient is zero but for rounding


def fit_settings() -> FitSettings:
    """Return the settings of training of `preset=paper compat=libero`."""
    return build(composed("preset=paper", "compat=libero").train)


def one_step(policy: Policy, batch: Batch, algorithm: Algorithm) -> float:
    """Make one step as training does, at the first learning rate; return the policy's loss."""
    settings = fit_settings()
    sizes = {"lr": settings.lr, "betas": tuple(settings.betas), "weight_decay": settings.weight_decay}
    optimizer = torch.optim.AdamW(algorithm.trained(policy), **sizes)
    algorithm.mode_train(policy)
    loss, _ = Step(policy, algorithm, optimizer, settings)(batch, generator(0))
    return loss.item()


def gradients(policy: Policy) -> Found:
    """Return copies of all gradients; zero where there is none."""
    named = policy.named_parameters()
    return {n: torch.zeros_like(p) if p.grad is None else p.grad.clone() for n, p in named}


def weights(policy: Policy) -> Found:
    """Return copies of weights and running statistics."""
    return {n: t.clone() for n, t in policy.state_dict().items()}


def projections(found: Found) -> np.ndarray:
    """Return each tensor's product with four fixed vectors of 1 and -1, (tensors by name, 4) float32.

    A difference d of a tensor moves them by about its norm, whatever its direction.
    """
    rows = []
    for name in sorted(found):
        signs = np.random.default_rng(zlib.crc32(name.encode())).integers(0, 2, (4, found[name].numel()))
        rows.append((2.0 * signs - 1) @ found[name].double().flatten().numpy())
    return np.array(rows, dtype=np.float32)


def kept_of(found: Found) -> dict[str, np.ndarray]:
    """Return what is recorded of tensors: their names, norms and projections."""
    names = sorted(found)
    norms = np.array([found[n].double().norm() for n in names], dtype=np.float32)
    return {"names": np.array(names), "norms": norms, "projections": projections(found)}


def measure(policy: Policy, first: Batch, episode: Batch) -> dict:
    """Return losses, gradients, the distributions of actions over an episode, and the learning rates of 50 epochs."""
    fresh, found = weights(policy), {}
    with torch.no_grad():
        found["eval_loss"] = policy.eval().loss(first)
    found |= acts(policy, episode)
    loss = policy.train().loss(first)
    loss.backward()
    found["loss"], found["gradient"] = loss.detach(), gradients(policy)
    settings, steps = fit_settings(), 7
    rates = [learning_rate(e * steps + 3, 50 * steps, settings, e * steps) for e in range(50)]
    found["rates"] = torch.tensor([*rates, settings.lr_min], dtype=torch.float64)
    policy.load_state_dict(fresh)
    return found


def learn(policy: Policy, first: Batch, episode: Batch) -> dict:
    """Return what `measure` does, and gradients and weights after a step of training."""
    fresh, found = weights(policy), measure(policy, first, episode)
    found["loss"] = torch.tensor(one_step(policy, first, original.our_algorithm("sequential")))
    found["clipped"], found["stepped"] = gradients(policy), weights(policy)
    policy.load_state_dict(fresh)
    return found


@torch.no_grad()
def acts(policy: Policy, episode: Batch) -> Found:
    """Return the distribution of the action at each frame, as the policy acts."""
    policy.eval().reset(len(episode))
    steps = episode.actions.shape[1]
    params = [policy.step(frame(episode.observation, step)) for step in range(steps)]
    joined = {name: torch.stack([p[name] for p in params], 1) for name in params[0]}
    return {
        "act_means": joined["means"].flatten(0, 1).view(len(episode), -1, *joined["means"].shape[-2:]),
        "act_stds": joined["stds"],
        "act_logits": joined["logits"].log_softmax(-1),
    }


@contextmanager
def shared_draws(seed: int) -> Iterator[None]:
    """Let dropout draw from the generator that `original_learning.py` has."""
    draws = np.random.RandomState(seed)
    dropout, bernoulli = torch.nn.functional.dropout, Tensor.bernoulli_

    def drop(x: Tensor, p: float = 0.5, training: bool = True, inplace: bool = False) -> Tensor:
        if not training or not p:
            return x
        return x * torch.from_numpy(draws.random_sample(tuple(x.shape)) >= p) / (1 - p)

    def draw(self: Tensor, p: float) -> Tensor:
        return self.copy_(torch.from_numpy(draws.random_sample(tuple(self.shape)) < p))

    torch.nn.functional.dropout, Tensor.bernoulli_ = drop, draw
    try:
        yield
    finally:
        torch.nn.functional.dropout, Tensor.bernoulli_ = dropout, bernoulli


def with_dropout(policy: Policy, first: Batch) -> dict:
    """Return loss and gradients in training mode, with the dropout of `shared_draws`."""
    assert any(isinstance(m, TemporalTransformer) for m in policy.modules())
    with shared_draws(7):
        loss = policy.train().loss(first)
    loss.backward()
    return {"dropout_loss": loss.detach(), "dropout_gradient": gradients(policy)}


class _Rows:
    """The windows of a batch as a dataset."""

    def __init__(self, batch: Batch, task: int = 0):
        self.rows, self.task_id = batch, task

    def __len__(self) -> int:
        return len(self.rows)

    def batch(self, indices: Tensor) -> Batch:
        return self.rows.rows(indices)


def ewc(policy: Policy, first: Batch, second: Batch) -> dict:
    """Return EWC's Fisher information after a task of two batches, and a step of the next one."""
    config = composed("preset=paper", "compat=libero", "algo=ewc", "algo.estimator.batch_size=1").algo
    algorithm = build(config)
    windows = JoinedWindows([_Rows(first), _Rows(second)])
    algorithm.end_task(0, windows, policy, generator(0))
    found = {"fisher": dict(algorithm.importance)}
    with torch.no_grad():
        for p in policy.parameters():
            p.mul_(1.01)
    penalty = algorithm.penalty(policy)
    loss = one_step(policy, first, algorithm)
    found |= {"penalty": penalty.detach(), "ewc_loss": torch.tensor(loss)}
    return found | {"ewc_clipped": gradients(policy)}


def packnet(policy: Policy, first: Batch, second: Batch) -> dict:
    """Return PackNet's weights after a step of each of two tasks and the pruning between them, and the owners."""
    algorithm = original.our_algorithm("packnet")
    train, retrain = algorithm.phases()
    algorithm.begin_task(0, _Rows(first), policy)
    algorithm.begin_phase(train, policy)
    one_step(policy, first, algorithm)
    found = {"packnet_first": weights(policy)}
    algorithm.end_phase(train, policy)
    found |= {"owner": dict(algorithm.state_dict()["owner"]), "packnet_pruned": weights(policy)}
    algorithm.end_phase(retrain, policy)
    algorithm.begin_task(1, _Rows(second, 1), policy)
    algorithm.begin_phase(train, policy)
    one_step(policy, second, algorithm)
    return found | {"packnet_second": weights(policy)}


# --- comparison


def relative(ours: Tensor, theirs: Tensor) -> float:
    """Return |ours - theirs| / |theirs|, in norms."""
    difference = (ours.double() - theirs.double()).norm()
    return (difference / max(theirs.double().norm().item(), 1e-30)).item()


def worst(ours: Found, theirs: Found) -> tuple[float, str]:
    """Return the largest relative difference of tensors of theirs, and which it is.

    Tensors that are zero but for rounding on both sides are left out: the gradients of biases that a norm or a softmax
    right after them takes out again.
    """
    zero = rounding(theirs)
    used = [n for n, t in theirs.items() if max(t.norm(), ours[n].norm()) > zero]
    return max((relative(ours[name], theirs[name]), name) for name in used)


def rounding(tensors: Found) -> float:
    """Return the norm below which one of the tensors is zero but for rounding."""
    return ROUNDING * torch.stack([t.double().norm() for t in tensors.values()]).norm().item()


def update_difference(before: Found, ours: Found, theirs: Found, gradient: Found) -> float:
    """Return how far two updates of all weights are apart, relative to their norm.

    Entries whose gradient is below a thousandth of its tensor's RMS are left out: Adam's first step moves every weight
    by the learning rate, and where the gradient is rounding alone, rounding decides which way.
    """
    apart, length, zero = 0.0, 0.0, rounding(gradient)
    for name, g in gradient.items():
        if g.norm() <= zero:
            continue
        used = g.abs() > 1e-3 * g.square().mean().sqrt()
        there, here = (theirs[name] - before[name])[used], (ours[name] - before[name])[used]
        apart, length = apart + (here - there).square().sum().item(), length + there.square().sum().item()
    return (apart / length) ** 0.5


def where_owners_agree(weights: Found, ours: Found, theirs: Found) -> Found:
    """Return weights without those that one side owns and the other does not.

    A weight at the threshold of pruning may be on either side of it, by rounding.
    """
    return {
        name: value * (ours[name] == theirs[name]) if name in theirs else value
        for name, value in weights.items()
    }
