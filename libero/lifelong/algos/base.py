"""The original's algorithms: a loop over dictionaries of windows, with the hooks of `lifelong.algorithms` inside."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import nn
from torch.utils.data import DataLoader, Dataset, RandomSampler

from libero._adapters.lifelong.batches import DictBatch, DictWindows, map_tensors
from libero._adapters.lifelong.config import named, plain
from libero.lifelong.metric import evaluate_one_task_success
from libero.lifelong.models import get_policy_class
from libero.lifelong.utils import create_experiment_dir, safe_device, torch_load_model, torch_save_model
from lifelong import algorithms
from lifelong.seeding import generator

REGISTERED_ALGOS: dict[str, type["Sequential"]] = {}


def register_algo(algo_class: type["Sequential"]) -> None:
    """Make an algorithm known by its name; subclasses of Sequential are when they are defined."""
    REGISTERED_ALGOS[algo_class.__name__] = algo_class


def get_algo_class(algo_name: str) -> type["Sequential"]:
    """The algorithm of this name; case does not count.

    Raises:
        UnknownNameError: no such algorithm.
    """
    return named(REGISTERED_ALGOS, "algorithm", algo_name)


def get_algo_list() -> dict[str, type["Sequential"]]:
    """Name -> class of all algorithms."""
    return dict(REGISTERED_ALGOS)


class AlgoMeta(type):
    """Registers every class of this kind under its name."""

    def __new__(mcs, name: str, bases: tuple, namespace: dict[str, Any]) -> Any:
        cls = super().__new__(mcs, name, bases, namespace)
        register_algo(cls)  # type: ignore[arg-type]
        return cls


@dataclass(frozen=True)
class Progress:
    """What was measured while training, at epoch 0 and then every so many epochs.

    Attributes:
        losses, successes: (n,) float64.
        best: position of the earliest highest success.
    """

    losses: np.ndarray
    successes: np.ndarray
    best: int

    def held(self) -> tuple[float, float]:
        """Means of success and loss, where what follows the best counts as the best (FWT, eq. 3 of the paper)."""
        success, loss = self.successes.copy(), self.losses.copy()
        success[self.best :], loss[self.best :] = success[self.best], loss[self.best]
        return float(success.mean()), float(loss.mean())


class Sequential(nn.Module, metaclass=AlgoMeta):
    """Fine-tuning on one task after another, and the base of all algorithms.

    A subclass may give `make_hooks` an algorithm of `lifelong.algorithms`, or override `start_task`, `observe`,
    `eval_observe`, `end_task`, `learn_one_task`. For each task `learn_one_task` calls `start_task`, then for every
    batch `observe` (at epoch 0 `eval_observe`), and at the end `end_task`.

    Args:
        n_tasks: tasks that will be learned.
        cfg: the configuration, with `shape_meta` of `get_dataset`.
        policy_kwargs: further arguments of the policy's class.

    Attributes:
        policy: what is trained.
        hooks: the algorithm's part in each step.
        experiment_dir: where checkpoints go.
    """

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
        self.prepare(cfg.train.n_epochs)

    def make_hooks(self, cfg: Any) -> algorithms.Algorithm:
        """What acts on each step: nothing, for plain fine-tuning."""
        return algorithms.Sequential()

    def prepare(self, epochs: int) -> None:
        """A new optimiser and scheduler, for so many epochs."""
        train = self.cfg.train
        kwargs = plain(train.optimizer.kwargs)
        self.optimizer = _of_torch(train.optimizer.name, torch.optim)(self.policy.parameters(), **kwargs)
        self.scheduler = None
        if train.get("scheduler"):
            kwargs = {"T_max": epochs} if train.scheduler.name.endswith("CosineAnnealingLR") else {}
            kwargs |= plain(train.scheduler.get("kwargs") or {})
            schedule = _of_torch(train.scheduler.name, torch.optim.lr_scheduler)
            self.scheduler = schedule(self.optimizer, **kwargs)

    def start_task(self, task: int) -> None:
        """Before the first step on a task."""
        self.current_task = task
        self.draws = generator(self.cfg.seed, task + 1)
        self.hooks.begin_task(max(task, 0), cast(Any, DictWindows(cast(Any, ()), task)), self.policy)
        self.hooks.begin_phase(self.hooks.phases()[0], self.policy)
        self.prepare(self.cfg.train.n_epochs)

    def map_tensor_to_device(self, data: Mapping[str, Any]) -> dict[str, Any]:
        """The batch on the configured device."""
        return map_tensors(dict(data), lambda x: safe_device(x, self.cfg.device))

    def observe(self, data: Mapping[str, Any]) -> float:
        """Learn from a batch: one step of the optimiser; the loss."""
        batch = cast(DictBatch, self.hooks.mix(cast(Any, DictBatch(dict(data))), self.draws))
        self.optimizer.zero_grad()
        loss = self.policy.compute_loss(self.map_tensor_to_device(batch.data))
        penalty = self.hooks.penalty(self.policy)
        (self.loss_scale * loss if penalty is None else self.loss_scale * (loss + penalty)).backward()
        self.hooks.after_backward(self.policy)
        if self.cfg.train.grad_clip:
            nn.utils.clip_grad_norm_(self.policy.parameters(), self.cfg.train.grad_clip)
        self.optimizer.step()
        self.hooks.after_step(self.policy)
        return loss.item()

    def eval_observe(self, data: Mapping[str, Any]) -> float:
        """The loss of a batch, from which nothing is learned."""
        with torch.no_grad():
            return self.policy.compute_loss(self.map_tensor_to_device(data)).item()

    def end_task(self, dataset: Dataset, task_id: int, benchmark: Any, env: Any = None) -> None:
        """After training on a task, with the weights that are kept."""
        self.hooks.end_phase(self.hooks.phases()[0], self.policy)
        self.hooks.end_task(task_id, cast(Any, DictWindows(dataset, task_id)), self.policy, self.draws)

    def learn_one_task(
        self, dataset: Dataset, task_id: int, benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Train on a task, keep the weights of the epoch with the highest success, and close the task.

        Args:
            dataset: the task's windows, with `task_emb`.
            task_id: position in the sequence.
            benchmark: names the tasks and holds their embeddings.
            result_summary: where `eval.save_sim_states` keeps states, under `k<task>_e<evaluation>`.

        Returns:
            Success and loss, averaged over the epochs evaluated as forward transfer is defined.
        """
        self.start_task(task_id)
        tasks = members(self.cfg, task_id)

        def measure(number: int) -> float | None:
            if not self.cfg.eval.eval:
                return None
            states = result_summary.get(f"k{task_id}_e{number}") if self.cfg.eval.save_sim_states else None
            return self.success_on(tasks, benchmark, states)

        progress = self.practise(
            dataset, self.cfg.train.n_epochs, self.cfg.eval.eval_every, self.checkpoint(task_id), measure
        )
        self.end_task(dataset, task_id, benchmark)
        self.save(self.checkpoint(task_id))
        curve = {"success": torch.from_numpy(progress.successes), "loss": torch.from_numpy(progress.losses)}
        torch.save(curve, os.path.join(self.experiment_dir, f"task{task_id}_auc.log"))
        return progress.held()

    def learn_all_tasks(
        self, datasets: Sequence[Dataset], benchmark: Any, result_summary: Mapping[str, Any]
    ) -> tuple[float, float]:
        """Learn all tasks in turn; means of what `learn_one_task` gives."""
        rows = [self.learn_one_task(d, i, benchmark, result_summary) for i, d in enumerate(datasets)]
        success, loss = np.mean(rows, axis=0)
        return float(success), float(loss)

    def reset(self) -> None:
        """Forget the episode."""
        self.policy.reset()

    @contextmanager
    def acting_on(self, task_id: int) -> Iterator["Sequential"]:
        """Within the context, the weights are those that the algorithm uses for a task."""
        group = task_id // int(self.cfg.data.task_group_size)
        with self.hooks.policy_for(group, self.policy):
            yield self

    def checkpoint(self, task_id: int) -> str:
        """Where the weights of a task are kept."""
        return os.path.join(self.experiment_dir, f"task{task_id}_model.pth")

    def save(self, path: str) -> None:
        """Write the policy, the configuration, and what else an evaluation needs."""
        torch_save_model(self.policy, path, cfg=self.cfg)

    def success_on(self, tasks: Sequence[int], benchmark: Any, sim_states: Any = None) -> float:
        """Success on tasks while they are learned, averaged."""
        rates = [
            evaluate_one_task_success(
                self.cfg,
                self,
                benchmark.get_task(task),
                benchmark.get_task_emb(task),
                task,
                sim_states,
                selecting=True,
            )
            for task in tasks
        ]
        return float(np.mean(rates))

    def practise(
        self, dataset: Dataset, epochs: int, every: int, path: str, measure: Callable[[int], float | None]
    ) -> Progress:
        """Train for some epochs; the weights of the best evaluation are loaded at the end and lie under `path`.

        Args:
            dataset: windows.
            epochs: how many; epoch 0 only measures.
            every: epochs between two evaluations; the last epoch has one too.
            path: of the checkpoint.
            measure: gives the success, from the number of the evaluation; None where there is none: the last weights
                are kept then.
        """
        losses: list[float] = []
        successes: list[float] = []
        loader, best = self._loader(dataset), 0
        for epoch in range(epochs + 1):
            loss = self._epoch(loader, learn=epoch > 0)
            if epoch % every == 0 or epoch == epochs:
                success = measure(len(losses))
                if success is None or success > max(successes, default=-1.0):
                    self.save(path)
                    best = len(losses)
                losses.append(loss)
                successes.append(success or 0.0)
                told = "" if success is None else f" | success {success:4.2f}"
                print(f"[info] epoch {epoch:3d} | loss {loss:7.3f}{told}", flush=True)
            if self.scheduler is not None and epoch:
                self.scheduler.step()
        self.policy.load_state_dict(torch_load_model(path, map_location=self.cfg.device)[0])
        return Progress(np.array(losses), np.array(successes), best)

    def _epoch(self, loader: DataLoader, learn: bool) -> float:
        """Mean loss of a pass over the windows."""
        if learn:
            self.hooks.mode_train(cast(Any, self.policy))
        else:
            self.policy.eval()
        return float(np.mean([self.observe(data) if learn else self.eval_observe(data) for data in loader]))

    def _loader(self, dataset: Dataset) -> DataLoader:
        train = self.cfg.train
        return DataLoader(
            dataset,
            batch_size=train.batch_size,
            num_workers=train.num_workers,
            persistent_workers=train.num_workers > 0,
            sampler=RandomSampler(cast(Any, dataset), generator=self.draws),
        )


def members(cfg: Any, task_id: int) -> range:
    """The benchmark's tasks that make up one task of the sequence."""
    size = int(cfg.data.task_group_size)
    return range(task_id * size, (task_id + 1) * size)


def _of_torch(name: str, module: Any) -> Callable[..., Any]:
    """A class of a module of torch by the last part of its name.

    Raises:
        UnknownNameError: there is none.
    """
    classes = {
        key: value for key, value in vars(module).items() if isinstance(value, type) and key[0].isupper()
    }
    return named(classes, module.__name__, name.rpartition(".")[2])
