"""Policies of LeRobot: their losses and actions are LeRobot's own, and what is saved is read by LeRobot.

`make lerobot` makes an environment with LeRobot and runs these tests in it.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot")

from libero_env.demos.read import read_demos
from libero_env.tasks import get_suite
from libero_eval.user_policy import weights_digest
from libero_integrations.exports.layouts import PUBLISHED
from libero_integrations.imports.demonstrations import lerobot_files
from libero_integrations.lerobot_modules import lerobot_module
from libero_integrations.lerobot_policy import FOLDER, LeRobotPolicy
from lifelong.data.dataset import SequenceVLDataset, last_frames
from lifelong.data.fake import fake_observation
from lifelong.data.windows import frame_moments, frames_of
from lifelong.errors import ConfigError, PolicyError
from lifelong.settings import build
from lifelong.training.costs import action_costs
from lifelong.training.fit import _make_optimizer
from lifelong.training.settings import FitSettings
from lifelong.types import PolicySpec
from tests.harness.configs import composed
from tests.harness.demos import episode

factory, configs = lerobot_module("policies.factory"), lerobot_module("configs.policies")
LENGTHS = (9, 14)
SMALL = {
    "act": {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1, "latent_dim": 8},
    "diffusion": {"down_dims": [32, 64], "diffusion_step_embed_dim": 32, "n_groups": 4, "num_inference_steps": 3},
}  # fmt: skip


def spec(steps: int = 8) -> PolicySpec:
    return PolicySpec(
        image_size=(32, 32), proprio={"ee_pos": 3, "gripper_states": 2}, language_dim=6, seq_len=steps
    )


def policy(type: str = "act", steps: int = 8, **changes) -> LeRobotPolicy:
    given = {
        "settings": SMALL.get(type), "act_steps": None, "language": True, "pretrained": None
    }  # fmt: skip
    torch.manual_seed(0)
    return LeRobotPolicy(spec=spec(steps), type=type, **(given | changes))


def dataset(steps: int = 8, seed: int = 0) -> SequenceVLDataset:
    draws, frames = torch.Generator().manual_seed(seed), sum(LENGTHS)
    return SequenceVLDataset(
        images=torch.randint(0, 256, (frames, 2, 32, 32, 3), generator=draws, dtype=torch.uint8),
        proprio={
            "ee_pos": torch.randn(frames, 3, generator=draws) * 3 + 1,
            "gripper_states": torch.rand(frames, 2, generator=draws),
        },
        actions=2 * torch.rand(frames, 7, generator=draws) - 1,
        last=last_frames(LENGTHS),
        language=torch.randn(6, generator=draws),
        task_id=seed,
        seq_len=steps,
    )


def by_hand(data: SequenceVLDataset, starts, type: str, steps: int) -> dict:
    """A batch as LeRobot's loader makes it, from the arrays alone."""
    observed = [-1, 0] if type == "diffusion" else [0]
    planned = range(-1, steps - 1) if type == "diffusion" else range(steps)
    first = observed[0]
    batch: dict = {"action": [], "action_is_pad": []}
    for start in starts:
        now = start - first
        end = int(data.last[start])
        frames = [min(now + k, end) for k in observed]
        row = {
            "observation.images.image": data.images[frames, 0].permute(0, 3, 1, 2) / 255,
            "observation.images.image2": data.images[frames, 1].permute(0, 3, 1, 2) / 255,
            "observation.state": torch.cat([data.proprio["ee_pos"], data.proprio["gripper_states"]], 1)[
                frames
            ],
            "observation.environment_state": data.language.expand(len(frames), -1),
        }
        for key, value in row.items():
            batch.setdefault(key, []).append(value if type == "diffusion" else value[0])
        batch["action"].append(data.actions[[min(now + k, end) for k in planned]])
        batch["action_is_pad"].append(torch.tensor([now + k > end for k in planned]))
    return {key: torch.stack(values) for key, values in batch.items()}


@pytest.mark.parametrize("type", SMALL)
@pytest.mark.parametrize("normalised", [True, False])
def test_the_loss_of_a_batch_and_the_actions_are_stock_lerobots(tmp_path, type, normalised) -> None:
    ours, data = policy(type), dataset()
    ours.meet_task(data, "pick up the soup")
    if normalised:
        ours.normalise(moments(data), once=True)
    ours.save_beside(tmp_path)
    config = configs.PreTrainedConfig.from_pretrained(tmp_path / FOLDER)
    stock = factory.get_policy_class(type).from_pretrained(tmp_path / FOLDER, config=config)
    before, after = factory.make_pre_post_processors(config, pretrained_path=str(tmp_path / FOLDER))
    starts = torch.tensor([0, 3, 7, 12, 20])  # some windows end behind their demonstration
    for mode in (True, False) if type == "diffusion" else (True,):  # ACT's loss needs its training mode
        ours.train(mode), stock.train(mode)
        torch.manual_seed(3)
        loss = ours.loss(data.batch(starts))
        torch.manual_seed(3)
        expected, _ = stock.forward(before(by_hand(data, starts.tolist(), type, 8)))
        assert torch.equal(loss, expected) and loss > 0
    batch = data.batch(starts)
    assert batch.is_pad is not None and batch.is_pad.any() and not batch.is_pad.all(1).any()

    ours.eval(), stock.eval()
    ours.reset(3), stock.reset()
    for step in range(10):
        seen = fake_observation(ours.spec, 3, torch.Generator().manual_seed(step), steps=1)
        draws = [torch.Generator().manual_seed(5 + k) for k in range(3)] if type == "diffusion" else None
        acted = ours.act(seen, draws)
        given = {
            "observation.images.image": seen.images[:, 0, 0].permute(0, 3, 1, 2) / 255,
            "observation.images.image2": seen.images[:, 0, 1].permute(0, 3, 1, 2) / 255,
            "observation.state": torch.cat([seen.proprio[n][:, 0] for n in ("ee_pos", "gripper_states")], 1),
            "observation.environment_state": seen.language,
        }
        own = {}
        if type == "diffusion":
            own["noise"] = torch.stack(
                [torch.randn(8, 7, generator=torch.Generator().manual_seed(5 + k)) for k in range(3)]
            )
        expected = after(stock.select_action(before(given), **own))
        assert torch.equal(acted, expected.clamp(-1, 1))


def test_a_policy_is_as_it_was_when_its_weights_are_loaded() -> None:
    learned, again = policy(), policy()
    learned.meet_task(dataset(), "pick up the soup")
    again.load_state_dict(learned.state_dict())
    seen = fake_observation(spec(), 2, torch.Generator().manual_seed(0), steps=1)
    for one in (learned, again):
        one.eval().reset(2)
    assert torch.equal(learned.act(seen), again.act(seen))
    assert again.instructions(dataset().language[None]) == ["pick up the soup"]
    with pytest.raises(PolicyError, match="has not learned a task of this one"):
        again.instructions(torch.zeros(1, 6))


def moments(data):
    return frame_moments([frames_of(data, tuple(spec().proprio))])


def test_statistics_are_of_the_task_that_was_asked_for() -> None:
    tasks = [dataset(seed=0), dataset(seed=1)]
    for once, expected in ((True, tasks[0]), (False, tasks[1])):
        one = policy()
        for task in tasks:
            one.normalise(moments(task), once=once)
        found = one.lerobot_statistics()
        assert torch.allclose(found["action"]["mean"], expected.actions.mean(0), atol=1e-6)
        assert torch.allclose(
            found["observation.state"]["std"][:3], expected.proprio["ee_pos"].std(0, correction=0)
        )
    assert set(policy().lerobot_statistics()) == {"observation.images.image", "observation.images.image2"}


def test_losses_of_windows_and_distillation() -> None:
    one, data = policy(), dataset()
    one.meet_task(data, "text")
    batch = data.batch(torch.arange(4))
    losses = one.eval().window_losses(batch)
    assert losses.shape == (4,) and losses.requires_grad
    modes = [module.training for module in one.train().modules()]
    chunk = one.predict(batch)
    assert chunk.shape == (4, 8, 7) and chunk.requires_grad
    assert [module.training for module in one.modules()] == modes
    with pytest.raises(PolicyError, match="no mean action"):
        policy("diffusion").predict(batch)


def test_learning_rates_are_lerobots() -> None:
    one = policy(settings=SMALL["act"] | {"optimizer_lr": 1e-4, "optimizer_lr_backbone": 1e-5})
    optimizer = _make_optimizer(
        list(one.parameters()), FitSettings(epochs=1, lr=1e-3), one.named_parameters(), one.rate_factors()
    )
    factors = {group["factor"]: len(group["params"]) for group in optimizer.param_groups}
    backbone = sum(name.startswith("model.backbone") for name, _ in one.inner.named_parameters())
    assert factors == {1e-5 / 1e-4: backbone, 1.0: len(list(one.parameters())) - backbone}


def test_weights_and_statistics_of_stock_lerobot_identify_an_evaluated_policy() -> None:
    inner = policy().inner

    def digest(mean: float) -> str | None:
        stats = {"action": {"mean": torch.full((7,), mean), "std": torch.ones(7)}}
        processors = factory.make_pre_post_processors(inner.config, dataset_stats=stats)
        return weights_digest(SimpleNamespace(policy=inner, processors=processors))

    first = digest(0.0)
    assert first == digest(0.0) != digest(1.0)
    with torch.no_grad():
        next(inner.parameters()).view(-1)[0] += 1.0
    assert digest(0.0) != first


def test_chunks_do_not_depend_on_what_else_is_simulated() -> None:
    one = policy("diffusion").eval()
    seen = fake_observation(one.spec, 3, torch.Generator().manual_seed(0), steps=1)
    draws = lambda *numbers: [torch.Generator().manual_seed(n) for n in numbers]  # noqa: E731
    one.reset(3)
    together = one.act(seen, draws(1, 2, 3))
    one.reset(1)
    part = type(seen)(seen.images[1:2], {k: v[1:2] for k, v in seen.proprio.items()}, seen.language[1:2])
    assert torch.allclose(one.act(part, draws(2)), together[1:2], atol=1e-5)


@pytest.mark.parametrize(("changes", "words"), [
    ({"settings": {"dim_modle": 3}},
     "policy.settings.dim_modle is not a setting of LeRobot's act; valid: .*dim_model"),
    ({"settings": {"vision_backbone": "vgg"}}, "LeRobot refuses its settings: .*vgg"),
    ({"settings": {"chunk_size": 4, "n_action_steps": 4}}, "set data.seq_len=4"),
    ({"settings": {"n_action_steps": 4}, "act_steps": 2}, "policy.act_steps is policy.settings.n_action_steps"),
    ({"pretrained": "x", "act_steps": 2}, "leave out policy.act_steps, policy.settings"),
])  # fmt: skip
def test_settings_that_are_not_valid_are_named(changes, words) -> None:
    with pytest.raises(ConfigError, match=words):
        policy(**changes)


@pytest.mark.parametrize("algo", ["clare", "iscil", "dmpel", "m2distill", "mlr"])
def test_algorithms_that_need_other_layers_say_so(algo) -> None:
    algorithm = build(composed(f"algo={algo}").algo)
    with pytest.raises(PolicyError, match="LeRobotPolicy"):
        algorithm.begin_task(0, dataset(), policy())


def make_smolvlm(folder) -> str:
    """Write the configuration and the words of a vision-language model of two layers, without weights."""
    transformers, tokenizers = pytest.importorskip("transformers"), pytest.importorskip("tokenizers")
    special = {
        "image_token": "<image>", "fake_image_token": "<fake>",
        "global_image_token": "<global>", "end_of_utterance_token": "<end>",
    }  # fmt: skip
    words = [
        "<unk>",
        "<pad>",
        "<s>",
        "</s>",
        *special.values(),
        *["pick", "up", "the", "soup", "cream", "cheese"],
    ]
    model = tokenizers.models.WordLevel({word: k for k, word in enumerate(words)}, unk_token="<unk>")
    tokenizer = tokenizers.Tokenizer(model)
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    names = {"unk_token": "<unk>", "pad_token": "<pad>", "bos_token": "<s>", "eos_token": "</s>"}
    fast = transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, extra_special_tokens=special, **names
    )
    size = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 2}
    text = {"model_type": "llama", "vocab_size": len(words), "num_key_value_heads": 1, "head_dim": 16}
    seen = {"image_size": 64, "patch_size": 16}
    ids = {"image_token_id": words.index("<image>"), "pad_token_id": words.index("<pad>")}
    config = transformers.SmolVLMConfig(
        text_config=size | text, vision_config=size | seen, scale_factor=2, **ids
    )
    config.save_pretrained(folder)
    images, videos = transformers.SmolVLMImageProcessor(), transformers.SmolVLMVideoProcessor()
    transformers.SmolVLMProcessor(images, fast, videos, image_seq_len=4).save_pretrained(folder)
    return str(folder)


def test_smolvla_learns_two_tasks_from_random_weights(tmp_path) -> None:
    settings = {
        "vlm_model_name": make_smolvlm(tmp_path), "load_vlm_weights": False, "num_vlm_layers": 2, "num_steps": 2,
        "resize_imgs_with_padding": [64, 64], "train_expert_only": False, "freeze_vision_encoder": False,
    }  # fmt: skip
    one = policy("smolvla", settings=settings, language=False)
    optimizer, tasks = torch.optim.AdamW(one.parameters(), 3e-3), [dataset(seed=k) for k in range(2)]
    for task, instruction in zip(tasks, ("pick up the soup", "pick up the cream cheese"), strict=True):
        one.meet_task(task, instruction)
        one.normalise(moments(task), once=True)
        losses = []
        for _ in range(12):
            torch.manual_seed(0)  # the same noise
            losses.append(one.train().loss(task.batch(torch.arange(4))))
            optimizer.zero_grad()
            losses[-1].backward()
            optimizer.step()
        assert losses[-1] < 0.8 * losses[0]
        assert action_costs(one, task.language)["flops_per_action"] > 0
    seen = fake_observation(spec(), 2, torch.Generator().manual_seed(0), steps=1)
    seen = replace(seen, language=torch.stack([task.language for task in tasks]))
    one.eval().reset(2)
    acted = one.act(seen, [torch.Generator().manual_seed(k) for k in range(2)])
    assert acted.shape == (2, 7) and one.instructions(seen.language)[1] == "pick up the cream cheese"


def test_the_configuration_builds_it() -> None:
    words = (
        "policy=lerobot",
        "data.seq_len=10",
        "+policy.settings={dim_model: 32, n_heads: 2, dim_feedforward: 64}",
    )
    config = composed(*words)
    built = build(config.policy, spec=spec(10))
    assert isinstance(built, LeRobotPolicy) and built.inner.config.chunk_size == 10


@pytest.mark.parametrize("type", SMALL)
def test_a_chunk_is_what_lerobot_would_execute(type) -> None:
    acts, plans, late = policy(type), policy(type), policy(type)
    assert plans.execute == plans.chunk == (7 if type == "diffusion" else 8)
    seen = [fake_observation(acts.spec, 3, torch.Generator().manual_seed(k), steps=1) for k in range(9)]
    draws = lambda: [torch.Generator().manual_seed(5 + k) for k in range(3)]  # noqa: E731
    for one in (acts, plans, late):
        one.eval().reset(3)
    chunk = plans.plan(seen[0], [0, 2], draws())
    for step in range(plans.chunk):
        assert torch.equal(chunk[:, step], acts.act(seen[step], draws())[[0, 2]])
    for step in (1, 2):  # nobody asks, and the frames are in its history
        assert plans.plan(seen[step], [], draws()).shape[0] == 0
    late.plan(seen[2], [], draws())
    again = plans.plan(seen[3], [1], draws())
    assert torch.equal(again, late.plan(seen[3], [1], draws())) and not torch.equal(again[0], chunk[0])


def test_a_run_is_built_from_what_it_saved_where_it_began_with_weights_from_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:1")
    saved = policy()
    saved.save_beside(tmp_path)
    named = LeRobotPolicy.saved_arguments({"pretrained": "stranger/model"}, tmp_path)["pretrained"]
    assert named == str(tmp_path / FOLDER)
    with torch.device("meta"):  # how large it is
        assert policy(settings={}, pretrained=named).state_dict().keys() == saved.state_dict().keys()
    built = policy(settings={}, pretrained=named).inner.state_dict()
    assert all(torch.equal(built[name], value) for name, value in saved.inner.state_dict().items())


@pytest.mark.parametrize("kind", ["image", "video"])
def test_a_data_set_that_lerobot_writes_is_read(kind, tmp_path, monkeypatch) -> None:
    """In the features of lerobot/libero, so its images are mirrored."""
    monkeypatch.setenv("LIBERO_CACHE", str(tmp_path / "cache"))
    tasks, episodes = get_suite("libero_object").tasks[:2], [episode(k, 9, 64) for k in range(3)]
    layout = PUBLISHED["lerobot/libero"]
    shapes = dict.fromkeys(layout.cameras.values(), (64, 64, 3))
    kinds = {
        key: {"dtype": kind, "shape": shape, "names": ["height", "width", "channel"]}
        for key, shape in shapes.items()
    }
    numbers = {layout.state: (8, layout.state_names), layout.action: (7, layout.action_names)}
    kinds |= {
        key: {"dtype": "float32", "shape": (n,), "names": list(names)} for key, (n, names) in numbers.items()
    }
    ramp = np.linspace(0, 180, 64)[None, :, None] * np.ones((64, 1, 3))  # which videos preserve
    written = lerobot_module("datasets.lerobot_dataset").LeRobotDataset.create(
        "me/mine", fps=10, features=kinds, root=tmp_path / "set", use_videos=kind == "video"
    )
    for number, one in enumerate(episodes):
        for step in range(9):
            state = np.concatenate([one.obs[key][step] for key in ("ee_pos", "ee_ori", "gripper_states")])
            frame = {
                layout.state: state.astype(np.float32),
                layout.action: one.actions[step].astype(np.float32),
            }
            frame |= {key: (ramp + 5 * step + number).astype(np.uint8) for key in shapes}
            written.add_frame(frame | {"task": tasks[number % 2].language})
        written.save_episode()
    written.finalize()
    counts = {tasks[0].id: 2, tasks[1].id: 1}
    paths = lerobot_files(tmp_path / "set", tasks, counts, "executed")
    read = [demo for path in paths for demo in read_demos(path)]
    for demo, number in zip(read, (0, 2, 1), strict=True):
        np.testing.assert_array_equal(demo.actions, episodes[number].actions.astype(np.float32))
        np.testing.assert_array_equal(demo.obs["ee_ori"], episodes[number].obs["ee_ori"].astype(np.float32))
        for step in range(9):
            shown = (ramp + 5 * step + number).astype(np.uint8).astype(int)[:, ::-1]
            for key in ("agentview_rgb", "eye_in_hand_rgb"):
                assert np.abs(demo.obs[key][step] - shown).max() <= (0 if kind == "image" else 12)
