"""The original's policies and their modules: sizes, learning, acting, and errors."""

import copy

import numpy as np
import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

from libero._adapters.config import load_config
from libero.lifelong import models
from libero.lifelong.models import bc_rnn_policy, bc_transformer_policy
from libero.lifelong.models.modules import data_augmentation as aug
from libero.lifelong.models.modules import language_modules, rgb_modules, transformer_modules
from libero.lifelong.models.policy_head import DeterministicHead, GMMHead
from libero_env.errors import LiberoError
from lifelong.types import Observation
from tests.harness.facade_learning import TINY, TINY_TRANSFORMER, windows, write_demos

VIEWS = ("agentview_rgb", "eye_in_hand_rgb")
SHAPES = {
    "ac_dim": 7,
    "all_shapes": {"agentview_rgb": (3, 128, 128), "eye_in_hand_rgb": (3, 128, 128), "gripper_states": (2,),
     "joint_states": (7,)},
}  # fmt: skip


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_demos(tmp_path_factory.mktemp("demos") / "task_demo.hdf5")


@pytest.mark.parametrize(
    ("group", "count"),
    [("bc_rnn_policy", 19_105_707), ("bc_transformer_policy", 5_383_307), ("bc_vilt_policy", 7_917_963)],
)
def test_sizes_are_the_originals(group, count):
    cfg = load_config(f"policy={group}", "device=cpu")
    policy = models.get_policy_class(cfg.policy.policy_type.lower())(cfg, SHAPES)
    assert sum(p.numel() for p in policy.parameters()) == count
    assert models.get_policy_list()[cfg.policy.policy_type] is type(policy)


SMALL = {
    "bc_rnn_policy": ("policy.image_embed_size=8", "policy.text_embed_size=8", "policy.rnn_hidden_size=8",
     "policy.rnn_num_layers=1", "+policy.native.encoder.width=8"),
    "bc_transformer_policy": ("+policy.native.encoder.width=8",),
    "bc_vilt_policy": ("policy.spatial_down_sample_embed_size=8", "policy.spatial_transformer_num_layers=1",
     "policy.spatial_transformer_num_heads=2", "policy.spatial_transformer_head_output_size=4",
     "policy.spatial_transformer_mlp_hidden_size=8", "+policy.native.encoder.width=8"),
}  # fmt: skip


def small(group: str, file, *overrides: str):
    """Return a policy with few weights, and a batch of windows for it."""
    skip = ("policy.transformer", "policy.embed") if group == "bc_rnn_policy" else ()
    skip += ("policy.image_encoder",) if group == "bc_vilt_policy" else ()
    chosen = [o for o in (*TINY, *TINY_TRANSFORMER) if not o.startswith(skip or ("-",))]
    cfg = load_config(f"policy={group}", *chosen, *SMALL[group], *overrides)
    dataset = windows(file, cfg)
    torch.manual_seed(0)
    policy = models.get_policy_class(cfg.policy.policy_type)(cfg, cfg.shape_meta)
    return policy, next(iter(DataLoader(dataset, batch_size=4)))


@pytest.mark.parametrize("group", SMALL)
def test_policies_learn_and_act(group, file):
    without = ["policy.spatial_transformer_dropout=0.0"] if group == "bc_vilt_policy" else []
    words = ["train.use_augmentation=false", "+policy.native.temporal.dropout=0.0", *without]
    policy, batch = small(group, file, *words)
    kept = copy.deepcopy(batch)
    each = policy.compute_loss(batch, reduction="none")
    assert each.shape == batch["actions"].shape[:2]
    assert torch.allclose(policy.compute_loss(batch), each.mean())
    assert torch.allclose(-policy(batch).log_prob(batch["actions"]), each)
    optimizer = torch.optim.Adam(policy.parameters(), lr=1e-2)
    before = policy.compute_loss(batch).item()
    for _ in range(12):
        optimizer.zero_grad()
        policy.compute_loss(batch).backward()
        optimizer.step()
    assert policy.compute_loss(batch).item() < before - 0.5
    assert all((a == b).all() for a, b in zip(_leaves(batch), _leaves(kept), strict=True)), "not changed"
    policy.reset()
    action = policy.get_action(frame(batch, 0))
    assert isinstance(action, np.ndarray) and action.shape == (4, 7) and np.abs(action).max() <= 1


def frame(batch, t):
    return {"obs": {k: v[:, t] for k, v in batch["obs"].items()}, "task_emb": batch["task_emb"]}


def _leaves(node):
    return [x for v in node.values() for x in _leaves(v)] if isinstance(node, dict) else [node]


@pytest.mark.parametrize("group", SMALL)
def test_acting_and_training_compute_the_same(group, file):
    """The distribution at the third of three frames that come one by one is that of the window's last step."""
    policy, batch = small(group, file)
    policy.eval()
    seen = []
    policy.policy_head.register_forward_hook(lambda *_: seen.append(_[2]))
    with torch.no_grad():
        whole = policy.forward(policy.preprocess_input(batch, train_mode=True))
    policy.reset()
    for t in range(3):
        policy.get_action(frame(batch, t))
    assert torch.allclose(seen[-1].mean, whole.mean[:, -1], atol=1e-5)


def test_the_rnn_carries_its_state_and_resets_it(file):
    policy, batch = small("bc_rnn_policy", file)
    ages = []
    for _ in range(5):
        policy.get_action(frame(batch, 0))
        ages.append(policy._age)
    assert ages == [1, 2, 3, 1, 2]
    policy.reset()
    first, second = (policy(batch, train_mode=False).mean for _ in range(2))
    assert torch.allclose(first, policy(batch).mean) and not torch.allclose(first, second)


def test_weights_are_the_native_networks(file):
    """A native checkpoint fits, and its upright uint8 images are the facade's flipped floats."""
    policy, batch = small("bc_transformer_policy", file)
    policy.eval()
    native = copy.deepcopy(policy.network)
    views = torch.stack([batch["obs"][v].flip(-2) for v in VIEWS], 2).movedim(-3, -1)
    obs = Observation((views * 255).round().to(torch.uint8), batch["obs"], batch["task_emb"])
    with torch.no_grad():
        assert torch.allclose(native.distribution(obs)["means"], policy(batch).component_distribution.mean)


def test_configured_variants(file):
    policy, batch = small(
        "bc_transformer_policy",
        file,
        "policy.extra_num_layers=2",
        "policy/policy_head=deterministic_head",
        "policy.policy_head.network_kwargs.hidden_size=8",
        "+policy.policy_head.network_kwargs.action_squash=false",
        "policy.image_encoder.network_kwargs.freeze=true",
        "policy.image_encoder.network_kwargs.language_fusion=none",
        "policy/data_augmentation@policy.color_aug=img_color_jitter_group_aug",
        "policy/data_augmentation@policy.translation_aug=translation_aug_group",
        "data.use_ee=true",
        "data.obs.modality.low_dim=[gripper_states,joint_states,ee_states]",
    )
    policy.compute_loss(batch).backward()
    assert policy(batch).shape == (4, 3, 7)
    latent = torch.full((1, 1, 8), 30.0)
    policy.policy_head.head.means.weight.data.fill_(1.0)
    policy.policy_head.head.trunk = nn.Identity()
    assert policy.policy_head(latent).min() > 1, "no tanh"
    names = {n.split(".")[1] for n, p in policy.named_parameters() if p.requires_grad and p.grad is not None}
    assert names == {"language", "proprio", "transformer", "head"}, "the image encoders are frozen"
    assert len(policy.network.proprio.linears) == 3


@pytest.mark.parametrize(("overrides", "message"), [
    (["policy.image_encoder.network_kwargs.pretrained=true"], "pretrained"),
    (["policy.policy_head.network_kwargs.activation=exp"], "softplus"),
    (["policy.transformer_input_size=5"], "transformer_input_size"),
    (["policy/language_encoder=identity_encoder"], "IdentityEncoder"),
    (["policy.color_aug.network=Blur"], "BatchWiseImgColorJitterAug"),
    (["+policy.image_encoder.network_kwargs.frozen=true"], "key of policy.image_encoder 'frozen'"),
    (["+policy.policy_head.loss_kwargs.weight=3"], "key of policy.policy_head 'weight'"),
    (["policy.temporal_position_encoding.network_kwargs.factor_ratio=2"], "factor_ratio is not learned here"),
    (["policy.image_encoder.network=PatchEncoder"], "image_encoder 'PatchEncoder'.*ResnetEncoder"),
])  # fmt: skip
def test_unsupported_configurations_raise(overrides, message, file):
    with pytest.raises(LiberoError, match=message):
        small("bc_transformer_policy", file, *overrides)


def test_extra_modalities():
    joints, gripper, ee = (torch.randn(2, 3, size) for size in (7, 2, 6))
    obs = {"joint_states": joints, "gripper_states": gripper, "ee_states": ee}
    plain = bc_rnn_policy.ExtraModalities(use_joint=True, use_gripper=True, use_ee=True)
    assert torch.equal(plain(obs), torch.cat([joints, gripper, ee[..., :3]], -1))
    sized = bc_rnn_policy.ExtraModalities(True, True, False, 3, 5)  # sizes that the original never reads
    assert (sized.output_shape(), sized(obs).shape) == ((9,), (2, 3, 9))
    tokens = bc_transformer_policy.ExtraModalityTokens(True, True, True, extra_embedding_size=8)
    assert (tokens.num_extra, tokens(obs).shape) == (3, (2, 3, 3, 8))
    with pytest.raises(LiberoError, match="use_joint"):
        bc_transformer_policy.ExtraModalityTokens()


def test_image_modules():
    x = torch.rand(6, 3, 64, 64)
    encoder = rgb_modules.ResnetEncoder((3, 64, 64), 16, remove_layer_num=4, language_dim=5)
    assert encoder(x).shape == encoder(x, torch.randn(2, 5)).shape == (6, 16)
    assert encoder.output_shape() == (16,)
    frozen = rgb_modules.ResnetEncoder((3, 64, 64), freeze=True, remove_layer_num=5, no_stride=True)
    assert not any(p.requires_grad for p in frozen.parameters())
    deaf = rgb_modules.ResnetEncoder((3, 64, 64), remove_layer_num=5, language_dim=5, language_fusion="none")
    assert torch.equal(deaf(x, torch.randn(6, 5)), deaf(x))
    assert rgb_modules.PatchEncoder((3, 64, 32), (8, 8), embed_size=4)(x[..., :32]).shape == (6, 4, 4, 2)
    with pytest.raises(LiberoError, match="remove_layer_num"):
        rgb_modules.ResnetEncoder((3, 64, 64), remove_layer_num=7)


def test_language_modules():
    emb = torch.randn(3, 5)
    assert torch.equal(language_modules.IdentityEncoder()({"task_emb": emb}), emb)
    encoder = language_modules.MLPEncoder(5, 8, 4, 2)  # as in the original: input, hidden, output, layers
    assert torch.equal(encoder({"task_emb": emb}), encoder(emb)) and encoder(emb).shape == (3, 4)
    assert len(language_modules.MLPEncoder(5, 8, 4, 1).projection) == 1


def test_transformer_modules():
    x = torch.randn(2, 3, 4, 8)  # B, T, M, E
    codes = transformer_modules.SinusoidalPositionEncoding(8)(x)
    first = torch.tensor([np.sin(1.0), np.cos(1.0)]).float()
    assert codes.shape == (3, 8) and torch.allclose(codes[1, :2], first)
    scaled = transformer_modules.SinusoidalPositionEncoding(8, factor_ratio=2.0)
    assert torch.equal(scaled(x), 2 * codes) and [tuple(p.shape) for p in scaled.parameters()] == [(1,)]
    decoder = transformer_modules.TransformerDecoder(8, 2, 2, 4, 16, 0.0).eval()
    decoder.compute_mask(x.shape)
    out = decoder(x.flatten(1, 2)).view_as(x)
    later = x.clone()
    later[:, 2] += 1
    changed = decoder(later.flatten(1, 2)).view_as(x)
    assert torch.allclose(out[:, :2], changed[:, :2], atol=1e-6)
    assert not torch.allclose(out[:, 2], changed[:, 2])
    tokens = x.flatten(1, 2)
    seen = torch.ones(2, 12)
    seen[1, 5:] = 0  # of the second sequence; a mask of tokens is (B, N), as in the original
    pairs = seen[:, None].expand(-1, 12, -1)  # (B, N, N)
    assert torch.allclose(decoder(tokens, pairs), decoder(tokens, seen), atol=1e-6)


def test_heads():
    latent, actions = torch.randn(4, 3, 6), torch.rand(4, 3, 7) * 2 - 1
    head = GMMHead(6, 7, hidden_size=8, num_modes=3, low_eval_noise=True, loss_coef=2.0)
    gmm = head(latent)
    assert gmm.sample().shape == (4, 3, 7)
    losses = head.head.losses(head.head(latent), actions)
    assert torch.allclose(head.loss_fn(gmm, actions, "none"), 2 * losses, atol=1e-4)
    assert torch.allclose(head.loss_fn(gmm, actions, "sum") / 12, head.loss_fn(gmm, actions))
    quiet = head.eval()(latent).component_distribution.stddev
    assert torch.allclose(quiet, torch.full_like(quiet, 1e-4), rtol=1e-3)
    assert torch.equal(head.forward_fn(latent)[1], quiet)
    single = DeterministicHead(6, 7, hidden_size=8)
    assert single(latent).abs().max() <= 1
    assert torch.allclose(single.loss_fn(single(latent), actions), (single(latent) - actions).abs().mean())
    free = DeterministicHead(6, 7, hidden_size=8, action_squash=False)
    assert torch.allclose(free.head(latent)["means"], free(latent).tanh())


def test_augmentation():
    torch.manual_seed(0)
    x = (torch.rand(4, 2, 3, 16, 16) * 255).round() / 255
    x[:, 1] = x[:, 0]  # two equal frames
    for kind in aug.AUGMENTATIONS.values():
        layer = aug.DataAugGroup([kind((3, 16, 16))])
        first, second = layer((x, x))
        assert first.shape == x.shape and first.dtype == x.dtype and first.min() >= 0 and first.max() <= 1
        assert torch.equal(first[:, 0], first[:, 1]), "a window changes as a whole"
        assert torch.equal(first, x) == (kind is aug.IdentityAug)
        assert torch.equal(first, second), "both cameras change alike, as in the original"
        assert torch.allclose(layer.eval()((x, x))[0], x, atol=1e-6)
    same = torch.full((4, 1, 3, 4, 4), 0.3)
    kinds = (aug.ImgColorJitterAug, aug.BatchWiseImgColorJitterAug)
    whole, each = (kind(epsilon=0.0)(same)[:, 0, :, 0, 0] for kind in kinds)
    assert (whole == whole[0]).all() and not (each == each[0]).all()
