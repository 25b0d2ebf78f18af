"""The walk through the task sequence: learn a task, keep its best weights, evaluate all tasks so far.

It can be killed anywhere. What is done is found again in the records and checkpoints; the rest comes out with
the same bits, because all randomness is derived from the seed and the place in the sequence.

Where several processes train together, all of them walk, but only the first evaluates and writes. They wait for
each other wherever one reads what another has written, or will write anew.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from libero_env.timing import CONTROL_PERIOD
from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm, Phase, WindowDataset
from lifelong.evaluation.environments import EnvPool
from lifelong.evaluation.rollout import rollout, save_animation
from lifelong.evaluation.settings import EvalSettings
from lifelong.policies.base import Policy
from lifelong.results.records import CostRecord, EvalRecord, LossRecord, TaskEndRecord
from lifelong.results.run_directory import RunDirectory
from lifelong.seeding import generator, seeded
from lifelong.streams import StageData, StreamSettings, stages_of
from lifelong.tracking import Tracker
from lifelong.training import costs
from lifelong.training.distributed import Ranks
from lifelong.training.fit import BatchAugmentation, EpochEnd, fit
from lifelong.training.settings import FitSettings

# First words of the seeds derived from the run's seed, one for each use; `lifelong.streams` has another.
FIT, END_TASK, ROLLOUT = 1, 2, 3
SAVE_EVERY = 60.0  # s between two saves while learning, but for those at points of the learning curve


@dataclass(frozen=True)
class Parts:
    """All that a walk needs, ready made."""

    instructions: tuple[str, ...]
    languages: Tensor  # (K, L)
    datasets: Mapping[int, WindowDataset]  # by position; each is read when asked for
    policy: Policy
    algorithm: Algorithm
    envs: EnvPool  # keys: (position, number of simulations)
    fit: FitSettings
    eval: EvalSettings
    augment: BatchAugmentation | None
    directory: RunDirectory
    tracker: Tracker
    seed: int
    device: torch.device
    progress: bool
    ranks: Ranks = Ranks()
    stream: StreamSettings = StreamSettings()
    group_size: int = 1


@dataclass(frozen=True)
class Stretch:
    """Where in the sequence training stands: a phase of a task, or of tasks that are learned together."""

    stage: Sequence[int]
    number: int
    phase: Phase
    epochs: int
    steps_per_epoch: int | None
    offset: int  # epochs of the task's earlier phases

    @property
    def task(self) -> int:
        """The last, if there are several."""
        return self.stage[-1]


class TaskSequence:
    """Learns the tasks in turn; `run` starts, or goes on where an earlier process stopped."""

    def __init__(self, parts: Parts):
        self.parts = parts
        parts.algorithm.augment = parts.augment
        self.log = parts.directory.log
        self._saved = time.monotonic()
        self.stages = stages_of(parts.algorithm, len(parts.instructions), parts.group_size)
        self.data = StageData(parts.datasets, self.stages, parts.stream, parts.seed)

    def run(self, *, evaluate: bool = True) -> None:
        """Learn whatever is not learned yet, and evaluate all tasks so far after each stage."""
        done = self._restore()
        if done and evaluate:
            self.parts.ranks.broadcast(self._finish, self.stages[done - 1])
        for stage in self.stages[done:]:
            self._learn(stage)
            if evaluate:
                self.parts.ranks.broadcast(self._finish, stage)

    def _restore(self) -> int:
        """Take up the state after the last stage that was learned; how many are."""
        p, done = self.parts, 0
        while done < len(self.stages) and p.directory.task_path(self.stages[done][-1]).exists():
            done += 1
        if done:
            self._take_up_task(self.stages[done - 1][-1])
        return done

    def _take_up_task(self, task: int) -> None:
        path = self.parts.directory.task_path(task)
        self._take_up(checkpoints.load(path, self.parts.device), str(path))

    def _take_up(self, state: Mapping[str, Any], source: str) -> None:
        if state.get("policy") is not None:
            checkpoints.load_weights(self.parts.policy, state["policy"], source)
        self.parts.algorithm.load_state_dict(state["algorithm"], self.data)

    def _learn(self, stage: Sequence[int]) -> None:
        """Train on a stage, from its beginning or from what is saved of it, and write its checkpoint."""
        p, task = self.parts, stage[-1]
        dataset, saved = self.data[task], p.directory.progress(task, p.device)
        numbers, what = f"Task {task + 1}", p.instructions[task]
        if len(stage) > 1:
            numbers, what = f"Tasks {stage[0] + 1}-{task + 1}", "together"
        self._say(f"{numbers}/{len(p.instructions)}: {what} ({len(dataset)} windows)")
        p.ranks.barrier()  # all have read what is saved
        costs.reset_peak(p.device)
        if saved is None:
            p.algorithm.begin_task(task, dataset, p.policy)
        else:
            self._take_up(saved, str(p.directory.progress_path))
        for stretch in self._stretches(stage):
            if saved is not None and stretch.number < saved["phase"]:
                continue
            resume = saved["fit"] if saved is not None and stretch.number == saved["phase"] else None
            self._train(stretch, dataset, resume)
            p.ranks.broadcast(self._save, task, stretch.number + 1)
        p.ranks.broadcast(self._end_task, task, dataset)
        if not p.ranks.first:
            self._take_up_task(task)

    def _end_task(self, task: int, dataset: WindowDataset) -> None:
        """What the algorithm does after a task, and the checkpoint of it."""
        p, draws = self.parts, generator(self.parts.seed, END_TASK, task)
        began = time.perf_counter()
        with seeded(p.seed, END_TASK, task, 1, device=p.device):  # for dropout
            p.algorithm.end_task(task, dataset, p.policy, draws)
        spent = {
            "end_task_seconds": time.perf_counter() - began,
            "stored_bytes": costs.stored_bytes(p.algorithm),
        }
        with p.algorithm.policy_for(task, p.policy) as acting:
            spent |= costs.action_costs(acting) | costs.peak_costs(p.device)
        self.log.append(CostRecord(task=task, costs=spent))
        state = {"task": task, "policy": p.policy.state_dict(), "algorithm": p.algorithm.state_dict()}
        checkpoints.save(p.directory.task_path(task), state)

    def _stretches(self, stage: Sequence[int]) -> list[Stretch]:
        stretches, offset = [], 0
        steps = self.parts.fit.steps_per_epoch
        steps = steps and steps * len(stage)  # as many for each task, together or not
        for number, phase in enumerate(self.parts.algorithm.phases()):
            epochs = max(1, round(self.parts.fit.epochs * phase.share))
            stretches.append(Stretch(stage, number, phase, epochs, steps, offset))
            offset += epochs
        return stretches

    def _train(self, stretch: Stretch, dataset: WindowDataset, resume: dict[str, Any] | None) -> None:
        """One phase, from its first step or a saved epoch to the weights that are kept of it."""
        p = self.parts
        if resume is None:
            p.algorithm.begin_phase(stretch.phase, p.policy)
        fit(
            p.policy,
            dataset,
            p.algorithm,
            settings=replace(p.fit, epochs=stretch.epochs, steps_per_epoch=stretch.steps_per_epoch),
            seed=(p.seed, FIT, stretch.task, stretch.number),
            device=p.device,
            augment=p.augment,
            on_epoch=lambda end: p.ranks.broadcast(self._after_epoch, stretch, end),
            resume=resume,
            label=f"task {stretch.task + 1} {stretch.phase.name}",
            progress=p.progress,
            ranks=p.ranks,
        )
        if self._selects(stretch):
            best = p.ranks.broadcast(self._best_epoch, stretch, stretch.epochs)
            state = checkpoints.load(p.directory.best_path, p.device)
            if (state["task"], state["epoch"]) != (stretch.task, best):
                raise checkpoints.CheckpointError(
                    f"{p.directory.best_path} is of task {state['task']}, epoch {state['epoch']}; expected "
                    f"task {stretch.task}, epoch {best}. Start afresh with resume=false"
                )
            checkpoints.load_weights(p.policy, state["policy"], str(p.directory.best_path))
            with torch.no_grad():
                for own, kept in zip(self._own(), state.get("own", []), strict=True):
                    own.copy_(kept)
        p.algorithm.end_phase(stretch.phase, p.policy)

    def _after_epoch(self, stretch: Stretch, end: EpochEnd) -> None:
        """Record the loss, save, and draw a point of the learning curve if one is due."""
        p, task, epoch = self.parts, stretch.task, stretch.offset + end.epoch
        if end.epoch and not self.log.read().has_loss(task, epoch):
            self.log.append(LossRecord(task=task, epoch=epoch, loss=end.loss, seconds=end.seconds))
            p.tracker.log({"epoch": epoch, f"loss/{task}": end.loss, f"penalty/{task}": end.penalty})
        if (stretch.number, end.epoch) == (0, stretch.epochs) and not self.log.read().costs(task):
            spent = costs.step_costs(p.policy, p.algorithm, self.data[task], p.fit.batch_size)
            self.log.append(CostRecord(task=task, costs=spent))
        due = end.epoch in p.eval.curve_epochs(stretch.epochs)
        if due or time.monotonic() - self._saved > SAVE_EVERY:
            self._save(task, stretch.number, end.state())
        if not (due and stretch.phase.measures_transfer):
            return
        success = _mean([self._evaluate("curve", task, one, epoch) for one in stretch.stage])
        loss = f"loss {end.loss:7.3f}, " if end.epoch else ""
        self._say(f"  epoch {epoch:3d}: {loss}success {success:4.0%}")
        if self._selects(stretch) and self._best_epoch(stretch, end.epoch) == end.epoch:
            best = {"task": task, "epoch": end.epoch, "policy": p.policy.state_dict(), "own": self._own()}
            checkpoints.save(p.directory.best_path, best)

    def _own(self) -> list[Tensor]:
        """What is trained besides the policy's parameters: the algorithm's own."""
        of_policy = {id(p) for p in self.parts.policy.parameters()}
        return [p for p in self.parts.algorithm.trained(self.parts.policy) if id(p) not in of_policy]

    def _selects(self, stretch: Stretch) -> bool:
        return self.parts.eval.select == "best" and stretch.phase.measures_transfer

    def _best_epoch(self, stretch: Stretch, until: int) -> int:
        """The earliest epoch of the phase with the highest success on the curve so far."""
        results = self.log.read()
        rates = {}
        for epoch in self.parts.eval.curve_epochs(stretch.epochs):
            keys = [("curve", stretch.task, task, stretch.offset + epoch) for task in stretch.stage]
            found = [record for key in keys if (record := results.evaluation(*key)) is not None]
            if epoch <= until and len(found) == len(keys):
                rates[epoch] = _mean(found)
        return max(rates, key=lambda e: (rates[e], -e))

    def _save(self, task: int, phase: int, fit_state: dict[str, Any] | None = None) -> None:
        """Save where learning a task stands: inside a phase, or before it."""
        p = self.parts
        state = {"task": task, "phase": phase, "fit": fit_state, "algorithm": p.algorithm.state_dict()}
        state["policy"] = None if fit_state is not None else p.policy.state_dict()
        checkpoints.save(p.directory.progress_path, state)
        self._saved = time.monotonic()

    def _finish(self, stage: Sequence[int]) -> None:
        """Evaluate all tasks so far, unless that is done."""
        p, task, results = self.parts, stage[-1], self.log.read()
        first = self._stretches(stage)[0]
        best = self._best_epoch(first, first.epochs) if self._selects(first) else first.epochs
        row = [self._evaluate("matrix", task, other, best) for other in range(task + 1)]
        if results.task_end(task) is None:
            spent = sum(r.seconds for r in results.of(LossRecord) if r.task == task)
            spent += sum(r.seconds for r in results.of(EvalRecord) if r.learned == task and r not in row)
            spent += sum(r.seconds for r in row)
            self.log.append(TaskEndRecord(task=task, best_epoch=best, seconds=spent))
        new, mean = _mean([r for r in row if r.task in stage]), _mean(row)
        p.tracker.log({"success/just_learned": new, "success/mean": mean, "tasks": task + 1})
        text = f"  learned: success {new:.0%} on it, {mean:.0%} over {task + 1} so far"
        self._say(text + self._left(task))

    def _evaluate(self, phase: Literal["curve", "matrix"], learned: int, task: int, epoch: int) -> EvalRecord:
        """Rollouts on a task, or their record if they were done before."""
        p = self.parts
        found = self.log.read().evaluation(phase, learned, task, epoch if phase == "curve" else None)
        if found is not None:
            return found
        states = p.eval.init_states(phase)
        shown = phase == "matrix" and (task == learned or learned == len(p.instructions) - 1)
        stage = next(stage for stage in self.stages if task in stage)
        with p.algorithm.policy_for(stage[-1], p.policy) as acting:
            rollouts = rollout(
                acting,
                p.envs.get((task, len(states))),
                states,
                language=p.languages[task],
                horizon=p.eval.horizon,
                settle_steps=p.eval.settle_steps,
                seed=(p.seed, ROLLOUT, learned, epoch, task),
                device=p.device,
                precision=p.eval.precision,
                record_every=p.eval.record_every if shown else 0,
                label=f"rollouts on task {task + 1}",
                progress=p.progress,
            )
        if rollouts.frames:
            self._save_video(learned, task, rollouts.frames, rollouts.episodes[0].success)
        record = EvalRecord(
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
        self.log.append(record)
        return record

    def _save_video(self, learned: int, task: int, frames: tuple, success: bool) -> None:
        p = self.parts
        path = p.directory.videos / f"task_{task:02d}_after_{learned:02d}.webp"
        save_animation(frames, path, seconds_per_frame=CONTROL_PERIOD * p.eval.record_every)
        outcome = "success" if success else "failure"
        caption = f"{p.instructions[task]}: {outcome}, after learning {learned + 1} tasks"
        path.with_suffix(".txt").write_text(caption + "\n", encoding="utf-8")

    def _left(self, task: int) -> str:
        """An estimate of the time left, from what training a task and filling a cell took so far."""
        results, size = self.log.read(), len(self.parts.instructions)
        learned, left = task + 1, size - task - 1
        if not left:
            return ""
        evals = results.of(EvalRecord)
        cells = [r.seconds for r in evals if r.phase == "matrix"]
        once = sum(r.seconds for r in results.of(LossRecord))
        once += sum(r.seconds for r in evals if r.phase == "curve")
        todo = sum(stage[-1] + 1 for stage in self.stages if stage[-1] > task)
        seconds = left * once / learned + todo * sum(cells) / len(cells)
        return f"; about {max(1, round(seconds / 60))} min left"

    def _say(self, text: str) -> None:
        if self.parts.ranks.first:
            print(text, flush=True)


def _mean(records: Sequence[EvalRecord]) -> float:
    """The mean success of evaluations."""
    return sum(r.rate for r in records) / len(records)
