"""Base of the original's algorithms: its methods, with the training loop and the hooks of `lifelong` inside."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.data import Dataset

from libero._adapters.batches import DictBatch, DictWindows, map_tensors
from libero._adapters.config import plain
from libero._adapters.lookup import lookup
from libero.lifelong.metric import evaluate_success, mean_loss
from libero.lifelong.models import get_policy_class
from libero.lifelong.utils import create_experiment_dir, safe_device, torch_load_model, torch_save_model
from lifelong import algorithms
from lifelong.errors import TrainingError
from lifelong.seeding import generator
from lifelong.training.fit import EpochEnd, fit
from lifelong.training.settings import FitSettings
from lifelong.training.step import Step

REGISTERED_ALGOS: dict[str, type["Sequential"]] = {}
Measure = Callable[[int], float | None]  # epoch -> success, None where it is not measured


def register_algo(algo_class: type["Sequential"]) -> None:
    """Register an algorithm under its class name. Subclasses of Sequential are registered when they are defined."""
    REGISTERED_ALGOS[algo_class.__name__] = algo_class


def get_algo_class(algo_name: str) -> type["Sequential"]:
    """Return the algorithm of a name, ignoring case; raise an UnknownNameError if there is none."""
    return lookup(REGISTERED_ALGOS, "algorithm", algo_name)


def get_algo_list() -> dict[str, type["Sequential"]]:
    """Return all algorithms by name."""
    return dict(REGISTERED_ALGOS)


class AlgoMeta(type):
    """Registers every class of this metaclass under its name."""

    def __init__(cls, name: str, bases: tuple, namespace: dict[str, Any]):
        super().__init__(name, bases, namespace)
        register_algo(cast(Any, cls))


class Sequential(nn.Module, metaclass=AlgoMeta):
    """Fine-tuning on one task after another, and the base class of all algorithms.

    A subclass may return an algorithm of `lifelong.algorithms` from `make_hooks`, or override the original's methods:
    for each task `learn_one_task` calls `start_task`, `observe` on each batch (`eval_observe` at epoch 0), `end_task`.

    Args:
        cfg: Configuration, with `shape_meta` of `get_dataset`.
        policy_kwargs: Further arguments of the policy's class.

    Attributes:
        policy: Policy that is trained.
        hooks: Native algorithm that takes part in each step.
        experiment_dir: Folder of the checkpoints.
    """

    policy: Any
    hooks: Any

    def __init__(self, n_tasks: int, cfg: Any, **policy_kwargs: Any):
        super().__init__()
        self.cfg, self.n_tasks, self.loss_scale = cfg, n_tasks, float(cfg.train.loss_scale)
        if not cfg.get("experiment_dir"):
            create_experiment_dir(cfg)
        self.experiment_dir, self.algo = cfg.experiment_dir, cfg.lifelong.algo
        self.policy = get_policy_class(cfg.policy.policy_type)(cfg, cfg.shape_meta, **policy_kwargs)
        self.current_task = -1
        self.hooks = self.make_hooks(cfg)
        self.draws = generator(cfg.seed)
        self.make_optimizer(cfg.train.n_epochs)

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """Return the native algorithm that takes part in each step."""
        return algorithms.Sequential()

    def make_optimizer(self, epochs: int) -> None:
        """Build the configured optimiser, and the scheduler for the given number of epochs."""
        optimizer, scheduler = self.cfg.train.optimizer, self.cfg.train.get("scheduler")
        self.optimizer = _build_torch(optimizer, torch.optim, self.policy.parameters())
        self.scheduler = None
        if scheduler:
            more = {"T_max": epochs} if scheduler.name.endswith("CosineAnnealingLR") else {}
            self.scheduler = _build_torch(scheduler, torch.optim.lr_scheduler, self.optimizer, **more)

    def start_task(self, task: int) -> None:
        """Prepare for the first step on a task."""
        self.current_task = task
        self.draws = generator(self.cfg.seed, task + 1)
        self.hooks.begin_task(max(task, 0), DictWindows([], task), self.policy)
        self.hooks.begin_phase(self.hooks.phases()[0], self.policy)
        self.make_optimizer(self.cfg.train.n_epochs)

    def map_tensor_to_device(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """Return the batch on the configured device."""
        return map_tensors(dict(data), lambda x: safe_device(x, self.cfg.device))

    def observe(self, data: Mapping[str, Any]) -> float:
        """Make one step of the optimiser on a batch; return the loss."""
        settings = FitSettings(grad_clip=self.cfg.train.grad_clip or 0.0, precision="fp32")
        batch = cast(Any, DictBatch(dict(data)))
        step = Step(self.policy, self.hooks, self.optimizer, settings, loss_scale=self.loss_scale)
        loss, _ = step(batch, self.draws, None)
        return loss.item()

    def eval_observe(self, data: Mapping[str, Any]) -> float:
        """Return the loss of a batch without learning from it."""
        with torch.no_grad():
            return self.policy.compute_loss(self.map_tensor_to_device(data)).item()

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """Close a task, with the weights that are kept."""
        self.hooks.end_phase(self.hooks.phases()[0], self.policy)
        self.hooks.end_task(task_id, DictWindows(dataset, task_id), self.policy, self.draws)

    def learn_one_task(
        self, dataset: Dataset, task_id: int, benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Train on a task, keep the weights of the epoch with the highest success, and close the task.

        Args:
            dataset: Windows of the task, with `task_emb`.
            task_id: Position in the sequence.
            benchmark: Benchmark with the tasks and their embeddings.
            result_summary: Without effect: no states are kept.

        Returns:
            Success (0 if it is not measured) and loss, averaged over the evaluated epochs, see `train_policy`.
        """
        self.start_task(task_id)
        path = self.checkpoint_path(task_id)
        rates = self.train_policy(
            dataset,
            self.cfg.train.n_epochs,
            self.cfg.eval.eval_every,
            path,
            self._measure(task_id, benchmark),
        )
        self.end_task(dataset, task_id, benchmark)
        self.save(path)
        return rates

    def learn_all_tasks(
        self, datasets: Sequence[Dataset], benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Learn all tasks in turn; return the means of what `learn_one_task` returns."""
        rows = [self.learn_one_task(d, i, benchmark, result_summary) for i, d in enumerate(datasets)]
        success, loss = np.mean(rows, axis=0)
        return float(success), float(loss)

    def reset(self) -> None:
        """Forget the episode."""
        self.policy.reset()

    @contextmanager
    def acting_on(self, task_id: int) -> Iterator["Sequential"]:
        """Use, within the context, the weights that the algorithm acts with on a task."""
        group = task_id // int(self.cfg.data.task_group_size)
        with self.hooks.policy_for(group, self.policy):
            yield self

    def checkpoint_path(self, task_id: int) -> str:
        """Return the path of a task's checkpoint."""
        return os.path.join(self.experiment_dir, f"task{task_id}_model.pth")

    def save(self, path: str) -> None:
        """Write the policy, the configuration, and the masks of an algorithm that has them."""
        torch_save_model(self.policy, path, self.cfg, getattr(self, "previous_masks", None))

    def _measure(self, task_id: int, benchmark: Any) -> Measure:
        """Return a function that returns the success on a task, or group of tasks, None without evaluation."""
        size = int(self.cfg.data.task_group_size)
        tasks = range(task_id * size, (task_id + 1) * size)
        measured = self.cfg.eval.eval and not self.cfg.pretrain
        return lambda _: (
            float(evaluate_success(self.cfg, self, benchmark, tasks).mean()) if measured else None
        )

    def train_policy(
        self, dataset: Dataset, epochs: int, every: int, path: str, measure: Measure, phase: int = 0
    ) -> tuple[float, float]:
        """Train with `lifelong.training.fit`; load the weights of the best evaluation, or the last if none measures.

        Epoch 0, every `every` epochs and the last are evaluated; the first of the highest success is the best, whose
        weights are written to `path`. The last is a point of the curve, `<name>_auc.log`, only where its turn has come,
        as scripts of the original expect. Unlike the original's loader, `fit` fills up the last batch of an epoch with
        further windows.

        Args:
            measure: Function of the epoch that returns the success, None where it is not measured.
            phase: Number of the training phase within the task, a part of the seed; the curve is that of the first.

        Returns:
            Mean success and mean loss, with epochs after the best counted as the best (eq. 3 of the paper).
        """
        train, best = self.cfg.train, (0, -1.0)  # number and success of the best
        points: list[tuple[float, float]] = []  # success, loss

        def evaluate(epoch: int, loss: float) -> None:
            nonlocal best
            if epoch % every and epoch != epochs:
                return
            success = measure(epoch)
            if success is None or success > best[1]:
                best = len(points), success or 0.0
                self.save(path)
            if epoch % every == 0:
                points.append((success or 0.0, loss))
            text = "" if success is None else f" | success {success:4.2f}"
            print(f"[info] epoch {epoch:3d} | loss {loss:7.3f}{text}", flush=True)

        def end_epoch(end: EpochEnd) -> None:
            if end.epoch:
                if self.scheduler is not None:
                    self.scheduler.step()
                evaluate(end.epoch, end.loss)

        def step(batch: Any, draws: torch.Generator, _: float) -> tuple[Tensor, Tensor]:
            self.draws = draws
            loss = self.observe(batch.data)
            if not np.isfinite(loss):
                hint = "lower train.optimizer.kwargs.lr or lifelong.e_lambda"
                raise TrainingError(f"the loss is {loss}: {hint}")
            return torch.tensor(loss), torch.tensor(0.0)

        self.policy.eval()
        evaluate(0, mean_loss(self, dataset, train.batch_size, train.num_workers))
        if epochs:
            windows: Any = DictWindows(dataset, self.current_task, train.num_workers)
            fit(
                self.policy,
                windows,
                self.hooks,
                settings=FitSettings(epochs=epochs, batch_size=train.batch_size),
                seed=(self.cfg.seed, self.current_task + 1, phase),
                on_epoch=end_epoch,
                step=step,
                load=windows.load,
            )
        self.policy.load_state_dict(torch_load_model(path, map_location=self.cfg.device)[0])
        successes, losses = torch.tensor(points, dtype=torch.float64).T
        if phase == 0:
            torch.save({"success": successes, "loss": losses}, path.replace("_model.pth", "_auc.log"))
        held = torch.arange(len(points)).clamp(max=best[0])
        return successes[held].mean().item(), losses[held].mean().item()


def _build_torch(node: Any, module: Any, *args: Any, **kwargs: Any) -> Any:
    """Build an object of the class that `node.name` ends with; raise an UnknownNameError if torch has none."""
    classes = {k: value for k, value in vars(module).items() if isinstance(value, type) and k[0].isupper()}
    kind = lookup(classes, module.__name__, node.name.rpartition(".")[2])
    return kind(*args, **{**kwargs, **plain(node.get("kwargs") or {})})
