"""What the texts leave to the reader: names that stand in a block and are defined nowhere, written out small.

Each function takes the scope of a block and gives what is added to it.
"""

import random
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, default_collate

Scope = dict[str, Any]


class Replay:
    """The methods that `quick.4-3` calls and does not define; to be put before its class."""

    def mix_with_replay(self: Any, data: Dataset) -> Dataset:
        return data + self.memory_buffer

    def update_memory(self: Any, data: Dataset) -> None:
        self.memory_buffer += [data[i] for i in range(2)]

    def compute_loss(self: Any, batch: Scope) -> Tensor:
        return self.policy.compute_loss(self.map_tensor_to_device(batch))

    def ewc_loss(self: Any) -> Tensor:
        now = dict(self.policy.named_parameters())
        return sum((f * (now[n] - old).square()).sum() for n, (f, old) in self.fisher_info.items())

    def update_fisher(self: Any, dataloader: DataLoader) -> None:
        self.optimizer.zero_grad()
        self.compute_loss(next(iter(dataloader))).backward()
        self.fisher_info = {
            n: (p.grad.square(), p.detach().clone())
            for n, p in self.policy.named_parameters()
            if p.grad is not None
        }


def training_data(scope: Scope) -> Scope:
    """For `quick.4-3`: a loader of a few windows, and a configuration for a small policy."""
    from libero._adapters.config import load_config

    cfg = load_config(
        "device=cpu",
        "train.n_epochs=1",
        "train.use_augmentation=false",
        "policy.transformer_num_layers=1",
        "policy.image_encoder.network_kwargs.remove_layer_num=5",
    )
    cfg.shape_meta = scope["shape_meta"]
    cfg.policy.language_encoder.network_kwargs.input_size = scope["task_embs"].shape[-1]
    few = [torch.utils.data.Subset(dataset, range(4)) for dataset in scope["datasets"]]
    return {"cfg": cfg, "few": few, "dataloader": DataLoader(few[1], batch_size=2)}


def results(_: Scope) -> Scope:
    """For `quick.4-4`: an environment, episodes, a success matrix and the measures of 4.6."""
    from libero.libero.envs import OffScreenRenderEnv

    def create_env(task: Any) -> OffScreenRenderEnv:
        return OffScreenRenderEnv(bddl_file_name=task.bddl_file, use_camera_obs=False)

    def run_episodes(env: OffScreenRenderEnv, policy: Any, n_eval: int) -> float:
        env.reset()
        done = env.step(policy(n_eval))[2]
        env.close()
        return float(done)

    matrix = np.array([[0.9, 0.0], [0.5, 0.7]])
    return {
        "create_env": create_env,
        "run_episodes": run_episodes,
        "performance_matrix": matrix,
        "results": matrix,
        "checkpoints": [1, 2],
        "avg_performance": [0.9, 0.6],
        "compute_forgetting": lambda m: m[0, 0] - m[1, 0],
        "compute_forward_transfer": lambda m: m.diagonal().mean(),
    }


def small_model(_: Scope) -> Scope:
    """For `speed.2`: a model that gives its loss, and batches."""

    class Model(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.linear = nn.Linear(3, 1)

        def forward(self, x: Tensor) -> Tensor:
            return (self.linear(x) - 1).square().mean()

    torch.manual_seed(0)
    model = Model()
    before = model.linear.weight.detach().clone()
    optimizer = torch.optim.SGD(model.parameters(), lr=0.1)
    return {
        "torch": torch, "model": model, "optimizer": optimizer, "dataloader": [torch.ones(2, 3)] * 8,
        "before": before
    }  # fmt: skip


class Batches:
    """The methods that 4.4 calls and does not define; to be put before its class."""

    def _create_dataloader(self: Any, data: list[Scope], cfg: Any) -> DataLoader:
        """Windows with the action of their last step only, which is what the policy of 4.3 gives."""

        def last(windows: list[Scope]) -> Scope:
            batch = default_collate(windows)
            return {**batch, "actions": batch["actions"][:, -1]}

        return DataLoader(data, batch_size=cfg.train.batch_size, shuffle=True, collate_fn=last)

    def _prepare_obs(self: Any, batch: Scope) -> Scope:
        return {"rgb": batch["obs"]["agentview_rgb"]}

    def get_state(self: Any) -> Scope:
        return {"fisher_information": self.fisher_information, "replayed": len(self.replay_buffer)}


def short_windows(scope: Scope) -> Scope:
    """For 4.4: its imports, and the four first windows of two tasks, as a list that can be sampled from."""
    few = [[dataset[i] for i in range(4)] for dataset in scope["datasets"][:2]]
    return {"random": random, "torch": torch, "few": few}


def short_run(scope: Scope) -> Scope:
    """For 4.5: sizes of a run that takes seconds, the policy and the algorithm of the blocks before."""
    cfg, benchmark = scope["cfg"], scope["benchmark"]
    cfg.shape_meta, cfg.device, benchmark.n_tasks = scope["shape_meta"], "cpu", 2
    cfg.train.n_epochs, cfg.train.batch_size, cfg.train.save_freq = 1, 2, 1
    cfg.eval.n_eval, cfg.eval.max_steps, cfg.eval.eval_freq = 1, 3, 1

    class Completed(Batches, scope["CustomLifelongAlgorithm"]):
        pass

    policy = scope["CustomTransformerPolicy"](cfg, scope["shape_meta"])
    algorithm = Completed(2, cfg=cfg)
    algorithm.policy = policy
    algorithm.optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4)
    saved: dict[int, Any] = {}

    def prepare_obs_for_policy(obs: Scope) -> Scope:
        picture = torch.from_numpy(obs["agentview_image"].copy()).permute(2, 0, 1) / 255
        return {"rgb": picture[None, None]}

    return {
        "policy": policy,
        "algorithm": algorithm,
        "datasets": scope["few"],
        "saved": saved,
        "prepare_obs_for_policy": prepare_obs_for_policy,
        "save_results": lambda found, folder, task: saved.update({task: found}),
        "print_evaluation_results": print,
    }
