"""The task sequence of a run: learn a task, keep its best weights, evaluate all tasks learned so far.

A run can be killed at any time. What is done is read back from the records and checkpoints; the rest comes out with
the same bits, because all randomness is derived from the seed and the position in the sequence.

Where several processes train together, all of them train, but only the first evaluates and writes. They wait for
each other wherever one reads what another has written, or is about to overwrite.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from libero_env.timing import CONTROL_PERIOD
from lifelong import checkpoints
from lifelong.algorithms.base import Phase
from lifelong.context import RunContext
from lifelong.data.windows import TaskWindows
from lifelong.evaluation.rollout import Rollouts, rollout, save_animation
from lifelong.results.records import CostRecord, EvalRecord, LossRecord, TaskEndRecord
from lifelong.seeding import generator, seeded
from lifelong.streams import StageData, learning_stages
from lifelong.training import costs
from lifelong.training.fit import EpochEnd, fit

# First words of the seeds derived from the run's seed, one for each use; `lifelong.streams` has another.
FIT, END_TASK, ROLLOUT = 1, 2, 3
SAVE_EVERY = 60.0  # [s] between two saves during training, besides those at points of the learning curve


@dataclass(frozen=True)
class TrainingPhase:
    """One phase of an algorithm on one stage: a task, or tasks that are learned together.

    Attributes:
        stage: Positions of the tasks.
        number: Number of the phase within the stage, from 0.
        kind: Phase as the algorithm defines it.
        epochs: Number of epochs of the phase.
        steps_per_epoch: Number of steps per epoch; None: every window once.
        offset: Number of epochs of the stage's earlier phases.
    """

    stage: Sequence[int]
    number: int
    kind: Phase
    epochs: int
    steps_per_epoch: int | None
    offset: int

    @property
    def task(self) -> int:
        """Position of the last task, which identifies the stage."""
        return self.stage[-1]


class TaskSequence:
    """Learns the tasks of a run in turn; `run` starts, or resumes where an earlier process stopped.

    Args:
        context: Everything the run consists of.
        datasets: Windows of each task, by position; each is read when first used.
    """

    def __init__(self, context: RunContext, datasets: Mapping[int, TaskWindows]):
        self.context = context
        self.log = context.directory.log
        self.stages = learning_stages(context.algorithm, len(context.tasks), context.group_size)
        self.data = StageData(datasets, self.stages, context.stream, context.seed)
        self._saved = time.monotonic()
        context.algorithm.set_augmentation(context.augment)

    def run(self, *, evaluate: bool = True) -> None:
        """Learn what is not learned yet, and evaluate all tasks so far after each stage.

        Args:
            evaluate: Whether to fill the success matrix.
        """
        done = self._resume()
        if done and evaluate:
            self.context.ranks.broadcast(self._evaluate_seen_tasks, self.stages[done - 1])
        for stage in self.stages[done:]:
            self._learn_stage(stage)
            if evaluate:
                self.context.ranks.broadcast(self._evaluate_seen_tasks, stage)

    def _resume(self) -> int:
        """Load the checkpoint of the last stage that was learned, and return how many stages are."""
        done = 0
        while done < len(self.stages) and self.context.directory.task_path(self.stages[done][-1]).exists():
            done += 1
        if done:
            self._load_checkpoint(self.stages[done - 1][-1])
        return done

    def _load_checkpoint(self, task: int) -> None:
        path = self.context.directory.task_path(task)
        self._load_state(checkpoints.load(path, self.context.device), str(path))

    def _load_state(self, state: Mapping[str, Any], source: str) -> None:
        if state.get("policy") is not None:
            checkpoints.load_weights(self.context.policy, state["policy"], source)
        self.context.algorithm.load_state_dict(state["algorithm"], self.data)

    def _learn_stage(self, stage: Sequence[int]) -> None:
        """Train on a stage, from its start or from its saved progress, and write its checkpoint."""
        context, task = self.context, stage[-1]
        dataset, saved = self.data[task], context.directory.progress(task, context.device)
        title = f"Task {task + 1}/{len(context.tasks)}: {context.tasks[task].language}"
        if len(stage) > 1:
            title = f"Tasks {stage[0] + 1}-{task + 1}/{len(context.tasks)}: together"
        self._log(f"{title} ({len(dataset)} windows)")
        context.ranks.barrier()  # all have read the saved progress
        costs.reset_peak(context.device)
        if saved is None:
            context.algorithm.begin_task(task, dataset, context.policy)
        else:
            self._load_state(saved, str(context.directory.progress_path))
        first, resume = (0, None) if saved is None else (saved["phase"], saved["fit"])
        for phase in self._phases(stage)[first:]:
            self._train(phase, dataset, resume if phase.number == first else None)
            context.ranks.broadcast(self._save_progress, task, phase.number + 1)
        context.ranks.broadcast(self._end_task, task, dataset)
        if not context.ranks.first:
            self._load_checkpoint(task)

    def _phases(self, stage: Sequence[int]) -> list[TrainingPhase]:
        """Return the phases of training on a stage, in order."""
        phases, offset, fit_settings = [], 0, self.context.fit
        steps = fit_settings.steps_per_epoch
        steps = steps and steps * len(stage)  # as many for each task, together or not
        for number, phase in enumerate(self.context.algorithm.phases()):
            epochs = max(1, round(fit_settings.epochs * phase.share))
            phases.append(TrainingPhase(stage, number, phase, epochs, steps, offset))
            offset += epochs
        return phases

    def _train(self, phase: TrainingPhase, dataset: TaskWindows, resume: dict[str, Any] | None) -> None:
        """Train for one phase, from its first step or a saved epoch, and load the weights that are kept."""
        context = self.context
        if resume is None:
            context.algorithm.begin_phase(phase.kind, context.policy)
        fit(
            context.policy,
            dataset,
            context.algorithm,
            settings=replace(context.fit, epochs=phase.epochs, steps_per_epoch=phase.steps_per_epoch),
            seed=(context.seed, FIT, phase.task, phase.number),
            device=context.device,
            augment=context.augment,
            on_epoch=lambda end: context.ranks.broadcast(self._after_epoch, phase, end),
            resume=resume,
            label=f"task {phase.task + 1} {phase.kind.name}",
            progress=bool(context.progress),
            ranks=context.ranks,
        )
        if self._selects_best(phase):
            self._load_best(phase)
        context.algorithm.end_phase(phase.kind, context.policy)

    def _after_epoch(self, phase: TrainingPhase, end: EpochEnd) -> None:
        """Record the loss, save, and evaluate a point of the learning curve if one is due."""
        context, task, epoch = self.context, phase.task, phase.offset + end.epoch
        if end.epoch and not self.log.read().has_loss(task, epoch):
            self.log.append(LossRecord(task=task, epoch=epoch, loss=end.loss, seconds=end.seconds))
            values = {"epoch": epoch, f"loss/{task}": end.loss, f"penalty/{task}": end.penalty}
            context.tracker.log(values)
        if (phase.number, end.epoch) == (0, phase.epochs) and not self.log.read().costs(task):
            spent = costs.step_costs(
                context.policy, context.algorithm, self.data[task], context.fit.batch_size
            )
            self.log.append(CostRecord(task=task, costs=spent))
        due = end.epoch in context.eval.curve_epochs(phase.epochs)
        if due or time.monotonic() - self._saved > SAVE_EVERY:
            self._save_progress(task, phase.number, end.state())
        if not (due and phase.kind.measures_transfer):
            return
        success = _mean_rate([self._evaluate("curve", task, member, epoch) for member in phase.stage])
        loss = f"loss {end.loss:7.3f}, " if end.epoch else ""
        self._log(f"  epoch {epoch:3d}: {loss}success {success:4.0%}")
        if self._selects_best(phase) and self._best_epoch(phase, end.epoch) == end.epoch:
            best = {
                "task": task,
                "epoch": end.epoch,
                "policy": context.policy.state_dict(),
                "own": self._algorithm_parameters(),
            }
            checkpoints.save(context.directory.best_path, best)

    def _algorithm_parameters(self) -> list[Tensor]:
        """Return the parameters that are trained besides those of the policy."""
        of_policy = {id(p) for p in self.context.policy.parameters()}
        return [p for p in self.context.algorithm.trained(self.context.policy) if id(p) not in of_policy]

    def _selects_best(self, phase: TrainingPhase) -> bool:
        return self.context.eval.select == "best" and phase.kind.measures_transfer

    def _best_epoch(self, phase: TrainingPhase, until: int) -> int:
        """Return the earliest epoch of the phase with the highest success on the learning curve so far."""
        results, rates = self.log.read(), {}
        for epoch in self.context.eval.curve_epochs(phase.epochs):
            keys = [("curve", phase.task, task, phase.offset + epoch) for task in phase.stage]
            found = [record for key in keys if (record := results.evaluation(*key)) is not None]
            if epoch <= until and len(found) == len(keys):
                rates[epoch] = _mean_rate(found)
        return max(rates, key=lambda e: (rates[e], -e))

    def _load_best(self, phase: TrainingPhase) -> None:
        """Load the weights of the phase's best epoch."""
        context, path = self.context, self.context.directory.best_path
        best = context.ranks.broadcast(self._best_epoch, phase, phase.epochs)
        state = checkpoints.load(path, context.device)
        if (state["task"], state["epoch"]) != (phase.task, best):
            raise checkpoints.CheckpointError(
                f"{path} is of task {state['task']}, epoch {state['epoch']}; expected task {phase.task}, "
                f"epoch {best}. Start again with resume=false"
            )
        checkpoints.load_weights(context.policy, state["policy"], str(path))
        with torch.no_grad():
            for parameter, kept in zip(self._algorithm_parameters(), state.get("own", []), strict=True):
                parameter.copy_(kept)

    def _save_progress(self, task: int, phase: int, fit_state: dict[str, Any] | None = None) -> None:
        """Save the progress on a task: inside a phase, or before it."""
        algorithm = self.context.algorithm.state_dict()
        state = {"task": task, "phase": phase, "fit": fit_state, "algorithm": algorithm}
        state["policy"] = None if fit_state is not None else self.context.policy.state_dict()
        checkpoints.save(self.context.directory.progress_path, state)
        self._saved = time.monotonic()

    def _end_task(self, task: int, dataset: TaskWindows) -> None:
        """Let the algorithm end the task, record the costs, and write the task's checkpoint."""
        policy, algorithm, seed = self.context.policy, self.context.algorithm, self.context.seed
        began = time.perf_counter()
        with seeded(seed, END_TASK, task, 1, device=self.context.device):  # for dropout
            algorithm.end_task(task, dataset, policy, generator(seed, END_TASK, task))
        spent = {
            "end_task_seconds": time.perf_counter() - began,
            "stored_bytes": costs.stored_bytes(algorithm),
        }
        with algorithm.policy_for(task, policy) as acting:
            spent |= costs.action_costs(acting) | costs.peak_costs(self.context.device)
        self.log.append(CostRecord(task=task, costs=spent))
        state = {"task": task, "policy": policy.state_dict(), "algorithm": algorithm.state_dict()}
        checkpoints.save(self.context.directory.task_path(task), state)

    def _evaluate_seen_tasks(self, stage: Sequence[int]) -> None:
        """Fill the stage's row of the success matrix: all tasks so far, as far as not recorded yet."""
        task, results = stage[-1], self.log.read()
        first = self._phases(stage)[0]
        best = self._best_epoch(first, first.epochs) if self._selects_best(first) else first.epochs
        row = [self._evaluate("matrix", task, seen, best) for seen in range(task + 1)]
        if results.task_end(task) is None:
            spent = sum(r.seconds for r in results.of(LossRecord) if r.task == task)
            spent += sum(r.seconds for r in results.of(EvalRecord) if r.learned == task and r not in row)
            spent += sum(r.seconds for r in row)
            self.log.append(TaskEndRecord(task=task, best_epoch=best, seconds=spent))
        new, mean = _mean_rate([r for r in row if r.task in stage]), _mean_rate(row)
        values = {"success/just_learned": new, "success/mean": mean, "tasks": task + 1}
        self.context.tracker.log(values)
        self._log(f"  learned: success {new:.0%} on it, {mean:.0%} over {task + 1} so far{self._eta(task)}")

    def _evaluate(self, phase: Literal["curve", "matrix"], learned: int, task: int, epoch: int) -> EvalRecord:
        """Evaluate a task and record it, or return the record if there is one."""
        context, settings = self.context, self.context.eval
        found = self.log.read().evaluation(phase, learned, task, epoch if phase == "curve" else None)
        if found is not None:
            return found
        states = settings.init_states(phase)
        recorded = phase == "matrix" and (task == learned or learned == len(context.tasks) - 1)
        stage = next(stage for stage in self.stages if task in stage)
        with context.algorithm.policy_for(stage[-1], context.policy) as acting:
            rollouts = rollout(
                acting,
                context.envs.get((task, len(states))),
                states,
                language=context.languages[task],
                horizon=settings.horizon,
                settle_steps=settings.settle_steps,
                seed=(context.seed, ROLLOUT, learned, epoch, task),
                device=context.device,
                precision=settings.precision,
                record_every=settings.record_every if recorded else 0,
                label=f"rollouts on task {task + 1}",
                progress=bool(context.progress),
            )
        if rollouts.frames:
            self._save_video(learned, task, rollouts.frames, rollouts.episodes[0].success)
        record = _eval_record(rollouts, phase, learned, epoch, task)
        self.log.append(record)
        return record

    def _save_video(self, learned: int, task: int, frames: tuple, success: bool) -> None:
        context = self.context
        path = context.directory.videos / f"task_{task:02d}_after_{learned:02d}.webp"
        save_animation(frames, path, seconds_per_frame=CONTROL_PERIOD * context.eval.record_every)
        outcome = "success" if success else "failure"
        caption = f"{context.tasks[task].language}: {outcome}, after learning {learned + 1} tasks"
        path.with_suffix(".txt").write_text(caption + "\n", encoding="utf-8")

    def _eta(self, task: int) -> str:
        """Return an estimate of the remaining time, from the time that training and evaluation took so far."""
        results, count = self.log.read(), len(self.context.tasks)
        learned, remaining = task + 1, count - task - 1
        if not remaining:
            return ""
        evals = results.of(EvalRecord)
        cells = [r.seconds for r in evals if r.phase == "matrix"]
        training = sum(r.seconds for r in results.of(LossRecord))
        training += sum(r.seconds for r in evals if r.phase == "curve")
        open_cells = sum(stage[-1] + 1 for stage in self.stages if stage[-1] > task)
        seconds = remaining * training / learned + open_cells * sum(cells) / len(cells)
        return f"; about {max(1, round(seconds / 60))} min left"

    def _log(self, text: str) -> None:
        if self.context.ranks.first:
            print(text, flush=True)


def _mean_rate(records: Sequence[EvalRecord]) -> float:
    """Return the mean success of evaluations."""
    return sum(r.rate for r in records) / len(records)


def _eval_record(
    rollouts: Rollouts, phase: Literal["curve", "matrix"], learned: int, epoch: int, task: int
) -> EvalRecord:
    return EvalRecord(
        phase=phase,
        learned=learned,
        epoch=epoch,
        task=task,
        successes=tuple(e.success for e in rollouts.episodes),
        lengths=tuple(e.length for e in rollouts.episodes),
        init_states=tuple(e.init_state for e in rollouts.episodes),
        seconds=rollouts.seconds,
        atoms=rollouts.atoms,
        atoms_at_start=tuple(e.at_start for e in rollouts.episodes),
        atoms_ever=tuple(e.ever for e in rollouts.episodes),
        atoms_at_end=tuple(e.at_end for e in rollouts.episodes),
    )
