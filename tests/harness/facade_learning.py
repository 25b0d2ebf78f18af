"""Small demonstrations and settings for the facade's learning side."""

from pathlib import Path

import numpy as np
import torch

from libero._adapters.config import Config, load_config
from libero.libero.benchmark import Benchmark, get_benchmark
from libero.lifelong.datasets import SequenceVLDataset, get_dataset
from libero_env.demos.read import Episode
from libero_env.demos.write import DemoWriter

SIZE, LANGUAGE = 32, 16
TINY = (
    *("device=cpu", "data.seq_len=3", f"data.img_h={SIZE}", f"data.img_w={SIZE}", "train.num_workers=0"),
    *("policy.image_encoder.network_kwargs.remove_layer_num=5", "train.n_epochs=1", "train.batch_size=4"),
    *("policy.policy_head.network_kwargs.hidden_size=16", "eval.num_workers=0", "eval.n_eval=1"),
    *("eval.num_procs=1", "eval.max_steps=4", "eval.eval_every=1"),
)
TINY_TRANSFORMER = (
    "policy.embed_size=8", "policy.transformer_num_layers=1", "policy.transformer_num_heads=2",
    "policy.transformer_head_output_size=4", "policy.transformer_mlp_hidden_size=8",
    "policy.transformer_max_seq_len=3"
)  # fmt: skip


class TwoTasks(Benchmark):
    """The first two tasks of a suite, as users shorten one."""

    def __init__(self, task_order_index: int = 0):
        super().__init__(task_order_index)
        self.name, self.tasks, self.n_tasks = "two_tasks", get_benchmark("libero_object")().tasks[:2], 2


def tiny(*overrides: str) -> Config:
    """Return a configuration that trains in a second."""
    return load_config(*TINY, *TINY_TRANSFORMER, *overrides)


def write_demos(path: Path, lengths: tuple[int, ...] = (5, 4), seed: int = 0, size: int = SIZE) -> Path:
    """Write demonstrations of noise with the given lengths."""
    rng = np.random.default_rng(seed)
    writer = DemoWriter(path, {"pairing": "aligned"})
    for index, steps in enumerate(lengths):
        views, readings = ("agentview_rgb", "eye_in_hand_rgb"), {"joint_states": 7, "gripper_states": 2}
        obs = {view: rng.integers(0, 255, (steps, size, size, 3), np.uint8) for view in views}
        readings |= {"ee_pos": 3, "ee_ori": 3}
        obs |= {name: rng.normal(size=(steps, count)) for name, count in readings.items()}
        actions = rng.uniform(-1, 1, (steps, 7))
        writer.write(index, Episode(actions, np.zeros((steps, 5)), None, obs))
    return writer.finish()


def windows(path: Path, cfg: Config, seed: int = 0) -> SequenceVLDataset:
    """Return the windows of a file with an instruction; `cfg` receives its shapes."""
    dataset, cfg.shape_meta = get_dataset(path, cfg.data.obs.modality, seq_len=cfg.data.seq_len)
    cfg.policy.language_encoder.network_kwargs.input_size = LANGUAGE
    return SequenceVLDataset(dataset, torch.randn(LANGUAGE, generator=torch.Generator().manual_seed(seed)))
