"""The original's helpers of a run: seeds, devices, checkpoints, costs."""

import copy
import json
import pickle
import random
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset, default_collate

from libero._adapters.config import Config, assign, plain
from libero_env.storage import atomic_path
from lifelong.errors import CheckpointError
from lifelong.language import LanguageEncoder
from lifelong.training.costs import count_flops


def control_seed(seed: int) -> None:
    """Seed the global generators of Python, NumPy and PyTorch, and let cuDNN choose algorithms that repeat."""
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002 - what the name promises
    torch.manual_seed(seed)
    torch.backends.cudnn.deterministic = True


def available_device(device: Any) -> torch.device:
    """Return the requested device (an integer is a GPU's number), or the CPU if there is no GPU."""
    requested = torch.device(f"cuda:{device}" if isinstance(device, int) else device or "cpu")
    return torch.device("cpu") if requested.type == "cuda" and not torch.cuda.is_available() else requested


def safe_device(x: Any, device: str | torch.device = "cpu") -> Any:
    """Return a tensor or a module on a device, or on the CPU if there is no GPU."""
    return x.to(available_device(device))


class NpEncoder(json.JSONEncoder):
    """Encodes NumPy and PyTorch arrays as lists, their scalars as numbers."""

    def default(self, o: Any) -> Any:
        return o.tolist() if isinstance(o, np.ndarray | Tensor | np.generic) else super().default(o)


def torch_save_model(model: nn.Module, model_path: Any, cfg: Any = None, previous_masks: Any = None) -> None:
    """Write a model's weights, with its configuration and PackNet's masks as plain data, in one step."""
    stored = {"state_dict": dict(model.state_dict()), "cfg": plain(cfg), "previous_masks": previous_masks}
    with atomic_path(Path(model_path)) as temporary, open(temporary, "wb") as file:
        torch.save(stored, file)


def torch_load_model(model_path: Any, map_location: Any = None) -> tuple[dict[str, Tensor], Any, Any]:
    """Read a file of `torch_save_model`: weights, configuration, masks. Nothing in the file is executed.

    Raises:
        CheckpointError: The file does not exist, is broken, or holds objects other than tensors and plain data.
    """
    try:
        stored = torch.load(model_path, map_location=available_device(map_location), weights_only=True)
        cfg = stored.get("cfg")
        return stored["state_dict"], None if cfg is None else Config(cfg), stored.get("previous_masks")
    except (OSError, pickle.UnpicklingError, EOFError, KeyError, RuntimeError) as error:
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise CheckpointError(
            f"{model_path} cannot be read ({first}); expected a file of torch_save_model, which holds tensors and "
            "plain data only"
        ) from error


def confidence_interval(p: float, n: int) -> float:
    """Return half the width of the original's 95 % interval of a success rate p of n episodes, which is 0 for p = 1.

    It is the normal approximation; `lifelong.stats.intervals.wilson_interval` holds for few episodes and all p.
    """
    return float(1.96 * np.sqrt(p * (1 - p) / n))


def compute_flops(algo: Any, dataset: Dataset, cfg: Any) -> tuple[float, float]:
    """Return the floating-point operations of one forward pass on a window, [1e9], and the parameters, [1e6]."""
    policy = copy.deepcopy(algo.policy).eval()
    window = algo.map_tensor_to_device(default_collate([dataset[0]]))
    with torch.no_grad(), count_flops() as counter:
        policy(policy.preprocess_input(window, train_mode=True))
    gflops, mparams = counter.get_total_flops() / 1e9, sum(p.numel() for p in policy.parameters()) / 1e6
    print(f"[info] policy: {gflops:.3f} GFLOPs, {mparams:.3f} M parameters")
    return gflops, mparams


def create_experiment_dir(cfg: Any) -> str:
    """Create a folder `experiments/<benchmark>/<algorithm>/<policy>_seed<seed>/run_<number>` and return its path.

    `cfg.experiment_dir` receives it, `cfg.experiment_name` its name on one line. Runs from given weights, of another
    order of tasks, or with other embeddings are in folders such as `experiments_finetune_permute3_clip`.
    """
    embedding, order = cfg.task_embedding_format.replace("-", ""), cfg.data.task_order_index
    marks = ["finetune"] * bool(cfg.get("pretrain_model_path")) + [f"permute{order}"] * bool(order)
    marks += [embedding] * (embedding in ("onehot", "clip", "gpt2", "roberta"))
    name = f"{cfg.policy.policy_type}_seed{cfg.seed}"
    root = Path("_".join(["experiments", *marks]), cfg.benchmark_name, cfg.lifelong.algo, name)
    numbers = (path.name.rpartition("_")[2] for path in root.glob("run_*"))
    for number in count(1 + max((int(text) for text in numbers if text.isdigit()), default=0)):
        path = root / f"run_{number:03d}"
        with suppress(FileExistsError):  # another process was first
            path.mkdir(parents=True)
            break
    assign(cfg, "experiment_dir", str(path))
    assign(cfg, "experiment_name", "_".join(path.parts[-4:]))
    return str(path)


def get_task_embs(cfg: Any, descriptions: list[str]) -> Tensor:
    """Return embeddings of instructions, (N, L); the language encoder's `input_size` is set to L.

    `task_embedding_format` is minilm (comes with the package), bert, clip, gpt2, roberta (their weights are needed),
    or one-hot: task i is number `task_embedding_one_hot_offset` + i.

    Raises:
        LanguageError: The format is unknown, or its weights cannot be obtained; the message names the remedy.
    """
    if cfg.task_embedding_format == "one-hot":
        offset = int(cfg.task_embedding_one_hot_offset)
        embs = torch.eye(offset + len(descriptions))[offset:]
    else:
        embs = LanguageEncoder(cfg.task_embedding_format).embed(descriptions)
    assign(cfg.policy.language_encoder.network_kwargs, "input_size", embs.shape[-1])
    return embs
