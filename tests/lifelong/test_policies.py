"""Policies act as they are trained, and refuse wrong use."""

from functools import partial

import pytest
import torch
from torch import nn

from lifelong.data import fake_batch
from lifelong.errors import PolicyError
from lifelong.nn import DeterministicHead, GMMHead, ResNetFiLMEncoder, TemporalTransformer
from lifelong.policies import BCTransformer
from lifelong.training.precision import bf16_runs_on_cpu
from lifelong.types import Observation, PolicySpec

pytestmark = pytest.mark.unit
SPEC = PolicySpec(image_size=(32, 32), language_dim=6, seq_len=4)
HEADS = {
    "gmm": partial(GMMHead, hidden=16, min_std=0.02),
    "deterministic": partial(DeterministicHead, hidden=16),
}


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def small(norm: str = "group", dropout: float = 0.1, head: str = "gmm", **head_sizes) -> dict:
    """The components of a small policy."""
    return {
        "embed_dim": 16,
        "encoder": partial(
            ResNetFiLMEncoder, width=8, stage_blocks=(1,), stem_stride=4, stem_pool=False, norm=norm
        ),
        "temporal": partial(TemporalTransformer, layers=2, heads=2, head_dim=8, mlp_dim=32, dropout=dropout),
        "head": partial(HEADS[head], **head_sizes),
    }


def make_policy(spec: PolicySpec = SPEC, stochastic: bool = False, **changes) -> BCTransformer:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = BCTransformer(spec=spec, stochastic=stochastic, **small(**changes))
        for module in policy.modules():  # FiLM starts as the identity: let language matter
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.2)
    return policy


def at(observation: Observation, t: int) -> Observation:
    """One step of a window."""
    proprio = {k: v[:, t : t + 1] for k, v in observation.proprio.items()}
    return Observation(observation.images[:, t : t + 1], proprio, observation.language)


def test_the_published_sizes_give_the_published_number_of_parameters() -> None:
    policy = BCTransformer(spec=PolicySpec(language_dim=768))
    assert sum(p.numel() for p in policy.parameters()) == 5_383_307


@pytest.mark.parametrize("head", ["gmm", "deterministic"])
@pytest.mark.parametrize("norm", ["group", "batch"])
def test_acting_step_by_step_equals_the_training_forward(head: str, norm: str) -> None:
    policy = make_policy(head=head, norm=norm).eval()
    batch = fake_batch(SPEC, 3, generator())
    whole = policy.distribution(batch.observation)
    policy.reset(3)
    with torch.no_grad():
        for t in range(SPEC.seq_len):
            step = policy._step(at(batch.observation, t))
            for key, value in step.items():
                torch.testing.assert_close(value, whole[key][:, t], atol=1e-5, rtol=1e-5)


def test_history_is_the_last_seq_len_steps() -> None:
    policy = make_policy().eval()
    long = fake_batch(SPEC, 2, generator(), steps=9).observation
    policy.reset(2)
    for t in range(9):
        action = policy.act(at(long, t))
    proprio = {k: v[:, -4:] for k, v in long.proprio.items()}
    window = Observation(long.images[:, -4:], proprio, long.language)
    expected = policy.head.mode(policy.distribution(window))[:, -1]
    torch.testing.assert_close(action, expected.clamp(-1, 1), atol=1e-5, rtol=1e-5)


def test_a_single_step_policy_has_no_memory() -> None:
    spec = PolicySpec(image_size=(32, 32), language_dim=6, seq_len=1)
    policy, batch = make_policy(spec).eval(), fake_batch(spec, 2, generator())
    policy.reset(2)
    first, second = policy.act(batch.observation), policy.act(batch.observation)
    torch.testing.assert_close(first, second)


def test_reset_forgets() -> None:
    policy, batch = make_policy().eval(), fake_batch(SPEC, 2, generator())
    policy.reset(2)
    first = policy.act(at(batch.observation, 0))
    policy.act(at(batch.observation, 1))
    policy.reset(2)
    assert torch.equal(first, policy.act(at(batch.observation, 0)))


def test_environments_do_not_mix() -> None:
    policy, batch = make_policy(stochastic=True).eval(), fake_batch(SPEC, 3, generator())
    policy.reset(3)
    for t in range(3):
        together = policy.act(at(batch.observation, t), [generator(10 * t + i) for i in range(3)])
    policy.reset(1)
    for t in range(3):
        step = at(batch.observation, t)
        alone = Observation(
            step.images[1:2], {k: v[1:2] for k, v in step.proprio.items()}, step.language[1:2]
        )
        action = policy.act(alone, [generator(10 * t + 1)])
    torch.testing.assert_close(action[0], together[1], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("head", ["gmm", "deterministic"])
def test_losses(head: str) -> None:
    policy = make_policy(head=head, dropout=0.0)
    batch = fake_batch(SPEC, 4, generator())
    images = batch.observation.images.clone()
    losses = policy.window_losses(batch)
    assert losses.shape == (4,)
    assert losses.dtype == torch.float32
    torch.testing.assert_close(policy.loss(batch), losses.mean())
    assert torch.equal(images, batch.observation.images)
    policy.loss(batch).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in policy.parameters())


def test_bfloat16_gives_nearly_the_same_loss() -> None:
    policy, batch = make_policy().eval(), fake_batch(SPEC, 4, generator())
    if not bf16_runs_on_cpu():
        pytest.skip("bfloat16 does not run on this CPU")
    with torch.autocast("cpu", torch.bfloat16):
        low = policy.window_losses(batch)
    torch.testing.assert_close(low, policy.window_losses(batch), rtol=0.05, atol=0.2)


def test_a_batch_can_be_overfitted() -> None:
    policy, batch = make_policy(dropout=0.0), fake_batch(SPEC, 4, generator())
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    first = policy.loss(batch).item()
    for _ in range(40):
        optimizer.zero_grad()
        loss = policy.loss(batch)
        loss.backward()
        optimizer.step()
    assert loss.item() < first - 2


def test_language_and_every_input_matter() -> None:
    policy, batch = make_policy().eval(), fake_batch(SPEC, 2, generator())
    obs = batch.observation
    base = policy.distribution(obs)["means"]
    changes = [
        Observation(obs.images, obs.proprio, obs.language.flip(0)),
        *(
            Observation(obs.images, obs.proprio | {k: v.flip(0)}, obs.language)
            for k, v in obs.proprio.items()
        ),
        *(Observation(_flip_view(obs.images, v), obs.proprio, obs.language) for v in range(2)),
    ]
    for changed in changes:
        assert not torch.allclose(policy.distribution(changed)["means"], base, atol=1e-4)


def _flip_view(images: torch.Tensor, view: int) -> torch.Tensor:
    flipped = images.clone()
    flipped[:, :, view] = images[:, :, view].flip(0)
    return flipped


def test_weights_round_trip_through_the_state_dict() -> None:
    one, other = make_policy().eval(), BCTransformer(spec=SPEC, **small()).eval()
    batch = fake_batch(SPEC, 2, generator())
    other.load_state_dict(one.state_dict())
    assert torch.equal(one.window_losses(batch), other.window_losses(batch))


def test_actions_stay_in_range_and_depend_on_generators_only() -> None:
    policy, batch = make_policy(stochastic=True, min_std=2.0).eval(), fake_batch(SPEC, 2, generator())
    step = at(batch.observation, 0)
    policy.reset(2)
    action = policy.act(step, [generator(1), generator(2)])
    policy.reset(2)
    assert torch.equal(action, policy.act(step, [generator(1), generator(2)]))
    assert action.abs().max() <= 1


def test_wrong_use_is_refused() -> None:
    policy, batch = make_policy(stochastic=True), fake_batch(SPEC, 2, generator())
    step = at(batch.observation, 0)
    with pytest.raises(PolicyError, match="eval"):
        policy.act(step)
    policy.eval()
    with pytest.raises(PolicyError, match="reset"):
        policy.act(step)
    policy.reset(2)
    with pytest.raises(PolicyError, match="generator"):
        policy.act(step)
    with pytest.raises(PolicyError, match="images"):
        policy.act(batch.observation)
    with pytest.raises(PolicyError, match="lacks"):
        policy.act(Observation(step.images, {"joint_states": step.proprio["joint_states"]}, step.language))
    with pytest.raises(PolicyError, match="policy/head=gmm"):
        BCTransformer(spec=SPEC, **(small() | {"head": "gmm"}))
