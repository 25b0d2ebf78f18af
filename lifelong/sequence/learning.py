"""The task sequence of a run: learn a task, keep its best weights, evaluate all tasks learned so far.

A run can be killed at any time. What is done is read back from the records and checkpoints; the rest comes out with
the same bits, because all randomness is derived from the seed and the position in the sequence.

Where several processes train together, all of them train, but only the first evaluates and writes. They wait for
each other wherever one reads what another has written, or is about to overwrite.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

from torch import Tensor

from libero_env.errors import is_quiet
from lifelong.context import RunContext
from lifelong.data.settings import Statistics
from lifelong.data.windows import TaskWindows, frame_moments, frames_of
from lifelong.evaluation.beside import RolloutProcess
from lifelong.policies.base import Policy
from lifelong.results.records import (
    CollectionRecord,
    CostRecord,
    EvalRecord,
    LossRecord,
    Phase,
    TaskEndRecord,
)
from lifelong.seeding import BEGIN_TASK, END_TASK, FIT, generator, seeded
from lifelong.sequence.measuring import Evaluator
from lifelong.sequence.recovery import Recovery, say
from lifelong.sequence.stages import (
    TrainingPhase,
    lacks_row,
    mean_rate,
    missing_points,
    training_phases,
    unseen_tasks,
)
from lifelong.streams import StageData, learning_stages
from lifelong.training import costs
from lifelong.training.fit import EpochEnd, fit
from lifelong.training.precision import float32_products


class TaskSequence:
    """Learns the tasks of a run in turn; `run` starts, or resumes where an earlier process stopped.

    Args:
        context: Everything the run consists of.
        datasets: Windows of each task, by position; each is read when first used.
        prepare: Function that brings the policy to where the first task begins, called before it is learned from its
            start; by default the policy is there.
    """

    def __init__(
        self,
        context: RunContext,
        datasets: Mapping[int, TaskWindows],
        prepare: Callable[[], None] = lambda: None,
    ):
        self.context, self.prepare = context, prepare
        self.log, self.checkpoints = context.directory.log, context.directory.checkpoints
        self.stages = learning_stages(context.algorithm, context.group_sizes)
        self.data = StageData(datasets, self.stages, context.stream, context.seed)
        self.evaluator = Evaluator(context, self.stages)
        self._frames: dict[int, tuple[Tensor, Tensor]] = {}  # readings and actions of stages
        self._row: Callable[[], None] | None = None  # records a row that is being measured beside training
        self._reached = -1  # number of the stage after which the policy is; -1: before the first
        self.recovery = Recovery(context, self.data)
        context.algorithm.set_augmentation(context.augment)

    def run(self, *, evaluate: bool = True) -> None:
        """Learn what is not learned yet, and evaluate all tasks so far after each stage.

        What is damaged or lost is learned or measured again, to the same bits.

        Args:
            evaluate: Whether to fill the success matrix.
        """
        ranks, context = self.context.ranks, self.context
        with RolloutProcess(context.envs) as process:
            beside = process if context.works_beside else None
            for number, stage in enumerate(self.stages):
                if ranks.broadcast(self._to_learn, number):
                    self._learn_stage(number)
                if evaluate and ranks.broadcast(self._to_evaluate, stage):
                    self._bring_to(number)
                    ranks.broadcast(self._evaluate_seen_tasks, stage, beside)
            self._end_row()
        self._bring_to(len(self.stages) - 1)

    def _to_learn(self, number: int) -> bool:
        """Return whether a stage is to be learned: it is new, or points of its learning curve are lost."""
        learned = self.checkpoints.tasks()
        if not any(stage[-1] in learned for stage in self.stages[number:]):
            return True
        stage = self.stages[number]
        if lost := missing_points(self.context, stage, self.log.read()):
            say(
                self.context,
                f"{self.log.path} lacks points of the learning curve of task {stage[-1] + 1} (epochs "
                f"{', '.join(map(str, lost[:5]))}): it is learned again to measure them",
            )
        return bool(lost)

    def _to_evaluate(self, stage: Sequence[int]) -> bool:
        return lacks_row(self.context, stage, self.log.read())

    def _bring_to(self, number: int) -> None:
        """Bring the policy and the algorithm to where they were after a stage."""
        if self._reached != number and not self.recovery.load_stage(self.stages[number]):
            self._learn_stage(number)
        self._reached = number

    def _learn_stage(self, number: int) -> None:
        """Train on a stage, from its start or from its saved progress, and write its checkpoint."""
        context, stage = self.context, self.stages[number]
        task, phases, saved = stage[-1], training_phases(context, stage), self.recovery.load_progress(stage)
        if saved is None and number:
            self._bring_to(number - 1)
        elif saved is None:
            self.prepare()
            context.ranks.broadcast(self._evaluate_untrained)
        dataset = self.data[task]
        title = f"Task {task + 1}/{len(context.tasks)}: {context.instructions[task]}"
        if len(stage) > 1:
            title = f"Tasks {stage[0] + 1}-{task + 1}/{len(context.tasks)}: together"
        self._tell(f"{title} ({len(dataset)} windows)")
        context.ranks.barrier()  # all have read the saved progress
        costs.reset_peak(context.device)
        if saved is None:
            self._meet(number)
            with seeded(context.seed, BEGIN_TASK, task):
                context.algorithm.begin_task(task, dataset, context.policy)
            self._meet(number)  # again: it may have gone back to weights that do not know the stage
        first, resume = (0, None) if saved is None else (saved["phase"], saved["fit"])
        for phase in phases[first:]:
            self._train(phase, dataset, resume if phase.number == first else None)
            context.ranks.broadcast(self.recovery.save_progress, task, phase.number + 1)
        context.ranks.broadcast(self._end_task, task, dataset)
        if not context.ranks.first:
            self.recovery.apply_stage(stage)
        self._reached = number

    def _meet(self, number: int) -> None:
        """Tell the policy of a stage, and normalise it, see `meet`."""
        context, ends, tasks = self.context, [stage[-1] for stage in self.stages], self.stages[number]
        last = tasks[-1]
        for task in tasks if len(tasks) > 1 else ():  # each by its own text
            context.policy.meet_task(self.data.datasets[task], context.instructions[task])
        text, statistics = context.instructions[last], context.data.statistics
        meet(context.policy, self.data, ends, last, text, statistics, self._frames)

    def _train(self, phase: TrainingPhase, dataset: TaskWindows, resume: dict[str, Any] | None) -> None:
        """Train for one phase, from its first step or a saved epoch, and load the weights that are kept."""
        context = self.context
        if resume is None:
            context.algorithm.begin_phase(phase.kind, context.policy)
        seed, learner = (context.seed, FIT, phase.task, phase.number), context.learner
        cloning = nullcontext({"augment": context.augment})
        own = learner.training(context, phase.stage, seed, resume, phase.offset) if learner else cloning
        with own as options:
            fit(
                context.policy,
                dataset,
                context.algorithm,
                settings=replace(
                    context.fit,
                    epochs=phase.epochs,
                    steps_per_epoch=phase.steps_per_epoch,
                    statistics_first=context.fit.statistics_first and not phase.number,
                ),
                seed=seed,
                on_epoch=lambda end: context.ranks.broadcast(self._after_epoch, phase, end),
                resume=resume,
                progress=f"task {phase.task + 1} {phase.kind.name}" if context.progress else None,
                ranks=context.ranks,
                **options,
            )
        if phase.selects_best:
            self.recovery.load_best(phase)
            if context.ranks.first and not any((rates := phase.points(self.log.read())).values()):
                kept = phase.best_epoch(self.log.read(), phase.epochs)
                whose = (
                    f"of epoch {kept}, the last of {len(rates)} equal ones,"
                    if kept
                    else "from before the task"
                )
                say(context, f"warning: no rollout has succeeded at any epoch: the weights {whose} are kept")
        context.algorithm.end_phase(phase.kind, context.policy)

    def _after_epoch(self, phase: TrainingPhase, end: EpochEnd) -> bool:
        """Record the loss, save, and evaluate a due point of the learning curve; return whether training ends here."""
        context, task, epoch = self.context, phase.task, phase.offset + end.epoch
        if end.epoch and not self.log.read().has_loss(task, epoch):
            self.log.append(LossRecord(task=task, epoch=epoch, loss=end.loss, seconds=end.seconds))
            values = {"epoch": epoch, f"loss/{task}": end.loss, f"penalty/{task}": end.penalty}
            context.tracker.log(values, len(self.log.read().of(LossRecord)))
        due = end.epoch in context.eval.curve_epochs(phase.epochs)
        if due or self.recovery.is_due():
            self.recovery.save_progress(task, phase.number, end.state())
        if due and phase.kind.measures_transfer:
            points = [self.evaluator.evaluate("curve", task, member, epoch) for member in phase.stage]
            loss = f"loss {end.loss:7.3f}, " if end.epoch else ""
            self._tell(f"  epoch {epoch:3d}: {loss}success {mean_rate(points):4.0%}")
            if phase.selects_best and phase.best_epoch(self.log.read(), end.epoch) == end.epoch:
                self.recovery.save_best(phase, end)
        ended = end.epoch == phase.last_epoch(self.log.read())
        if ended and not phase.number and not self.log.read().costs(task):
            parts = (context.policy, context.algorithm, self.data[task], context.fit.batch_size)
            self.log.append(CostRecord(task=task, costs=costs.step_costs(*parts)))
        return ended

    def _end_task(self, task: int, dataset: TaskWindows) -> None:
        """Let the algorithm end the task, record the costs, and write the task's checkpoint."""
        policy, algorithm, seed = self.context.policy, self.context.algorithm, self.context.seed
        began = time.perf_counter()
        strict = float32_products(self.context.fit.precision)
        with seeded(seed, END_TASK, task, 1, device=self.context.device), strict:  # for dropout
            algorithm.end_task(task, dataset, policy, generator(seed, END_TASK, task))
        spent = {
            "end_task_seconds": time.perf_counter() - began,
            "stored_bytes": costs.stored_bytes(algorithm),
            **self._effort(task, len(dataset)),
        }
        with algorithm.policy_for(task, policy) as acting:
            spent |= costs.action_costs(acting, self.context.languages[task])
            spent |= costs.peak_costs(self.context.device)
        self.log.append(CostRecord(task=task, costs=spent))
        self.checkpoints.save_task(task, policy.state_dict(), self.recovery.algorithm_state())
        policy.save_beside(self.context.directory.path)

    def _effort(self, task: int, windows: int) -> dict[str, float]:
        """Return the number of updates on a stage, of its windows, and the share [%] kept of all windows so far."""
        phases = training_phases(self.context, next(stage for stage in self.stages if stage[-1] == task))
        fit, results = self.context.fit, self.log.read()
        seen = windows + sum(
            results.costs(stage[-1]).get("windows", 0.0) for stage in self.stages if stage[-1] < task
        )
        epochs = [p.last_epoch(results) for p in phases]
        epochs[-1] -= sum(
            r.task == task and not r.groups for r in results.of(CollectionRecord)
        )  # nothing told
        steps = phases[0].steps_per_epoch or math.ceil(windows / fit.batch_size)
        return {
            "updates": sum(epochs) * steps,
            "windows": windows,
            "kept_share": 100 * costs.windows_kept(self.context.algorithm) / seen,
        }

    def _evaluate_seen_tasks(self, stage: Sequence[int], beside: RolloutProcess | None = None) -> None:
        """Fill the stage's row of the success matrix, as far as it is to be measured and not recorded yet.

        Beside training the row is begun only, and ended before the next one begins. After the last stage nothing is
        left to learn, and both processes take their share.
        """
        self._end_row()
        task, results = stage[-1], self.log.read()
        first = training_phases(self.context, stage)[0]
        best = first.best_epoch(results, first.epochs)
        columns = self.context.eval.row(stage, len(self.context.tasks))
        # there and back, so that a row begins with the environments that the one before ended with
        turn = 1 if self.stages.index(stage) % 2 else -1
        cells: list[tuple[Phase, int]] = [("matrix", seen) for seen in columns[::turn]]
        later = self.stages[self.stages.index(stage) + 1 :]
        cells += [("unseen", unseen) for unseen in unseen_tasks(self.context, stage)]
        shifted = self.context.eval.shifted_row(stage, len(self.context.tasks)) if self.context.shift else ()
        cells += [("shift", seen) for seen in shifted]
        sent = cells if later else cells[::2]
        begun = [self.evaluator.begin(phase, task, seen, best, beside) for phase, seen in sent if beside]
        own = [cell for cell in cells if not (beside and cell in sent)]
        records = [self.evaluator.evaluate(phase, task, seen, best) for phase, seen in own]
        self._row = lambda: self._record_row(stage, best, [*(finish() for finish in begun), *records])
        if not (beside and later):
            self._end_row()

    def _end_row(self) -> None:
        """Wait for the row that is measured beside training, if there is one, and record it."""
        if self._row is not None:
            end, self._row = self._row, None
            end()

    def _record_row(self, stage: Sequence[int], best: int, records: Sequence[EvalRecord]) -> None:
        """Record the end of a stage, all of whose evaluations are recorded, and tell what it came to."""
        task, results = stage[-1], self.log.read()
        row = [record for record in records if record.phase == "matrix"]
        under = [record for record in records if record.phase == "shift"]
        if results.task_end(task) is None:
            spent = sum(r.seconds for r in results.of(LossRecord) if r.task == task)
            spent += sum(r.seconds for r in self.log.read().of(EvalRecord) if r.learned == task)
            self.log.append(TaskEndRecord(task=task, best_epoch=best, seconds=spent))
        new, mean = mean_rate([r for r in row if r.task in stage]), mean_rate(row)
        whole = mean if len(row) == task + 1 else math.nan  # of a part of the tasks it is another number
        values = {"success/just_learned": new, "success/mean": whole, "tasks": task + 1}
        known = {name: value for name, value in values.items() if not math.isnan(value)}
        self.context.tracker.log(known, len(results.of(LossRecord)))
        told = f"success {new:.0%} on it, {mean:.0%} over {len(row)} so far" if row else "not measured"
        if under and self.context.shift:
            told += f", {mean_rate(under):.0%} over {len(under)} under {self.context.shift.text}"
        self._tell(f"  task {task + 1} learned: {told}{self._eta(task)}")

    def _tell(self, progress: str) -> None:
        if not is_quiet():
            say(self.context, progress)

    def _evaluate_untrained(self) -> None:
        """Evaluate tasks before the first is learned, where that is asked for."""
        for task in self.context.untrained:
            self.evaluator.evaluate("initial", 0, task, 0)

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
        rows = [self.context.eval.row(stage, count) for stage in self.stages if stage[-1] > task]
        train, measure = remaining * training / learned, sum(map(len, rows)) * sum(cells) / max(1, len(cells))
        seconds = max(train, measure) if self.context.eval.beside else train + measure
        return f"; about {max(1, round(seconds / 60))} min left"


def meet(
    policy: Policy,
    data: Mapping[int, TaskWindows] | Sequence[TaskWindows],
    ends: Sequence[int],
    last: int,
    instruction: str,
    statistics: Statistics | None,
    frames: dict[int, tuple[Tensor, Tensor]],
) -> None:
    """Tell a policy of a stage, and normalise it by the stages that count before it is learned.

    Args:
        data: Windows by the last task of their stage.
        ends: Last task of every stage, in learning order.
        last: Last task of the stage.
        instruction: Its instruction as text.
        statistics: Value of `data.statistics`.
        frames: Readings and actions of stages that were read already; others are added.
    """
    policy.meet_task(data[last], instruction)
    kind = statistics or policy.statistics
    if kind == "constants":
        return
    counted = {"first": ends[:1], "seen": ends[: ends.index(last) + 1], "stream": ends}.get(kind, [last])
    for end in counted:
        if end not in frames:
            frames[end] = frames_of(data[end], tuple(policy.spec.proprio))
    policy.normalise(frame_moments([frames[end] for end in counted]), once=kind == "first")
