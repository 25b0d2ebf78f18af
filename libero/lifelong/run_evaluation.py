"""Evaluation of a run's checkpoint on one task; the work of `evaluate.py`."""

from pathlib import Path
from typing import Any

import numpy as np
import torch

from libero._adapters.config import Evaluation, load_config
from libero.libero.benchmark import get_benchmark
from libero.libero.utils.video_utils import VideoWriter
from libero.lifelong.algos import PackNet, Sequential, get_algo_class
from libero.lifelong.datasets import SequenceVLDataset, get_dataset
from libero.lifelong.metric import evaluate_loss, rollouts
from libero.lifelong.run import fill_in
from libero.lifelong.utils import control_seed, get_task_embs, latest_run, safe_device, torch_load_model
from libero_env.errors import InvalidInputError
from lifelong.errors import CheckpointError
from lifelong.stats.intervals import wilson_interval


def evaluate(request: Evaluation) -> dict[str, Any]:
    """Measure loss and success of a checkpoint on a task; print them, and write them beside the checkpoint.

    Returns:
        `loss` (NaN if there are no demonstrations of the task), `success_rate`, its 95 % interval (Wilson), and
        the success of each episode.

    Raises:
        CheckpointError: There is no such run or checkpoint.
        LiberoError: There is no such benchmark or task.
    """
    path = checkpoint_path(request)
    control_seed(request.seed)
    weights, cfg, masks = torch_load_model(path)
    if cfg is None:
        raise CheckpointError(f"{path} holds no configuration: it was not written by a run")
    cfg.device, cfg.experiment_dir = request.device_id, str(path.parent)
    cfg.eval.n_eval, cfg.eval.max_steps = (
        request.n_eval or cfg.eval.n_eval,
        request.max_steps or cfg.eval.max_steps,
    )
    fill_in(cfg)
    benchmark = get_benchmark(request.benchmark)(cfg.data.task_order_index)
    task = benchmark.get_task(request.task_id)
    benchmark.set_task_embs(get_task_embs(cfg, [t.language for t in benchmark.tasks]))
    algo = get_algo_class(cfg.lifelong.algo)(benchmark.n_tasks, cfg)
    algo.policy.load_state_dict(weights)
    if isinstance(algo, PackNet):
        algo.load_masks(masks, request.task_id if request.load_task is None else request.load_task)
        algo = algo.get_eval_algo(request.task_id)
    algo = safe_device(algo, cfg.device)
    emb, view = benchmark.get_task_emb(request.task_id), cfg.data.obs.modality.rgb[0]
    loss = _loss(cfg, algo, benchmark, request.task_id)
    folder = path.parent / f"{path.stem}_on{request.task_id}_videos"
    with VideoWriter(folder, request.save_videos, single_video=False) as video:

        def record(start: int, obs: Any, over: np.ndarray) -> None:
            for i, done in enumerate(over):
                video.append_obs({view: obs[view][i][::-1]}, bool(done), start + i, view)

        states, on_step = range(cfg.eval.n_eval), record if request.save_videos else None
        episodes = rollouts(cfg, algo, task, emb, request.task_id, states, on_step=on_step)
    return _report(path, request.task_id, task.name, loss, [episode.success for episode in episodes])


def checkpoint_path(request: Evaluation) -> Path:
    """Return the checkpoint that a request names.

    Raises:
        CheckpointError: There is no such run or file.
        InvalidInputError: An option names a checkpoint that runs of this algorithm do not have.
    """
    option, value = ("load_task", request.load_task) if request.algo == "multitask" else ("ep", request.ep)
    if value is not None:
        named = "its epoch, --ep" if option == "load_task" else "the last task before it, --load_task"
        raise InvalidInputError(f"--{option}: a checkpoint of {request.algo} is named by {named}")
    cfg = load_config(f"lifelong={request.algo}", f"policy={request.policy}")
    name = f"{cfg.lifelong.algo}/{cfg.policy.policy_type}_seed{request.seed}"
    runs = sorted(p for p in Path(request.experiment_dir).glob(f"*/{name}") if p.is_dir())
    roots = [p for p in runs if p.parts[-3].lower() == request.benchmark.lower()]
    if not roots:
        raise CheckpointError(
            f"no run {request.benchmark}/{name} in {request.experiment_dir}; there is "
            f"{', '.join(map(str, runs)) or 'none of this name'}"
        )
    folder = roots[0] / f"run_{request.run:03d}" if request.run else latest_run(roots[0])
    if request.algo == "multitask":
        file = "multitask_model.pth" if request.ep is None else f"multitask_model_ep{request.ep}.pth"
    else:
        file = f"task{request.task_id if request.load_task is None else request.load_task}_model.pth"
    path = Path(folder or roots[0], file)
    if not path.is_file():
        names = sorted(file.name for file in path.parent.glob("*_model*.pth"))
        raise CheckpointError(f"no checkpoint {path}; there is {', '.join(names) or 'none'}")
    return path


def _loss(cfg: Any, algo: Sequential, benchmark: Any, task_id: int) -> float:
    """Return the loss on the task's demonstrations, NaN if there are none; none are generated for it."""
    name = benchmark.get_task_demonstration(task_id)
    paths = [Path(cfg.folder, name), *map(Path, cfg.get("demonstrations") or ())]
    path = next((p for p in paths if p.name == Path(name).name and p.exists()), None)
    if path is None:
        return float("nan")
    windows, _ = get_dataset(path, cfg.data.obs.modality, seq_len=cfg.data.seq_len)
    dataset = SequenceVLDataset(windows, benchmark.get_task_emb(task_id))
    return float(evaluate_loss(cfg, algo, benchmark, [dataset])[0])


def _report(path: Path, task_id: int, name: str, loss: float, successes: list[bool]) -> dict[str, Any]:
    """Print and write the results."""
    count, total = sum(successes), len(successes)
    rate, (low, high) = count / total, map(float, wilson_interval(count, total))
    results: dict[str, Any] = {"loss": loss, "success_rate": rate, "interval": [low, high]}
    results |= {"successes": successes, "task": name, "checkpoint": str(path)}
    stats = path.with_name(f"{path.stem}_on{task_id}.stats")
    torch.save(results, stats)
    shown = f"{count}/{total} = {rate:.0%} (95 %: {low:.0%} to {high:.0%})"
    print(f"{name}: success {shown}, loss {loss:.3f}; {stats}")
    return results
