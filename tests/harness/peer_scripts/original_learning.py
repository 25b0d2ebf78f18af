"""LIBERO's own code on given weights and a given batch: losses, gradients, steps; run by an interpreter that has it.

    python original_learning.py SOURCE JOB OUT

SOURCE is a checkout of Lifelong-Robot-Learning/LIBERO, JOB an .npz that `tests/harness/original.py` writes, OUT the
.npz of the results. Weights and results have the names of LIBERO's modules. The simulator is not needed: what
evaluates is imported, and never called.
"""

import os
import sys
import tempfile
import types
from pathlib import Path

import numpy as np

np.bool = bool  # robomimic 0.2 writes it so, and numpy took it away

# torchvision's kernels are of no use here, and a build for another torch cannot register them.
sys.modules["torchvision._meta_registrations"] = types.ModuleType("torchvision._meta_registrations")


def prepare(source: Path) -> None:
    """Make `libero` that of the checkout, with stand-ins for its simulator."""
    folder = Path(tempfile.mkdtemp())
    (folder / "config.yaml").write_text(f"benchmark_root: {source}/libero/libero\n")
    os.environ["LIBERO_CONFIG_PATH"] = str(folder)
    package = types.ModuleType("libero")
    package.__path__ = [str(source / "libero")]
    sys.modules["libero"] = package
    envs = types.ModuleType("libero.libero.envs")
    for name in ("OffScreenRenderEnv", "SubprocVectorEnv", "DummyVectorEnv"):
        setattr(envs, name, None)
    sys.modules["libero.libero.envs"] = envs
    video = types.ModuleType("libero.libero.utils.video_utils")
    video.VideoWriter = None
    sys.modules["libero.libero.utils.video_utils"] = video


def configuration(source: Path, job, algorithm: str):
    """Return the configuration of the published runs, as LIBERO's main composes it."""
    import yaml
    from easydict import EasyDict
    from hydra import compose, initialize_config_dir
    from omegaconf import OmegaConf

    with initialize_config_dir(str(source / "libero" / "configs"), version_base=None):
        composed = compose("config", [f"policy={job['policy']}_policy", f"lifelong={algorithm}"])
    cfg = EasyDict(yaml.safe_load(OmegaConf.to_yaml(composed)))
    cfg.train.scheduler.kwargs.eta_min = float(cfg.train.scheduler.kwargs.eta_min)
    cfg.device, cfg.experiment_dir = "cpu", tempfile.mkdtemp()
    cfg.train.num_workers = 0
    cfg.train.use_augmentation = False
    cfg.data.img_h, cfg.data.img_w = map(int, job["first/images"].shape[3:5])
    if "transformer_max_seq_len" in cfg.policy:
        cfg.policy.transformer_max_seq_len = int(job["seq_len"])
    shape = [3, cfg.data.img_h, cfg.data.img_w]
    shapes = {"agentview_rgb": shape, "eye_in_hand_rgb": shape, "gripper_states": [2], "joint_states": [7]}
    cfg.shape_meta = {"ac_dim": 7, "all_shapes": shapes}
    return cfg


def load(policy, job) -> None:
    """Put the job's weights and statistics into a policy; none may be left over on either side."""
    import torch

    given = {
        k.removeprefix("weight/"): torch.from_numpy(v) for k, v in job.items() if k.startswith("weight/")
    }
    fixed = ("pos_x", "pos_y", "inv_freq", "num_batches_tracked")
    twice = "extra_encoder.proprio_mlp."  # another name of the last modality's encoder
    missing, unexpected = policy.load_state_dict(given, strict=False)
    left = [n for n in missing if not n.endswith(fixed) and not n.startswith(twice)]
    if left or unexpected:
        raise SystemExit(f"no weights for {left}, no place for {unexpected}")


def batch(job, label: str = "first") -> dict:
    """Return a batch as LIBERO's loader gives it."""
    import torch

    pictures = torch.from_numpy(job[f"{label}/images"]).float().div(255.0)  # (B, T, V, H, W, 3)
    views = pictures.permute(2, 0, 1, 5, 3, 4)
    obs = {"agentview_rgb": views[0].clone(), "eye_in_hand_rgb": views[1].clone()}
    obs |= {name: torch.from_numpy(job[f"{label}/{name}"]) for name in ("gripper_states", "joint_states")}
    return {
        "obs": obs,
        "task_emb": torch.from_numpy(job[f"{label}/language"]),
        "actions": torch.from_numpy(job[f"{label}/actions"]),
    }


def without_dropout(policy) -> None:
    """Switch all dropout off."""
    import torch

    for module in policy.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
        if hasattr(module, "drop_prob"):
            module.drop_prob = 0.0


def replace_draws(seed: int, columns: np.ndarray) -> None:
    """Let dropout draw from a generator that both sides have; `columns` is where a token's entries lie here."""
    import torch

    draws = np.random.RandomState(seed)

    def dropout(x, p=0.5, training=True, inplace=False):
        if not training or not p:
            return x
        kept = draws.random_sample(tuple(x.shape)) >= p
        kept = kept[..., columns] if x.shape[-1] == len(columns) else kept
        return x * torch.from_numpy(kept) / (1 - p)

    def bernoulli_(self, p):
        return self.copy_(torch.from_numpy(draws.random_sample(tuple(self.shape)) < p))

    torch.nn.functional.dropout, torch.Tensor.bernoulli_ = dropout, bernoulli_


def gradients(policy, kind: str) -> dict:
    """Return the gradients of all parameters, under all of their names."""
    named = policy.named_parameters(remove_duplicate=False)
    return {
        f"{kind}/{n}": np.zeros(p.shape, np.float32) if p.grad is None else p.grad.numpy().copy()
        for n, p in named
    }


def state(policy, kind: str) -> dict:
    """Return weights and running statistics."""
    return {f"{kind}/{n}": t.detach().numpy().copy() for n, t in policy.state_dict().items()}


def learn(cfg, job) -> dict:
    """Return what one step and acting give, of plain fine-tuning."""
    import torch

    from libero.lifelong.algos import get_algo_class

    algo = get_algo_class("Sequential")(10, cfg)
    load(algo.policy, job)
    found = {}
    with torch.no_grad():
        found["eval_loss"] = algo.policy.eval().compute_loss(batch(job)).numpy()
    found |= acts(algo.policy, job)
    algo.start_task(0)
    algo.policy.train()
    without_dropout(algo.policy)
    found["loss"] = np.float32(algo.observe(batch(job)))
    found |= gradients(algo.policy, "clipped") | state(algo.policy, "stepped")
    rates = [algo.optimizer.param_groups[0]["lr"]]
    for _ in range(cfg.train.n_epochs):
        algo.scheduler.step()
        rates.append(algo.optimizer.param_groups[0]["lr"])
    found["rates"] = np.array(rates)
    load(algo.policy, job)
    algo.policy.train().zero_grad()
    algo.policy.compute_loss(batch(job)).backward()
    return found | gradients(algo.policy, "gradient")


def acts(policy, job) -> dict:
    """Return the distribution of the action at each frame of an episode."""
    import torch

    seen, head = [], policy.policy_head.forward
    policy.policy_head.forward = lambda x: seen.append(head(x)) or seen[-1]
    policy.eval()
    policy.reset()
    episode = batch(job, "episode")
    for step in range(episode["actions"].shape[1]):
        frame = {name: value[:, step] for name, value in episode["obs"].items()}
        policy.get_action({"obs": frame, "task_emb": episode["task_emb"]})
    policy.policy_head.forward = head
    normal = [d.component_distribution.base_dist for d in seen]
    flat = lambda tensors: torch.stack([t.reshape(len(t), *t.shape[-2:]) for t in tensors], 1).numpy()  # noqa: E731
    logits = [d.mixture_distribution.logits for d in seen]
    found = {"act_means": flat([n.loc for n in normal]), "act_stds": flat([n.scale for n in normal])}
    return found | {"act_logits": torch.stack([x.reshape(len(x), -1) for x in logits], 1).numpy()}


def with_dropout(cfg, job) -> dict:
    """Return loss and gradients in training mode, dropout drawn from a generator that both sides have."""
    from libero.lifelong.algos import get_algo_class

    policy = get_algo_class("Sequential")(10, cfg).policy
    load(policy, job)
    replace_draws(7, job["columns"])
    loss = policy.train().compute_loss(batch(job))
    loss.backward()
    return {"dropout_loss": loss.detach().numpy()} | gradients(policy, "dropout_gradient")


def ewc(cfg, job) -> dict:
    """Return EWC's Fisher information after a task of two batches, and a step of the next one."""
    import torch

    from libero.lifelong.algos import get_algo_class

    class Rows(torch.utils.data.Dataset):
        def __len__(self):
            return 2 * len(job["first/actions"])

        def __getitem__(self, index):
            which, row = divmod(index, len(job["first/actions"]))
            part = batch(job, ("first", "second")[which])
            obs = {name: value[row] for name, value in part["obs"].items()}
            return {"obs": obs, "task_emb": part["task_emb"][row], "actions": part["actions"][row]}

    algo = get_algo_class("EWC")(10, cfg)
    load(algo.policy, job)
    without_dropout(algo.policy)
    cfg.train.batch_size = 1  # so that the order of the windows, which is random, changes nothing
    algo.start_task(0)
    algo.end_task(Rows(), 0, None)
    sizes = [(n, p.shape, p.numel()) for n, p in algo.policy.named_parameters()]
    parts = algo.fish.split([size for *_, size in sizes])
    found = {
        f"fisher/{n}": f.reshape(shape).numpy().copy() for (n, shape, _), f in zip(sizes, parts, strict=True)
    }
    algo.start_task(1)
    with torch.no_grad():
        for p in algo.policy.parameters():
            p.mul_(1.01)
    found["penalty"] = (cfg.lifelong.e_lambda * algo.penalty()).detach().numpy()
    found["ewc_loss"] = np.float32(algo.observe(batch(job)))
    return found | gradients(algo.policy, "ewc_clipped")


def packnet(cfg, job) -> dict:
    """Return PackNet's weights after a step of each of two tasks and the pruning between them, and the owners."""
    from libero.lifelong.algos import get_algo_class

    algo = get_algo_class("PackNet")(10, cfg)
    load(algo.policy, job)
    without_dropout(algo.policy)
    algo.start_task(0)
    algo.policy.train()
    algo.observe(batch(job))
    found = state(algo.policy, "packnet_first")
    algo.prune()
    names = [n for n, _ in algo.policy.named_modules()]
    found |= {f"owner/{names[i]}.weight": mask.numpy().copy() for i, mask in algo.previous_masks.items()}
    found |= state(algo.policy, "packnet_pruned")
    algo.start_task(1)
    algo.policy.train()
    algo.observe(batch(job, "second"))
    return found | state(algo.policy, "packnet_second")


def augmentation(cfg, job) -> dict:
    """Return many augmented pictures of one window."""
    import torch

    from libero.lifelong.models import get_policy_class

    torch.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - which their augmentation reads
    policy = get_policy_class("BCTransformerPolicy")(cfg, cfg.shape_meta).train()
    cfg.train.use_augmentation = True
    window = batch(job)
    copies = int(job["copies"])
    obs = {n: v[:1].expand(copies, *v.shape[1:]).contiguous() for n, v in window["obs"].items()}
    seen = policy.preprocess_input({"obs": obs})["obs"]
    views = [seen[name].permute(0, 1, 3, 4, 2) for name in ("agentview_rgb", "eye_in_hand_rgb")]
    return {"augmented": torch.stack(views, 2).numpy()}


def main(source: str, job_file: str, out: str) -> None:
    """Run the parts that the job names."""
    root = Path(source).resolve()
    prepare(root)
    with np.load(job_file) as stored:
        job = dict(stored)
    import torch

    torch.set_num_threads(1)
    parts = {
        "learn": "base", "with_dropout": "base", "ewc": "ewc", "packnet": "packnet", "augmentation": "base"
    }  # fmt: skip
    found: dict = {}
    for part in str(job["parts"]).split():
        found |= globals()[part](configuration(root, job, parts[part]), job)
    first, second = "extra_encoder.proprio_mlp.", "extra_encoder.encoders.1."  # one module of two names
    np.savez(out, **{name.replace(first, second): value for name, value in found.items()})


if __name__ == "__main__":
    main(*sys.argv[1:])
