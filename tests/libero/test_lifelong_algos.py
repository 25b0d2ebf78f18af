"""The original's algorithms, and users' subclasses. Success rates are given, so nothing is simulated."""

import copy
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch import nn
from torch.utils.data import DataLoader

from libero._adapters.config import Config, plain
from libero.lifelong import algos, metric, utils
from libero.lifelong.algos import cycle, merge_datas
from libero.lifelong.metric import evaluate_loss
from libero.lifelong.models.base_policy import BasePolicy, get_policy_class
from libero.lifelong.models.modules.language_modules import MLPEncoder
from libero.lifelong.models.modules.rgb_modules import ResnetEncoder
from libero.lifelong.models.policy_head import GMMHead
from libero_env.errors import LiberoError
from tests.harness.facade_learning import tiny, windows, write_demos

GROUPS = ("base", "single_task", "er", "agem", "ewc", "packnet")


class Tasks:
    """The part of a benchmark that learning uses."""

    n_tasks = 2
    task_embs = (None, None)

    def get_task(self, i):
        return i

    def get_task_emb(self, i):
        return self.task_embs[i]


@pytest.fixture(autouse=True)
def workplace(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def succeed(monkeypatch):
    """Return a function that sets the success rates of the next evaluations, and records the calls."""
    asked = []

    def give(*rates):
        given = iter(rates)

        def success(cfg, algo, task, emb, task_id, sim_states=None, task_str=""):
            asked.append(task_id)
            return next(given)

        monkeypatch.setattr(metric, "evaluate_one_task_success", success)
        return asked

    return give


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("demos")
    return [write_demos(folder / f"{i}.hdf5", seed=i) for i in range(2)]


def learner(files, group: str = "base", *overrides: str):
    small = ("train.use_augmentation=false", "+policy.native.encoder.width=8")
    cfg = tiny(f"lifelong={group}", *small, *overrides)
    data = [windows(file, cfg, seed) for seed, file in enumerate(files)]
    torch.manual_seed(0)
    return algos.get_algo_class(cfg.lifelong.algo)(len(data), cfg), data, cfg


def weights(algo) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in algo.policy.named_parameters()}


def test_observe_is_one_step_of_the_optimiser(files):
    """The step is AdamW on the clipped gradient of the scaled loss."""
    words = ("train.grad_clip=0.1", "policy.transformer_dropout=0", "train.loss_scale=3")
    algo, data, cfg = learner(files, "base", *words)
    batch = next(iter(DataLoader(data[0], 4)))
    algo.start_task(0)
    twin = copy.deepcopy(algo.policy)
    optimizer = torch.optim.AdamW(twin.parameters(), lr=1e-4, betas=(0.9, 0.999), weight_decay=1e-4)
    loss = twin.compute_loss(batch)
    (3 * loss).backward()
    nn.utils.clip_grad_norm_(twin.parameters(), 0.1)
    optimizer.step()
    assert algo.eval_observe(batch) == pytest.approx(algo.observe(batch)) == pytest.approx(loss.item())
    assert all(torch.equal(a, b) for a, b in zip(twin.parameters(), algo.policy.parameters(), strict=True))


@pytest.mark.parametrize("group", GROUPS)
def test_two_tasks(group, files, succeed, capsys):
    """Every algorithm learns two tasks, keeps the best epoch, and writes the original's files."""
    asked = succeed(*[0.0, 0.5, 1.0, 0.5] * 4)
    post = ("lifelong.post_prune_epochs=1", "lifelong.post_eval_every=1") if group == "packnet" else ()
    algo, data, cfg = learner(files, group, "train.n_epochs=3", *post)
    algo.train()
    rows = [algo.learn_one_task(dataset, i, Tasks(), {}) for i, dataset in enumerate(data)]
    assert rows[0][0] == pytest.approx((0 + 0.5 + 1 + 1) / 4), "what follows the best counts as the best"
    stored, loaded, masks = utils.torch_load_model(f"{cfg.experiment_dir}/task1_model.pth")
    assert all(torch.equal(stored[n], p) for n, p in algo.policy.state_dict().items())
    assert loaded.lifelong.algo == cfg.lifelong.algo and (masks is not None) == (group == "packnet")
    curve = torch.load(f"{cfg.experiment_dir}/task0_auc.log")
    assert curve["success"].tolist() == [0.0, 0.5, 1.0, 0.5] and curve["loss"].shape == (4,)
    assert {*asked} == {0, 1}
    assert "epoch   3" in capsys.readouterr().out
    assert np.isfinite(evaluate_loss(cfg, algo, Tasks(), data)).all()
    algo.reset()


def test_the_curve_has_the_epochs_of_the_original(files, succeed):
    """The original's notebook takes forward transfer from n_epochs // eval_every + 1 points, and zeros otherwise."""
    succeed(0.0, 0.25, 0.5)
    algo, data, cfg = learner(files, "base", "train.n_epochs=3", "eval.eval_every=2")
    assert algo.learn_one_task(data[0], 0, Tasks(), {})[0] == pytest.approx(0.125)
    assert torch.load(f"{cfg.experiment_dir}/task0_auc.log")["success"].tolist() == [0.0, 0.25]
    kept, last = utils.torch_load_model(algo.checkpoint_path(0))[0], algo.policy.state_dict()
    assert all(torch.equal(kept[name], p) for name, p in last.items()), "the last epoch is the best"


def test_the_same_seed_gives_the_same_weights(files, succeed):
    succeed(*[0.0, 1.0] * 9)
    results = []
    for seed in (3, 3, 4):
        algo, data, _ = learner(files, "er", f"seed={seed}")
        torch.manual_seed(0)  # dropout
        algo.learn_all_tasks(data, Tasks(), {})
        results.append(weights(algo))
    same = [all(torch.equal(results[0][n], other[n]) for n in other) for other in results[1:]]
    assert same == [True, False]


def test_an_infinite_loss_names_the_keys_of_this_configuration(files, succeed):
    succeed(0.0)
    algo, data, _ = learner(files, "base")
    algo.observe = lambda batch: float("nan")
    with pytest.raises(LiberoError, match=r"train\.optimizer\.kwargs\.lr"):
        algo.learn_one_task(data[0], 0, Tasks(), {})


def test_windows_are_read_ahead_by_workers(files, succeed):
    """Worker processes read the same batches, and every window is observed once in an epoch."""
    succeed(*[0.0, 1.0] * 3)
    results, seen = [], []
    for workers in (0, 1):
        algo, data, cfg = learner(files, "base", f"train.num_workers={workers}", "train.batch_size=3")
        seen.clear()
        observe = algo.observe
        algo.observe = lambda batch, observe=observe: seen.extend(batch["actions"]) or observe(batch)
        algo.learn_one_task(data[0], 0, Tasks(), {})
        results.append(weights(algo))
        assert sorted(x.sum().item() for x in seen) == sorted(w["actions"].sum().item() for w in data[0])
    assert all(torch.equal(results[0][n], p) for n, p in results[1].items())


def test_er_replays_a_sample_of_each_task(files, succeed, monkeypatch):
    succeed(*[0.0, 1.0] * 9)
    algo, data, _ = learner(files, "er", "lifelong.n_memories=3")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    assert algo.hooks.memory.shares == {0: 3}
    seen = []
    monkeypatch.setattr(algo.policy, "forward", lambda d, f=algo.policy.forward: seen.append(d) or f(d))
    algo.start_task(1)
    algo.observe(next(iter(DataLoader(data[1], 4))))
    assert seen[0]["actions"].shape[0] == 8, "as many windows again"
    embs = seen[0]["task_emb"]
    assert (embs[:4] == data[1].task_emb).all() and (embs[4:] == data[0].task_emb).all()
    algo.end_task(data[1], 1, Tasks())
    assert algo.hooks.memory.shares == {0: 3, 1: 3}
    assert algo.hooks.memory._shares({0: 1, 1: 3}) == {0: 1, 1: 3}, "no more where another has fewer"
    batches = cycle(DataLoader(data[0], 2))
    pair = [next(batches) for _ in range(2)]
    joined = merge_datas(*pair)
    assert torch.equal(joined["actions"], torch.cat([batch["actions"] for batch in pair]))


def test_ewc_penalises_and_agem_projects(files, succeed):
    succeed(*[0.0, 1.0] * 9)
    algo, data, _ = learner(files, "ewc", "lifelong.e_lambda=7")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    assert algo.hooks.penalty(algo.policy).item() == 0
    with torch.no_grad():
        next(algo.policy.network.head.means.parameters()).add_(0.1)
    assert algo.hooks.penalty(algo.policy).item() > 0
    assert torch.isclose(7 * algo.penalty(), algo.hooks.penalty(algo.policy))
    before, algo.hooks.strength, algo.cfg.lifelong.e_lambda = algo.penalty(), 0.0, 0.0
    assert torch.equal(algo.penalty(), before) and before > 0
    algo, data, _ = learner(files, "agem")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    algo.start_task(1)
    before = weights(algo)
    algo.observe(next(iter(DataLoader(data[1], 4))))
    assert any(not torch.equal(before[n], p) for n, p in algo.policy.named_parameters())


def test_packnet_does_not_change_earlier_tasks(files, succeed):
    succeed(*[0.0, 1.0] * 9)
    algo, data, cfg = learner(files, "packnet", "lifelong.post_prune_epochs=1", "lifelong.post_eval_every=1")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    batch = next(iter(DataLoader(data[0], 4)))

    def means(one):
        with torch.no_grad():
            return one.policy.eval()(batch).mean

    first = means(algo.get_eval_algo(0))
    algo.learn_one_task(data[1], 1, Tasks(), {})
    assert torch.equal(means(algo.get_eval_algo(0)), first)
    assert not torch.equal(means(algo.get_eval_algo(1)), first)
    assert {v for m in algo.previous_masks.values() for v in m.unique().tolist()} == {0, 1, 2}
    stored, _, masks = utils.torch_load_model(f"{cfg.experiment_dir}/task1_model.pth")
    fresh, _, _ = learner(files, "packnet")
    fresh.policy.load_state_dict(stored)
    fresh.load_masks(masks, 1)
    assert torch.equal(means(fresh.get_eval_algo(0)), first), "and out of a checkpoint"


def test_single_task_keeps_one_policy_for_each_task(files, succeed):
    succeed(*[0.0, 1.0] * 9)
    algo, data, _ = learner(files, "single_task")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    first = weights(algo)
    algo.learn_one_task(data[1], 1, Tasks(), {})
    with algo.acting_on(0):
        assert all(torch.equal(first[n], p) for n, p in algo.policy.named_parameters())
    assert any(not torch.equal(first[n], p) for n, p in algo.policy.named_parameters())


def test_multitask_learns_all_at_once(files, monkeypatch):
    rates = iter([[0.0, 0.0], [1.0, 0.5], [0.0, 0.5]])
    monkeypatch.setattr(algos, "evaluate_success", lambda *_: np.array(next(rates)))
    algo, data, cfg = learner(files, "multitask", "lifelong.eval_in_train=true", "train.n_epochs=2")
    success, _ = algo.learn_all_tasks(data, Tasks(), {})
    assert success == pytest.approx((0 + 0.75 + 0.75) / 3)
    best, _, _ = utils.torch_load_model(f"{cfg.experiment_dir}/multitask_model_ep1.pth")
    kept, _, _ = utils.torch_load_model(f"{cfg.experiment_dir}/multitask_model.pth")
    assert all(torch.equal(best[n], kept[n]) for n in best)
    curve = torch.load(f"{cfg.experiment_dir}/multitask_auc.log")
    assert curve["success"].tolist() == [0.0, 0.75, 0.25] and curve["loss"].shape == (3,)


def test_checkpoints_of_multitask_runs_have_the_epoch_in_their_names(files):
    algo, data, cfg = learner(files, "multitask", "train.n_epochs=3", "eval.eval_every=2")
    algo.learn_all_tasks(data, Tasks(), {})
    names = {path.name for path in Path(cfg.experiment_dir).glob("multitask_model_ep*")}
    assert names == {f"multitask_model_ep{epoch}.pth" for epoch in (0, 2, 3)}


@pytest.mark.parametrize(
    ("group", "words"),
    [
        ("base", ["pretrain=true"]),
        ("base", ["eval.eval=false"]),
        ("multitask", ["pretrain=true", "lifelong.eval_in_train=true"]),
    ],
)
def test_nothing_is_evaluated_where_it_is_not_asked_for(files, group, words, succeed):
    succeed()  # an evaluation would ask for a rate that is not given
    algo, data, _ = learner(files, group, "train.n_epochs=1", *words)
    success, loss = algo.learn_all_tasks(data, Tasks(), {})
    assert success == 0 and np.isfinite(loss)


def test_schedulers_and_optimisers_are_torchs(files):
    words = ("optimizer.name=torch.optim.SGD", "scheduler.name=torch.optim.lr_scheduler.StepLR")
    without = ("~train.optimizer.kwargs.betas", "~train.scheduler.kwargs.eta_min")
    step = "+train.scheduler.kwargs.step_size=2"
    algo, _, _ = learner(files, "base", *(f"train.{word}" for word in words), *without, step)
    assert isinstance(algo.optimizer, torch.optim.SGD)
    assert isinstance(algo.scheduler, torch.optim.lr_scheduler.StepLR)
    with pytest.raises(LiberoError, match="AdamW"):
        learner(files, "base", "train.optimizer.name=os.system")


# --- users' subclasses


class MyPolicy(BasePolicy):
    """A policy assembled from the modules, as in the original's guide to algorithms."""

    def __init__(self, cfg, shape_meta):
        super().__init__(cfg, shape_meta)
        size, language = cfg.policy.embed_size, cfg.policy.language_encoder.network_kwargs
        encoder = partial(ResnetEncoder, output_size=size, language_dim=language.input_size)
        kwargs, shapes = cfg.policy.image_encoder.network_kwargs, shape_meta["all_shapes"]
        views = [name for name in shapes if "rgb" in name]
        encoders = {name: encoder(input_shape=shapes[name], **kwargs) for name in views}
        self.image_encoders, language.output_size = nn.ModuleDict(encoders), size
        self.language_encoder = MLPEncoder(**language)
        head = cfg.policy.policy_head
        head.network_kwargs.input_size, head.network_kwargs.output_size = size, shape_meta["ac_dim"]
        self.policy_head = GMMHead(**head.loss_kwargs, **head.network_kwargs)

    def forward(self, data):
        told, b = self.language_encoder(data), len(data["task_emb"])
        for name, encoder in self.image_encoders.items():
            x = data["obs"][name]
            langs = data["task_emb"].repeat_interleave(x.shape[1], 0)
            seen = encoder(x.flatten(0, 1), langs=langs).view(b, x.shape[1], -1)
            told = told.view(b, -1, told.shape[-1]) + seen
        return self.policy_head(told)


class MyLifelongAlgo(algos.Sequential):
    """Records every loss and the end of every task."""

    def __init__(self, n_tasks, cfg, **policy_kwargs):
        super().__init__(n_tasks=n_tasks, cfg=cfg, **policy_kwargs)
        self.datasets, self.losses = [], []
        self.checkpoint = self.fish = None  # as the original's EWC calls anchor and importance
        self.policy = MyPolicy(cfg, cfg.shape_meta)

    def observe(self, data):
        self.losses.append(super().observe(data))
        return self.losses[-1]

    def end_task(self, dataset, task_id, benchmark, env=None):
        self.datasets.append(dataset)


def test_a_user_defined_algorithm_and_policy(files, succeed):
    succeed(*[0.0, 1.0] * 9)
    assert algos.get_algo_class("MyLifelongAlgo") is MyLifelongAlgo
    with pytest.raises(LiberoError, match="AGEM"):
        algos.get_algo_class("lwf2")
    assert get_policy_class("MyPolicy") is MyPolicy
    _, data, cfg = learner(files)
    algo = utils.safe_device(MyLifelongAlgo(2, cfg), cfg.device)
    before = weights(algo)
    summary = {"S_fwd": np.zeros(2), "L_fwd": np.zeros(2)}
    for i in range(2):
        algo.train()
        summary["S_fwd"][i], summary["L_fwd"][i] = algo.learn_one_task(data[i], i, Tasks(), summary)
    assert algo.datasets == data and len(algo.losses) == 2 * 3  # nine windows in batches of four
    kept = {n for n, p in algo.policy.named_parameters() if torch.equal(before[n], p)}
    assert not [n for n in kept if "heat.bias" not in n]
    gflops, mparams = utils.compute_flops(algo, data[0], cfg)
    assert gflops > 0 and mparams == pytest.approx(sum(p.numel() for p in algo.policy.parameters()) / 1e6)


def test_other_kinds_of_configurations(files, succeed):
    """Hydra's configurations, closed to new keys, are accepted too."""
    succeed(*[0.0, 1.0] * 9)
    _, data, cfg = learner(files)
    composed = OmegaConf.create(plain(cfg))
    OmegaConf.set_struct(composed, True)
    del composed.experiment_dir, composed.experiment_name
    algo = algos.Sequential(2, composed)
    assert composed.experiment_dir.endswith("run_002")
    algo.learn_one_task(data[0], 0, Tasks(), {})
    _, stored, _ = utils.torch_load_model(f"{composed.experiment_dir}/task0_model.pth")
    assert isinstance(stored, Config) and stored.policy.embed_size == 8
