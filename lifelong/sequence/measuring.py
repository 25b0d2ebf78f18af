"""Rollouts of a run: each evaluation is recorded once, and what would repeat another to the bit is copied.

Columns of the success matrix are constant where an algorithm never changes what acts on a task: the rollouts of the
first row that has it are those of all others.
"""

import hashlib
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from libero_env.errors import SimulationError
from libero_env.perturbations import format_perturbations
from libero_env.storage import atomic_path, atomic_write_text
from libero_env.timing import CONTROL_PERIOD
from lifelong.context import RunContext
from lifelong.evaluation.beside import RolloutProcess
from lifelong.evaluation.rollout import Rollouts, rollout, save_animation
from lifelong.policies.base import Policy, has_hooks
from lifelong.results.provenance import all_conditions
from lifelong.results.records import EvalRecord, Phase, RunRecord
from lifelong.results.results import Results
from lifelong.seeding import ROLLOUT
from lifelong.sequence.recovery import say


class Evaluator:
    """Measures the success of the policy that acts on a task, and records it.

    Args:
        context: Everything the run consists of; its policy and algorithm are evaluated as they are.
        stages: Tasks that are learned together, for each stage.
    """

    def __init__(self, context: RunContext, stages: Sequence[Sequence[int]]):
        self._context, self._stages, self._log = context, stages, context.directory.log

    def evaluate(self, phase: Phase, learned: int, task: int, epoch: int) -> EvalRecord:
        """Evaluate a task and record it, or return the record if there is one.

        Args:
            phase: Whether the rollouts are a point of a learning curve, a cell of the success matrix, or under the
                held-out shift.
            learned: Position of the task that was learned last.
            task: Position of the task to act on.
            epoch: Number of epochs trained on the task that was learned last.
        """
        return self.begin(phase, learned, task, epoch)()

    def begin(
        self, phase: Phase, learned: int, task: int, epoch: int, beside: RolloutProcess | None = None
    ) -> Callable[[], EvalRecord]:
        """Begin to evaluate a task; return a function that waits for the rollouts, and records them.

        Args:
            beside: Process in which the rollouts run; by default they run in this one, at once.
        """
        context, (shift, languages) = self._context, self._told(phase)
        known = epoch if phase == "curve" else None
        found = self._log.read().evaluation(phase, learned, task, known, shift=shift)
        if found is not None:
            return lambda: found
        key: dict[str, Any] = {
            "phase": phase,
            "learned": learned,
            "epoch": epoch,
            "task": task,
            "shift": shift,
        }
        owner = learned if task in context.never_learned else task
        stage = next(stage for stage in self._stages if owner in stage)
        with context.algorithm.policy_for(stage[-1], context.policy) as acting:
            decided_by = ""
            if context.eval.reuse:
                more = context.algorithm.acting_state(stage[-1], acting)
                decided_by = digest({**self._circumstances(phase, task), "more": more}, acting)
            if (copied := self._copied(decided_by, key)) is not None:
                return partial(self._recorded, copied)
            done = self._rollouts(acting, key, languages[task], beside)
        return lambda: self._recorded(self._measured(done(), decided_by, key))

    def _recorded(self, record: EvalRecord) -> EvalRecord:
        self._log.append(record)
        for note in Results((record,)).error_notes:
            say(self._context, note)
        return record

    def _told(self, phase: Phase) -> tuple[str, Tensor]:
        """Return the held-out shift of rollouts as text, empty for those without, and what policies are told (K, L)."""
        shift = self._context.shift
        return (
            ("", self._context.languages)
            if phase != "shift" or shift is None
            else (shift.text, shift.languages)
        )

    def _circumstances(self, phase: Phase, task: int) -> dict[str, Any]:
        """Return what rollouts depend on besides what acts, within one run."""
        context, settings, (shift, languages) = self._context, self._context.eval, self._told(phase)
        starts = self._log.read().of(RunRecord)
        perturb = format_perturbations(() if task in context.never_learned else context.perturbed[task])
        return {
            **({"perturb": perturb} if perturb else {}),
            **({"shift": shift} if phase == "shift" else {}),
            **({"backend": settings.backend} if settings.back_end.is_warp else {}),
            "task": task,
            "language": languages[task],
            "init_states": str(list(settings.init_states(phase))),
            "settings": f"{settings.horizon} {settings.settle_steps} {settings.precision}",
            "conditions": all_conditions(starts[-1]) if starts else {},
        }

    def _copied(self, decided_by: str, key: Mapping[str, Any]) -> EvalRecord | None:
        """Return the record of rollouts that would repeat recorded ones; None where there are none."""
        found = self._log.read().original(decided_by)
        if found is None or found.task != key["task"]:
            return None
        if self._is_filmed(key) and not self._copy_video(found, key["learned"]):
            return None
        return replace(found, seconds=0.0, same_as=(found.phase, found.learned, found.epoch), **key)

    def _rollouts(
        self, acting: Policy, key: Mapping[str, Any], language: Tensor, beside: RolloutProcess | None
    ) -> Callable[[], Rollouts]:
        """Run the rollouts, or send them; return a function that returns them."""
        context, settings, task, shift = self._context, self._context.eval, key["task"], key["shift"]
        states = settings.init_states(key["phase"])
        env = (task, len(states), shift) if shift else (task, len(states))
        options: dict[str, Any] = {
            "language": language,
            "horizon": settings.horizon,
            "settle_steps": settings.settle_steps,
            "seed": (context.seed, ROLLOUT, key["learned"], key["epoch"], task),
            "device": context.device,
            "precision": settings.precision,
            "record_every": settings.record_every if self._is_filmed(key) else 0,
        }
        if beside is not None and not has_hooks(acting):
            return beside.submit(rollout, acting, env, states, **options)
        shown: dict[str, Any] = {"label": f"rollouts on task {task + 1}", "progress": context.progress}
        done = rollout(acting, context.envs.get(env), states, **options, **shown)
        return lambda: done

    def _measured(self, done: Rollouts, decided_by: str, key: Mapping[str, Any]) -> EvalRecord:
        """Return the record of rollouts, and save what is filmed."""
        settings, task = self._context.eval, key["task"]
        if not done.counted:
            raise SimulationError(done.failed)
        record = EvalRecord(
            seconds=done.seconds,
            atoms_at_start=tuple(e.at_start for e in done.counted),
            decided_by="" if done.random else decided_by,
            **key,
            **done.columns(),
        )
        if done.frames:
            path = self._video(record.learned, task)
            save_animation(done.frames, path, seconds_per_frame=CONTROL_PERIOD * settings.record_every)
            self._write_caption(path, record)
        return record

    def _is_filmed(self, key: Mapping[str, Any]) -> bool:
        """Return whether rollouts are filmed: those of a task just learned, and those at the end."""
        if not self._context.eval.record_every or key["phase"] != "matrix":
            return False
        learned = next(stage[-1] for stage in self._stages if key["task"] in stage)
        return key["learned"] in (learned, len(self._context.tasks) - 1)

    def _video(self, learned: int, task: int) -> Path:
        return self._context.directory.videos / f"task_{task:02d}_after_{learned:02d}.webp"

    def _copy_video(self, original: EvalRecord, learned: int) -> bool:
        """Copy the video of rollouts as that after learning another task; return whether there is one."""
        source, path = self._video(original.learned, original.task), self._video(learned, original.task)
        if original.phase != "matrix" or source.is_symlink() or not source.is_file():
            return False
        if source != path:
            with atomic_path(path) as part:
                shutil.copyfile(source, part)
        self._write_caption(path, replace(original, learned=learned))
        return True

    def _write_caption(self, path: Path, record: EvalRecord) -> None:
        """Write what a video shows: the first of the episodes."""
        won = dict(zip(record.init_states, record.successes, strict=True))
        first = self._context.eval.init_states("matrix")[0]
        outcome = {True: "success", False: "failure", None: "simulation error"}[won.get(first)]
        said = self._context.instructions[record.task]
        caption = f"{said}: {outcome}, after learning {record.learned + 1} tasks"
        atomic_write_text(path.with_suffix(".txt"), caption + "\n")


def digest(circumstances: Mapping[str, Any], acting: Policy) -> str:
    """Return 32 hex digits that change with every parameter and buffer of a policy, and with the circumstances.

    Args:
        circumstances: Nested dictionaries, lists and tuples of tensors, numbers and strings.
    """
    found = hashlib.sha256()
    tensors = {"parameters": dict(acting.named_parameters()), "buffers": dict(acting.named_buffers())}
    _feed(found, {**circumstances, **tensors})
    return found.hexdigest()[:32]


def _feed(found: Any, value: Any) -> None:
    """Add nested plain data to a digest, with their structure."""
    if isinstance(value, Tensor):
        found.update(f"tensor {value.dtype} {tuple(value.shape)}\0".encode())
        found.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy())
    elif isinstance(value, Mapping):
        found.update(f"mapping {len(value)}\0".encode())
        for key, part in value.items():
            found.update(f"{key!r}\0".encode())
            _feed(found, part)
    elif isinstance(value, list | tuple):
        found.update(f"sequence {len(value)}\0".encode())
        for part in value:
            _feed(found, part)
    else:
        found.update(f"{value!r}\0".encode())
