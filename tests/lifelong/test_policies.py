"""Every policy with every head acts as it is trained; chunks are planned, executed and forgotten."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from hydra import compose, initialize_config_dir
from torch import nn

from lifelong.data import fake_batch
from lifelong.errors import ConfigError, PolicyError
from lifelong.nn import (
    DeterministicHead,
    FlowHead,
    GMMHead,
    PatchEncoder,
    ResNetFiLMEncoder,
    SpatialTransformer,
    TemporalLSTM,
    TemporalTransformer,
)
from lifelong.policies import BCMLP, BCRNN, BCTransformer, BCViLT, Policy
from lifelong.policies.history import HistoryPolicy
from lifelong.settings import build
from lifelong.training.precision import bf16_runs_on_cpu
from lifelong.types import Batch, Observation, PolicySpec
from tests.harness.configs import chosen
from tests.harness.policies import small_transformer

SPEC = PolicySpec(image_size=(32, 32), language_dim=6, seq_len=4)
HEADS = {
    "gmm": partial(GMMHead, hidden=16, min_std=0.02),
    "deterministic": partial(DeterministicHead, hidden=16),
    "flow": partial(FlowHead, hidden=16, chunk=3, execute=2, steps=3),
}
RESNET = partial(ResNetFiLMEncoder, width=8, stage_blocks=(1,), stem_stride=4, stem_pool=False)
TRANSFORMER = {"layers": 1, "heads": 2, "head_dim": 8, "mlp_dim": 32}
LSTM = partial(TemporalLSTM, hidden=16)
PATCHES = partial(PatchEncoder, width=8, stem_stride=4, patch=4)
SMALL = {
    "transformer": (BCTransformer,
     {"embed_dim": 16, "encoder": RESNET, "temporal": partial(TemporalTransformer, **TRANSFORMER)}),
    "mlp": (BCMLP, {"image_embed": 16, "text_embed": 8, "encoder": RESNET}),
    "rnn": (BCRNN, {"image_embed": 16, "text_embed": 8, "encoder": RESNET, "temporal": LSTM}),
    "rnn-window": (BCRNN, {"image_embed": 16, "encoder": RESNET, "temporal": LSTM, "memory": "window"}),
    "vilt": (BCViLT, {"patch_embed": 16, "embed_dim": 16, "encoder": PATCHES,
     "spatial": partial(SpatialTransformer, **TRANSFORMER), "temporal": partial(TemporalTransformer, **TRANSFORMER)}),
}  # fmt: skip
CONFIGS = Path(__file__).parents[2] / "configs"
CHOICES = [
    f"{group}={file.stem}"
    for group in ("policy", "policy/head")
    for file in sorted((CONFIGS / group).glob("*.yaml"))
    if file.stem != "lerobot"  # needs LeRobot, and has tests of its own
]
WITHOUT_MEMORY = (BCRNN, {**SMALL["rnn-window"][1], "memory": "none"})
every_policy = pytest.mark.parametrize("kind", SMALL)
every_head = pytest.mark.parametrize("head", ["gmm", "deterministic", "flow"])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_policy(
    kind: str, head: str = "gmm", stochastic: bool = False, dropout: float | None = None, **head_sizes
) -> Policy:
    """A small policy; `dropout` is that of all its networks that have one."""
    target, components = WITHOUT_MEMORY if kind == "rnn-none" else SMALL[kind]
    parts = dict(components)
    for name in {"spatial", "temporal"} & set(parts) if dropout is not None else ():
        parts[name] = partial(parts[name], dropout=dropout)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = target(spec=SPEC, head=partial(HEADS[head], **head_sizes), stochastic=stochastic, **parts)
        for module in policy.modules():  # FiLM starts as the identity: let language matter
            if isinstance(module, nn.Linear):
                nn.init.normal_(module.weight, std=0.2)
    return policy


def steps(observation: Observation, at: slice) -> Observation:
    """Some steps of a window."""
    proprio = {k: v[:, at] for k, v in observation.proprio.items()}
    return Observation(observation.images[:, at], proprio, observation.language)


def frame(observation: Observation, t: int) -> Observation:
    return steps(observation, slice(t, t + 1))


def act_through(policy: Policy, observation: Observation, seeds: list[int] | None = None) -> torch.Tensor:
    """Actions of an episode whose frames are the window's, (B, T, A)."""
    generators = None if seeds is None else [generator(seed) for seed in seeds]
    policy.reset(len(observation.images))
    actions = [policy.act(frame(observation, t), generators) for t in range(observation.images.shape[1])]
    return torch.stack(actions, dim=1)


@pytest.mark.parametrize(
    ("target", "count"), [(BCTransformer, 5_383_307), (BCRNN, 19_105_707), (BCViLT, 7_917_963)]
)
def test_the_published_sizes_give_the_published_number_of_parameters(target: type, count: int) -> None:
    with torch.device("meta"):
        policy = target(spec=PolicySpec(language_dim=768))
    assert sum(p.numel() for p in policy.parameters()) == count


@pytest.mark.parametrize("choice", CHOICES)
def test_every_configuration_trains_and_acts(choice: str) -> None:
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = compose("config", [choice]).policy
    with torch.device("meta"):
        build(config, spec=PolicySpec(image_size=(128, 128), language_dim=768))
    spec = PolicySpec(image_size=(64, 64), language_dim=8, seq_len=5)
    policy, batch = build(config, spec=spec).eval(), fake_batch(spec, 1, generator())
    assert policy.window_losses(batch).isfinite().all()
    assert act_through(policy, steps(batch.observation, slice(2)), [0]).shape == (1, 2, 7)


@every_policy
@every_head
def test_acting_step_by_step_equals_the_training_forward(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head).eval(), fake_batch(SPEC, 3, generator())
    assert_acts_as_trained(policy, batch)


def test_with_batch_norm_too_acting_equals_the_training_forward() -> None:
    encoder = partial(RESNET, norm="batch")
    policy = BCTransformer(spec=SPEC, **(SMALL["transformer"][1] | {"encoder": encoder}))
    policy.loss(fake_batch(SPEC, 4, generator(1)))  # moves the running statistics
    assert_acts_as_trained(policy.eval(), fake_batch(SPEC, 3, generator()))


def assert_acts_as_trained(policy: HistoryPolicy, batch: Batch) -> None:
    whole = policy.distribution(batch.observation)
    policy.reset(3)
    with torch.no_grad():
        for t in range(policy.memory_steps):
            for key, value in policy.step(frame(batch.observation, t)).items():
                torch.testing.assert_close(value, whole[key][:, t], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("kind", ["transformer", "rnn-window", "vilt"])
@every_head
def test_only_the_latest_frames_are_remembered(kind: str, head: str) -> None:
    policy = make_policy(kind, head=head, **({"execute": 1} if head == "flow" else {})).eval()
    long = fake_batch(SPEC, 2, generator(), steps=9)
    actions, window = act_through(policy, long.observation), slice(9 - policy.memory_steps, 9)
    alone = act_through(policy, steps(long.observation, window))
    torch.testing.assert_close(actions[:, -1], alone[:, -1], atol=1e-5, rtol=1e-5)


def test_a_carried_state_is_emptied_every_seq_len_steps() -> None:
    policy, long = make_policy("rnn", head="gmm").eval(), fake_batch(SPEC, 2, generator(), steps=8)
    actions = act_through(policy, long.observation)
    again = act_through(policy, steps(long.observation, slice(4, 8)))
    torch.testing.assert_close(actions[:, 4:], again)
    changed = long.observation.images.clone()
    changed[:, 4] = 255 - changed[:, 4]  # the first frame of the second half is felt until its end
    other = act_through(policy, Observation(changed, long.observation.proprio, long.observation.language))
    assert not torch.allclose(actions[:, 7], other[:, 7], atol=1e-6)


def test_without_a_memory_each_action_follows_from_its_frame_alone() -> None:
    policy, long = (make_policy("rnn-none", head="gmm").eval(), fake_batch(SPEC, 2, generator(), steps=8))
    actions = act_through(policy, long.observation)
    for step in (0, 3, 7):
        alone = act_through(policy, steps(long.observation, slice(step, step + 1)))
        torch.testing.assert_close(actions[:, step : step + 1], alone)


@every_policy
@every_head
def test_reset_forgets(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head).eval(), fake_batch(SPEC, 2, generator())
    first = act_through(policy, batch.observation)
    assert torch.equal(first, act_through(policy, batch.observation))


@every_policy
@every_head
def test_environments_do_not_mix(kind: str, head: str) -> None:
    policy = make_policy(kind, head=head, stochastic=True).eval()
    batch = fake_batch(SPEC, 3, generator(), steps=6)
    together = act_through(policy, batch.observation, [5, 6, 7])
    alone = act_through(policy, batch.rows(slice(1, 2)).observation, [6])
    torch.testing.assert_close(alone[0], together[1], atol=1e-5, rtol=1e-5)


@every_policy
@every_head
def test_losses_reach_every_parameter_and_leave_the_batch(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head), fake_batch(SPEC, 4, generator())
    images, actions = batch.observation.images.clone(), batch.actions.clone()
    losses = policy.window_losses(batch)
    assert (losses.shape, losses.dtype) == ((4,), torch.float32)
    policy.loss(batch).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in policy.parameters())
    assert torch.equal(images, batch.observation.images)
    assert torch.equal(actions, batch.actions)


def test_bfloat16_gives_nearly_the_same_loss() -> None:
    policy, batch = make_policy("transformer").eval(), fake_batch(SPEC, 4, generator())
    if not bf16_runs_on_cpu():
        pytest.skip("bfloat16 does not run on this CPU")
    with torch.autocast("cpu", torch.bfloat16):
        low = policy.window_losses(batch)
    torch.testing.assert_close(low, policy.window_losses(batch), rtol=0.05, atol=0.2)


def test_actions_stay_in_range_and_depend_on_generators_only() -> None:
    policy = make_policy("transformer", stochastic=True, min_std=2.0).eval()
    observation = frame(fake_batch(SPEC, 2, generator()).observation, 0)
    action = act_through(policy, observation, [1, 2])
    assert torch.equal(action, act_through(policy, observation, [1, 2]))
    assert action.abs().max() <= 1


@every_policy
@every_head
def test_in_eval_mode_the_loss_of_a_window_is_its_own(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head).eval(), fake_batch(SPEC, 3, generator())
    alone = policy.window_losses(batch.rows(slice(2, 3)))
    torch.testing.assert_close(policy.window_losses(batch)[2:], alone, rtol=1e-4, atol=1e-4)


@every_policy
@every_head
def test_predict_is_deterministic_and_has_gradients_at_every_step(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head, stochastic=True).eval(), fake_batch(SPEC, 3, generator())
    answer = policy.predict(batch)
    assert (answer.shape, answer.dtype) == (batch.actions.shape, torch.float32)
    assert torch.equal(answer, policy.predict(batch))
    answer.square().sum().backward()
    touched = [n for n, p in policy.named_parameters() if p.grad is not None and p.grad.abs().sum() > 0]
    assert any(n.startswith("encoders") for n in touched)
    assert any(n.startswith("head") for n in touched)


@every_policy
def test_acting_without_sampling_executes_the_predicted_actions(kind: str) -> None:
    policy, batch = make_policy(kind, head="flow", execute=1).eval(), fake_batch(SPEC, 2, generator())
    actions = act_through(policy, steps(batch.observation, slice(policy.memory_steps)))
    expected = policy.predict(batch)[:, : policy.memory_steps].clamp(-1, 1)
    torch.testing.assert_close(actions, expected, atol=1e-5, rtol=1e-5)


@every_policy
@every_head
def test_a_batch_can_be_overfitted(kind: str, head: str) -> None:
    policy, batch = make_policy(kind, head=head, dropout=0.0), fake_batch(SPEC, 2, generator())
    before = policy.eval().loss(batch).item()
    optimizer = torch.optim.AdamW(policy.train().parameters(), lr=3e-3)
    for _ in range(30):
        optimizer.zero_grad()
        policy.loss(batch).backward()
        optimizer.step()
    assert policy.eval().loss(batch).item() < before - 0.1


@every_policy
def test_language_and_every_input_matter(kind: str) -> None:
    policy, batch = make_policy(kind).eval(), fake_batch(SPEC, 2, generator())
    obs, base = batch.observation, policy.predict(batch)
    changes = [replace(obs, language=obs.language.flip(0))]
    changes += [replace(obs, proprio=obs.proprio | {k: v.flip(0)}) for k, v in obs.proprio.items()]
    for view in range(2):
        images = obs.images.clone()
        images[:, :, view] = images[:, :, view].flip(0)
        changes.append(replace(obs, images=images))
    for changed in changes:
        other = policy.predict(Batch(changed, batch.actions, batch.task_ids, batch.window_ids))
        assert not torch.allclose(other, base, rtol=0, atol=1e-6)


@pytest.mark.parametrize("readout", ["instruction", "all"])
def test_a_head_that_reads_all_tokens_sees_the_camera_past_the_transformer(readout: str) -> None:
    policy = small_transformer(SPEC, readout=readout).eval()
    obs = fake_batch(SPEC, 2, generator()).observation
    for parameter in policy.transformer.parameters():
        parameter.data.zero_()
    other = Observation(obs.images.flip(0), obs.proprio, obs.language)
    tokens, latents = policy.encode(obs), [policy.over_time(policy.encode(o)) for o in (obs, other)]
    width = tokens.shape[-1]
    assert latents[0].shape == (2, SPEC.seq_len, width * (1 + (readout == "all") * tokens.shape[2]))
    assert torch.equal(latents[0][..., :width], latents[1][..., :width])  # it passes on nothing of a camera
    assert torch.equal(*latents) == (readout == "instruction")


def test_a_policy_whose_actions_follow_the_instruction_alone_is_refused() -> None:
    none = partial(TemporalTransformer, layers=0, heads=2, head_dim=4, mlp_dim=8)
    small_transformer(SPEC, temporal=none, readout="all")
    with pytest.raises(PolicyError, match="temporal.layers=0 with policy.readout=instruction"):
        small_transformer(SPEC, temporal=none, readout="instruction")
    with pytest.raises(ConfigError, match="spatial.layers"):
        build(chosen("policy", "bc_vilt", "policy.spatial.layers=0"), spec=SPEC)


@every_policy
def test_no_step_depends_on_later_ones(kind: str) -> None:
    policy, batch = make_policy(kind, head="gmm").eval(), fake_batch(SPEC, 2, generator())
    shorter = policy.distribution(steps(batch.observation, slice(2)))["means"]
    whole = policy.distribution(batch.observation)["means"][:, :2]
    torch.testing.assert_close(shorter, whole, atol=1e-5, rtol=1e-5)


class TestFlow:
    """The flow matching head by itself."""

    def test_slots_of_a_chunk_end_with_the_window(self) -> None:
        head = FlowHead(in_dim=2, action_dim=1, chunk=3, execute=1, hidden=8)
        assert head(torch.zeros(1, 4, 2))["slots"][0].tolist() == [[1, 1, 1], [1, 1, 1], [1, 1, 0], [1, 0, 0]]
        assert head(torch.zeros(1, 2))["slots"].tolist() == [[1, 1, 1]]

    def test_the_loss_by_hand(self) -> None:
        head = FlowHead(in_dim=2, action_dim=2, chunk=2, execute=1, hidden=8)
        latent = torch.randn(1, 2, 2, generator=generator())
        actions = torch.rand(1, 2, 2, generator=generator(1))
        params = head(latent)
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            noise, time = torch.randn(1, 2, 2, 2), torch.rand(1, 2)
            torch.manual_seed(3)
            losses = head.losses(params, actions)
            for step, chunk in enumerate([actions[0], actions[0, 1:]]):
                e, s, n = noise[0, step], time[0, step], len(chunk)
                x = torch.zeros(2, 2)
                x[:n] = (1 - s) * e[:n] + s * chunk
                v = head.velocity(x, s, latent[0, step], params["slots"][0, step])
                expected = (v[:n] - (chunk - e[:n])).square().mean()
                torch.testing.assert_close(losses[0, step], expected)

    def test_slots_beyond_the_window_have_no_effect(self) -> None:
        head = FlowHead(in_dim=2, action_dim=1, chunk=2, execute=1, hidden=8).eval()
        x, latent, slots = torch.zeros(2, 1), torch.ones(2), torch.tensor([1.0, 0.0])
        other = torch.tensor([[0.0], [5.0]])
        with torch.no_grad():
            velocities = [head.velocity(y, torch.tensor(0.5), latent, slots) for y in (x, other)]
        assert torch.equal(*velocities)
        assert velocities[0][1] == 0

    def test_it_learns_both_of_two_choices(self) -> None:
        """Where a mean would lie between, samples lie at one or the other, and a chunk keeps to its choice."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            head = FlowHead(in_dim=1, action_dim=1, chunk=2, execute=2, hidden=64, steps=20)
            optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
            side = torch.tensor([-0.8, 0.8]).repeat(64)[:, None, None]
            for _ in range(300):
                loss = head.losses(head(torch.zeros(128, 2, 1)), side.expand(128, 2, 1)).mean()
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
        with torch.no_grad():
            plan = head.plan(head(torch.zeros(200, 1)), [generator(i) for i in range(200)])[..., 0]
        assert ((plan.abs() - 0.8).abs() < 0.3).float().mean() > 0.85
        assert (plan.prod(1) > 0).float().mean() > 0.85
        assert 0.3 < (plan[:, 0] > 0).float().mean() < 0.7

    def test_a_plan_is_executed_before_the_next_is_made(self) -> None:
        policy = make_policy("transformer", head="flow", stochastic=True).eval()
        observation = fake_batch(SPEC, 2, generator(), steps=5).observation
        actions = act_through(policy, observation, [1, 2])
        changed = observation.images.clone()
        changed[:, 3] = 255 - changed[:, 3]  # the second step of the second plan
        other = act_through(policy, Observation(changed, observation.proprio, observation.language), [1, 2])
        assert torch.equal(actions[:, :4], other[:, :4])
        assert not torch.allclose(actions[:, 4], other[:, 4], atol=1e-5)

    @pytest.mark.parametrize(("changes", "message"), [
        ({"chunk": 5}, "data.seq_len to 5 or more"), ({"execute": 4}, "execute is 4")
    ])  # fmt: skip
    def test_invalid_sizes_are_refused(self, changes: dict, message: str) -> None:
        with pytest.raises(PolicyError, match=message):
            make_policy("transformer", head="flow", **changes)


def test_wrong_use_is_refused() -> None:
    batch = fake_batch(SPEC, 2, generator())
    with pytest.raises(PolicyError, match="policy/head=gmm"):
        BCTransformer(spec=SPEC, **(SMALL["transformer"][1] | {"head": "gmm"}))
    with pytest.raises(PolicyError, match="do not tile"):
        BCViLT(spec=SPEC, encoder=partial(PATCHES, patch=3))
    for kind in SMALL:
        policy = make_policy(kind, stochastic=True).eval()
        with pytest.raises(PolicyError, match="reset"):
            policy.act(frame(batch.observation, 0))
        policy.reset(2)
        with pytest.raises(PolicyError, match="generator"):
            policy.act(frame(batch.observation, 0))
    with pytest.raises(PolicyError, match="images"):
        policy.act(batch.observation)
    step = frame(batch.observation, 0)
    with pytest.raises(PolicyError, match="lacks"):
        policy.act(Observation(step.images, {"joint_states": step.proprio["joint_states"]}, step.language))
    with pytest.raises(PolicyError, match="eval"):
        policy.train().act(step)


def test_gradients_of_an_lstm_in_evaluation_mode_do_not_ask_cudnn(monkeypatch):
    """Which has them in training mode only; importances of weights are computed in evaluation mode."""
    asked = []
    forward = torch.nn.LSTM.forward

    def watched(self, *args):
        asked.append(torch.backends.cudnn.enabled)
        return forward(self, *args)

    monkeypatch.setattr(torch.nn.LSTM, "forward", watched)
    lstm, before = LSTM(in_dim=3), torch.backends.cudnn.enabled
    x = torch.ones(2, 4, 3)
    lstm(x)[0].sum().backward()
    lstm.eval()(x)[0].sum().backward()
    with torch.no_grad():
        lstm(x)
    assert asked == [before, False, before] and torch.backends.cudnn.enabled == before
