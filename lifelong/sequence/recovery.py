"""Recovery of a run that was killed: what checkpoints hold, which of it can be used, and what is saved meanwhile."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lifelong import checkpoints
from lifelong.algorithms.base import Algorithm, load_algorithm
from lifelong.context import RunContext
from lifelong.errors import CheckpointError, DamagedCheckpointError
from lifelong.sequence.stages import TrainingPhase, training_phases
from lifelong.streams import StageData
from lifelong.training.fit import EpochEnd

State = dict[str, Any]  # of a checkpoint

SAVE_EVERY = 60.0  # [s] between two saves during training, besides those at points of the learning curve


class Recovery:
    """Saves and loads the policy and the algorithm of a run; a damaged checkpoint is set aside.

    Args:
        context: Everything the run consists of.
        data: Windows of each stage.
    """

    def __init__(self, context: RunContext, data: StageData):
        self.context, self.data = context, data
        self.log, self.checkpoints = context.directory.log, context.directory.checkpoints
        self._saved = time.monotonic()
        self._attributes, self._named = _attributes(context.algorithm), set[str]()

    def load_stage(self, stage: Sequence[int]) -> bool:
        """Load what was saved after a stage; return whether there was an intact checkpoint."""
        path = self.checkpoints.task_path(stage[-1])
        state = self._load(path, partial(self.checkpoints.load_task, path))
        if state is not None:
            self._apply(state, path)
        return state is not None

    def apply_stage(self, stage: Sequence[int]) -> None:
        """Load what another rank has just saved after a stage."""
        path = self.checkpoints.task_path(stage[-1])
        self._apply(self.checkpoints.load_task(path, self.context.device), path)

    def load_progress(self, stage: Sequence[int]) -> State | None:
        """Load the latest saved progress on a stage that training can go on from, and return it; None without any."""
        for path in (self.checkpoints.progress_path, self.checkpoints.previous_path):
            state = self._load(path, partial(self.checkpoints.load_progress, path))
            if state is not None and self.context.ranks.broadcast(self._is_usable, state, stage):
                self._apply(state, path)
                return state
            if state is not None and state["task"] == stage[-1]:
                say(self.context, f"{path} is not used: records or weights that go with it are lost")
        return None

    def _is_usable(self, state: State, stage: Sequence[int]) -> bool:
        """Return whether what comes after a saved progress needs nothing that is lost.

        It may need the points of the learning curve before it, and the weights of the best of them.
        """
        phases, fit, results = training_phases(self.context, stage), state["fit"], self.log.read()
        if state["task"] != stage[-1] or not 0 <= state["phase"] <= len(phases):
            return False
        if any(phase.missing_points(results) for phase in phases[: state["phase"]]):
            return False
        if 0 in stage and any(results.evaluation("initial", 0, t) is None for t in self.context.untrained):
            return False
        if fit is None or state["phase"] == len(phases):
            return fit is None
        phase = phases[state["phase"]]
        if not 0 <= fit["epoch"] <= phase.epochs or phase.missing_points(results, before=fit["epoch"]):
            return False
        best = (
            phase.best_epoch(results, phase.epochs) if phase.selects_best and phase.points(results) else None
        )
        if best is None or best >= fit["epoch"]:  # not reached yet: its weights will be saved
            return True
        path = self.checkpoints.best_path
        kept = self._load_intact(path, self.checkpoints.load_best)
        return kept is not None and (kept["task"], kept["epoch"]) == (stage[-1], best)

    def save_progress(self, task: int, phase: int, fit_state: dict[str, Any] | None = None) -> None:
        """Save the progress on a task: inside a phase, or before it."""
        state = {"task": task, "phase": phase, "fit": fit_state, "algorithm": self.algorithm_state()}
        state["policy"] = None if fit_state is not None else self.context.policy.state_dict()
        self.checkpoints.save_progress(state)
        self._saved = time.monotonic()

    def algorithm_state(self) -> State:
        """Return the state of the algorithm, and say, once, which attributes have changed that it does not hold.

        A class with a `state_dict` of its own may hold them under other names, so there only an empty one tells.
        """
        algorithm, state = self.context.algorithm, self.context.algorithm.state_dict()
        is_known = type(algorithm).state_dict is Algorithm.state_dict or not state
        changed = _attributes(algorithm).items() - self._attributes.items() if is_known else ()
        if lost := {name for name, _ in changed} - set(state) - self._named:
            say(
                self.context,
                f"warning: {type(algorithm).__name__} changes {', '.join(sorted(lost))}, which no checkpoint holds: a "
                "killed run goes on without; name them in state_form, or return them from state_dict",
            )
            self._named |= lost
        return state

    def is_due(self) -> bool:
        """Return whether the last save of progress is so long ago that another one is due."""
        return time.monotonic() - self._saved > SAVE_EVERY

    def save_best(self, phase: TrainingPhase, end: EpochEnd) -> None:
        """Save the weights as the best so far of a phase."""
        weights, own = self.context.policy.state_dict(), self._algorithm_parameters()
        self.checkpoints.save_best(phase.task, end.epoch, weights, own)

    def load_best(self, phase: TrainingPhase) -> None:
        """Load the weights of the phase's best epoch."""
        context, path = self.context, self.checkpoints.best_path
        best = context.ranks.broadcast(lambda: phase.best_epoch(self.log.read(), phase.epochs))
        state = self.checkpoints.load_best(context.device)
        if (state["task"], state["epoch"]) != (phase.task, best):
            raise CheckpointError(
                f"{path} is of task {state['task']}, epoch {state['epoch']}; expected task {phase.task}, "
                f"epoch {best}. Run the same command again: the task is learned from its start"
            )
        checkpoints.load_weights(context.policy, state["policy"], path)
        own = self._algorithm_parameters()
        if [p.shape for p in own] != [kept.shape for kept in state["own"]]:
            raise CheckpointError(f"{path} has other parameters of the algorithm than this run")
        with torch.no_grad():
            for parameter, kept in zip(own, state["own"], strict=True):
                parameter.copy_(kept)

    def _load(self, path: Path, load: Callable[[torch.device], State]) -> State | None:
        """Return the state in a checkpoint on all ranks; see `_load_intact`."""
        found: list[State | None] = []

        def look() -> bool:
            found.append(self._load_intact(path, load))
            return found[0] is not None

        there = self.context.ranks.broadcast(look)
        return found[0] if found else load(self.context.device) if there else None

    def _load_intact(self, path: Path, load: Callable[[torch.device], State]) -> State | None:
        """Return the state in a checkpoint; None where there is none, or a damaged one, which is set aside."""
        if not path.exists():
            return None
        try:
            return load(self.context.device)
        except DamagedCheckpointError as error:
            name = self.checkpoints.set_aside(path).name
            say(
                self.context,
                f"{error}; it is kept as {name}, and the run goes on from what was saved before it",
            )
            return None

    def _apply(self, state: State, path: Path) -> None:
        policy, algorithm = self.context.policy, self.context.algorithm
        if state.get("policy") is not None:
            checkpoints.load_weights(policy, state["policy"], path)
        load_algorithm(algorithm, state["algorithm"], self.data, policy, path)

    def _algorithm_parameters(self) -> list[Tensor]:
        """Return the parameters that are trained besides those of the policy."""
        of_policy = {id(p) for p in self.context.policy.parameters()}
        return [p for p in self.context.algorithm.trained(self.context.policy) if id(p) not in of_policy]


def _attributes(algorithm: Algorithm) -> dict[str, tuple[int, int]]:
    """Return by name which object each public attribute is, and how much a collection holds."""
    return {
        name: (id(value), len(value) if isinstance(value, dict | list | set) else 0)
        for name, value in vars(algorithm).items()
        if name != "augment" and not name.startswith("_")
    }


def say(context: RunContext, text: str) -> None:
    """Print a line, on the first rank."""
    if context.ranks.first:
        print(text, flush=True)
