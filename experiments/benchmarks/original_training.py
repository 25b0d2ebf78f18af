"""The original's loader and ResNet-T, timed; a worker of compare_training.py that the original's interpreter runs.

    python original_training.py FILE BATCH SEQ_LEN BATCHES STEPS THREADS

The last line of its output is JSON: windows per second of one loader process, seconds of a training step (the best), of
loading, augmentation and a step together, peak memory in bytes, and the policy's parameters.
"""

import json
import resource
import sys
import time
import types
from collections.abc import Iterator

import numpy as np
import torch
from easydict import EasyDict

np.bool = bool  # robomimic 0.2 writes it so, and numpy took it away

# torchvision's kernels are of no use here, and a build for another torch cannot register them.
sys.modules["torchvision._meta_registrations"] = types.ModuleType("torchvision._meta_registrations")

from libero.lifelong.datasets import SequenceVLDataset, get_dataset  # noqa: E402
from libero.lifelong.models import get_policy_class  # noqa: E402

MODALITY = {
    "rgb": ["agentview_rgb", "eye_in_hand_rgb"],
    "depth": [],
    "low_dim": ["gripper_states", "joint_states"],
}
POLICY = {  # the published settings
    "embed_size": 64,
    "extra_num_layers": 0,
    "extra_hidden_size": 128,
    "transformer_num_layers": 4,
    "transformer_num_heads": 6,
    "transformer_head_output_size": 64,
    "transformer_mlp_hidden_size": 256,
    "transformer_dropout": 0.1,
    "transformer_max_seq_len": 10,
    "image_encoder": {
        "network": "ResnetEncoder",
        "network_kwargs": {"remove_layer_num": 4, "no_stride": False, "language_fusion": "film"},
    },
    "language_encoder": {
        "network": "MLPEncoder",
        "network_kwargs": {"input_size": 768, "hidden_size": 128, "num_layers": 1},
    },
    "temporal_position_encoding": {
        "network": "SinusoidalPositionEncoding",
        "network_kwargs": {"inv_freq_factor": 10, "factor_ratio": None},
    },
    "policy_head": {
        "network": "GMMHead",
        "network_kwargs": {"hidden_size": 1024, "num_layers": 2, "min_std": 0.0001, "num_modes": 5},
        "loss_kwargs": {"loss_coef": 1.0},
    },
    "color_aug": {
        "network": "BatchWiseImgColorJitterAug",
        "network_kwargs": {
            "input_shape": None,
            **dict.fromkeys(("brightness", "contrast", "saturation", "hue"), 0.3),
            "epsilon": 0.1,
        },
    },
    "translation_aug": {"network": "TranslationAug", "network_kwargs": {"translation": 8}},
}


def endless(loader: torch.utils.data.DataLoader) -> Iterator[dict]:
    """Batches, pass after pass."""
    while True:
        yield from loader


def best(call, times: int) -> float:
    """Seconds of the fastest call, after one to warm up."""
    call()
    taken = []
    for _ in range(times):
        began = time.perf_counter()
        call()
        taken.append(time.perf_counter() - began)
    return min(taken)


def main(path: str, *numbers: str) -> None:
    """Measure the loader, a step, and all of training."""
    batch, seq_len, batches, steps, threads = map(int, numbers)
    torch.set_num_threads(threads)
    torch.manual_seed(0)
    windows, shapes = get_dataset(path, MODALITY, seq_len=seq_len)
    dataset = SequenceVLDataset(windows, torch.zeros(768))
    loader = endless(torch.utils.data.DataLoader(dataset, batch, shuffle=True, drop_last=True))
    data = {"obs": {"modality": MODALITY}, "use_joint": True, "use_gripper": True, "use_ee": False}
    cfg = EasyDict(device="cpu", policy=POLICY, data=data, train={"use_augmentation": False})
    policy = get_policy_class("BCTransformerPolicy")(cfg, shapes).train()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-4, weight_decay=1e-4)

    def step(found: dict, augment: bool) -> None:
        cfg.train.use_augmentation = augment
        loss = policy.compute_loss(found)
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 100.0)
        optimizer.step()

    rate = batch / best(lambda: next(loader), batches)
    held = next(loader)
    found = {
        "windows": rate,
        "step": best(lambda: step(held, False), steps),
        "all": best(lambda: step(next(loader), True), steps),
        "memory": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        "parameters": sum(p.numel() for p in policy.parameters()),
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
