"""A run of the original's configuration: data, algorithm, the sequence of tasks, and what it leaves on disk.

result.pt                L_conf_mat, S_conf_mat (K, K), L_fwd, S_fwd (K,), as tensors
task<k>_model.pth        the policy after task k; see libero.lifelong.utils.torch_save_model
task<k>_auc.log          success and loss while task k was learned
task<k>_state.safetensors   what an interrupted run goes on from
config.json              the configuration
"""

import json
import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from libero._adapters.lifelong.batches import DictWindows
from libero._adapters.lifelong.config import Config, notes, plain
from libero.libero import get_libero_path
from libero.libero.benchmark import get_benchmark
from libero.lifelong.algos import Multitask, Sequential, get_algo_class
from libero.lifelong.datasets import GroupedTaskDataset, SequenceDataset, SequenceVLDataset, get_dataset
from libero.lifelong.metric import evaluate_loss, evaluate_success, native_task
from libero.lifelong.utils import (
    NpEncoder,
    control_seed,
    create_experiment_dir,
    experiment_root,
    get_task_embs,
    latest_run,
    present,
    safe_device,
    torch_load_model,
)
from libero_env.demos.generate import ensure_demos
from libero_env.storage import atomic_path
from lifelong import checkpoints
from lifelong.errors import ConfigError
from lifelong.tracking import Tracker

DEMOS = 50  # of each task, where they are recorded because there are none
RESULTS = ("L_conf_mat", "S_conf_mat", "L_fwd", "S_fwd")


def run(config: Any) -> Path:
    """Learn the tasks of a benchmark as the configuration says.

    Args:
        config: what `libero/configs` composes, of any kind; it is not changed.

    Returns:
        The folder of the run.

    Raises:
        LiberoError: something in the configuration or the data does not work.
    """
    cfg = Config(plain(config))
    for note in notes(cfg):
        print(f"[note] {note}")
    control_seed(cfg.seed)
    fill_in(cfg)
    benchmark = get_benchmark(cfg.benchmark_name)(cfg.data.task_order_index)
    datasets, cfg.shape_meta = load_datasets(cfg, benchmark)
    done = _open(cfg)
    algo = safe_device(get_algo_class(cfg.lifelong.algo)(len(datasets), cfg), cfg.device)
    if cfg.pretrain_model_path:
        load_pretrained(algo, cfg.pretrain_model_path, cfg.device)
    tracker = Tracker(
        mode=cast(Any, os.environ.get("WANDB_MODE", "online") if cfg.use_wandb else "disabled"),
        project=cfg.wandb_project,
    )
    tracker.start(cfg.experiment_name, cfg.experiment_dir, plain(cfg))
    learn = _learn_together if isinstance(algo, Multitask) else _learn_in_turn
    learn(_Run(cfg, algo, benchmark, datasets, tracker, done))
    tracker.finish()
    print(f"[info] finished: {cfg.experiment_dir}")
    return Path(cfg.experiment_dir)


def fill_in(cfg: Any) -> None:
    """Folders and device where the configuration leaves them open."""
    cfg.folder = cfg.folder or get_libero_path("datasets")
    cfg.bddl_folder = cfg.bddl_folder or get_libero_path("bddl_files")
    cfg.init_states_folder = cfg.init_states_folder or get_libero_path("init_states")
    device = str(present(cfg.device))
    if device != str(cfg.device) and not isinstance(cfg.device, int):
        print(f"[note] device={cfg.device}: there is no GPU, it is the CPU")
    cfg.device = device


def load_datasets(cfg: Any, benchmark: Any) -> tuple[list[Any], dict[str, Any]]:
    """Windows of each task, or group of tasks, of a benchmark; its embeddings are set.

    Demonstrations that are not in `cfg.folder` are recorded by the scripted expert, or found where they were before;
    `cfg.demonstrations` says where they are.

    Raises:
        ConfigError: groups that do not divide the tasks.
        LiberoError: demonstrations that are broken, or that the expert cannot record.
    """
    size, count = int(cfg.data.task_group_size), benchmark.n_tasks
    if count % size:
        raise ConfigError(
            f"data.task_group_size={size} does not divide the {count} tasks of {cfg.benchmark_name}"
        )
    cfg.demonstrations = [str(demonstrations(cfg, benchmark, i)) for i in range(count)]
    read = [task_dataset(cfg, path) for path in cfg.demonstrations]
    parts, shape_meta = [windows for windows, _ in read], read[0][1]
    embs = get_task_embs(cfg, [task.language for task in benchmark.tasks])
    benchmark.set_task_embs(embs)
    if size == 1:
        return [SequenceVLDataset(*pair) for pair in zip(parts, embs, strict=True)], shape_meta
    starts = range(0, count, size)
    return [GroupedTaskDataset(parts[i : i + size], list(embs[i : i + size])) for i in starts], shape_meta


def demonstrations(cfg: Any, benchmark: Any, i: int) -> Path:
    """The file of a task's demonstrations; recorded where there is none."""
    path = Path(cfg.folder, benchmark.get_task_demonstration(i))
    if path.exists():
        return path
    size = int(cfg.data.img_h), int(cfg.data.img_w)
    task = native_task(benchmark.get_task(i), cfg.bddl_folder)
    print(f"[info] no {path}: demonstrations of the scripted expert are taken", flush=True)
    return ensure_demos([task], DEMOS, camera_size=size)[0]


def task_dataset(cfg: Any, path: str | Path) -> tuple[SequenceDataset, dict[str, Any]]:
    """The windows of a file without an instruction, and their shapes."""
    return get_dataset(path, cfg.data.obs.modality, seq_len=cfg.data.seq_len)


def load_pretrained(algo: Sequential, path: str, device: str) -> None:
    """Begin with the weights of a `.pth` of this side, or a `.safetensors` of the native one.

    Raises:
        CheckpointError: a broken file, or one of another policy.
    """
    if path.endswith(".safetensors"):
        network: Any = getattr(algo.policy, "network", algo.policy)
        checkpoints.load_weights(network, checkpoints.load(Path(path), device)["policy"], path)
    else:
        checkpoints.load_weights(algo.policy, torch_load_model(path, map_location=device)[0], path)


@dataclass(frozen=True)
class _Run:
    cfg: Any
    algo: Sequential
    benchmark: Any
    datasets: Sequence[Any]
    tracker: Tracker
    done: int  # tasks that an interrupted run has learned

    @property
    def folder(self) -> Path:
        return Path(self.cfg.experiment_dir)

    def evaluates(self) -> bool:
        return bool(self.cfg.eval.eval and not self.cfg.pretrain)


def _open(cfg: Any) -> int:
    """The run's folder, new or that of an interrupted run; how many tasks are done there."""
    if cfg.train.resume:
        path = Path(cfg.train.resume_path) if cfg.train.resume_path else latest_run(experiment_root(cfg))
        if path is None or not path.is_dir():
            raise ConfigError(
                f"train.resume: no run at {path or experiment_root(cfg)}; train.resume_path names one"
            )
        cfg.experiment_dir, cfg.experiment_name = str(path), "_".join(path.parts[-4:])
    else:
        create_experiment_dir(cfg)
    folder, done = Path(cfg.experiment_dir), 0
    (folder / "config.json").write_text(json.dumps(plain(cfg), cls=NpEncoder, indent=1), encoding="utf-8")
    while (folder / f"task{done}_state.safetensors").exists():
        done += 1
    return done


def _learn_in_turn(run: _Run) -> None:
    """One task after another; after each, loss and success on all so far."""
    summary = _summary(run)
    for i in range(run.done, len(run.datasets)):
        if i and i == run.done:
            _take_up(run, i - 1, summary)
        began = time.perf_counter()
        control_seed(run.cfg.seed + i)  # dropout is the same whether the run was interrupted or not
        run.algo.train()
        summary["S_fwd"][i], summary["L_fwd"][i] = run.algo.learn_one_task(
            run.datasets[i], i, run.benchmark, summary
        )
        if run.evaluates():
            _evaluate(run, i, summary)
        _write(run.folder, summary)
        state = {"policy": run.algo.policy.state_dict(), "algorithm": run.algo.hooks.state_dict()}
        checkpoints.save(run.folder / f"task{i}_state.safetensors", state)
        print(f"[info] task {i} took {(time.perf_counter() - began) / 60:.1f} min", flush=True)


def _learn_together(run: _Run) -> None:
    summary = _summary(run)
    run.algo.train()
    success, loss = run.algo.learn_all_tasks(run.datasets, run.benchmark, summary)
    summary["S_fwd"][-1], summary["L_fwd"][-1] = success, loss
    if run.evaluates():
        _evaluate(run, len(run.datasets) - 1, summary)
    _write(run.folder, summary)


def _evaluate(run: _Run, i: int, summary: dict[str, Any]) -> None:
    """Row i of both matrices: groups of tasks count as one."""
    size = int(run.cfg.data.task_group_size)
    losses = evaluate_loss(run.cfg, run.algo, run.benchmark, run.datasets[: i + 1])
    tasks = list(range((i + 1) * size))
    rates = evaluate_success(run.cfg, run.algo, run.benchmark, tasks, summary)
    summary["L_conf_mat"][i, : i + 1] = losses
    summary["S_conf_mat"][i, : i + 1] = rates.reshape(-1, size).mean(1)
    print(
        f"[info] after task {i}: success {np.round(rates, 2).tolist()}, loss {np.round(losses, 3).tolist()}"
    )
    run.tracker.log({"success/mean": float(rates.mean()), "loss/mean": float(losses.mean()), "tasks": i + 1})


def _summary(run: _Run) -> dict[str, Any]:
    """Empty results, with lists for states where they are kept."""
    count, cfg = len(run.datasets), run.cfg
    summary: dict[str, Any] = {
        name: np.zeros((count, count)[: 2 if "mat" in name else 1]) for name in RESULTS
    }
    if cfg.eval.save_sim_states:
        tasks, points = range(run.benchmark.n_tasks), -(-cfg.train.n_epochs // cfg.eval.eval_every) + 1
        keys = [f"k{k}_p{p}" for k in tasks for p in range(k + 1)]
        keys += [f"k{k}_e{e}" for k in range(count) for e in range(points)]
        summary.update({key: [[] for _ in range(cfg.eval.n_eval)] for key in keys})
    return summary


def _take_up(run: _Run, task: int, summary: dict[str, Any]) -> None:
    """Weights, memory and results as they were after a task."""
    path = run.folder / f"task{task}_state.safetensors"
    state = checkpoints.load(path, run.cfg.device)
    checkpoints.load_weights(run.algo.policy, state["policy"], path)
    windows: Mapping[int, Any] = {k: DictWindows(d, k) for k, d in enumerate(run.datasets)}
    run.algo.hooks.load_state_dict(state["algorithm"], windows)
    stored = torch.load(run.folder / "result.pt", weights_only=True)
    summary.update({key: np.asarray(value) if key in RESULTS else value for key, value in stored.items()})
    print(f"[info] going on after task {task} of {run.folder}")


def _write(folder: Path, summary: Mapping[str, Any]) -> None:
    """`result.pt`, whole or not at all; tensors only, so that torch.load needs to execute nothing."""
    with atomic_path(folder / "result.pt") as temporary, open(temporary, "wb") as file:
        torch.save(_tensors(dict(summary)), file)


def _tensors(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _tensors(value) for key, value in node.items()}
    if isinstance(node, list):
        return [_tensors(value) for value in node]
    return torch.from_numpy(node.copy()) if isinstance(node, np.ndarray) else node
