"""A held-out shift: perturbations under which a run's policies are evaluated besides its success matrix."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import Tensor

from libero_env.perturbations import (
    Perturbation,
    format_perturbations,
    perturb_task,
    replace_perturbations,
    reword_task,
)
from libero_env.sim.scene import build_scene
from libero_env.tasks import Task
from lifelong.data.settings import DataSettings
from lifelong.errors import ConfigError


@dataclass(frozen=True)
class HeldOutShift:
    """A shift, and what becomes of the tasks under it.

    Attributes:
        text: The perturbations, as text.
        perturb: Perturbations of each task: its own, and those of the shift, which replace own ones of the same kind.
        languages: (K, L) embeddings of the instructions under the shift.
    """

    text: str
    perturb: tuple[tuple[Perturbation, ...], ...]
    languages: Tensor


def held_out_shift(
    shift: Sequence[Perturbation],
    tasks: Sequence[Task],
    own: Sequence[Sequence[Perturbation]],
    languages: Tensor,
    data: DataSettings,
    embed: Callable[[list[str]], Tensor],
) -> HeldOutShift | None:
    """Return a held-out shift, or None without one.

    Args:
        shift: Its perturbations.
        tasks: Tasks without perturbations.
        own: Perturbations of each task, under which it is learned.
        languages: (K, L) embeddings of the instructions with which the tasks are learned.
        data: Drawing and robot of the scenes.
        embed: Function that returns the embeddings of all instructions of a run and further ones, (N, L).

    Raises:
        ConfigError: The shift changes instructions, and they are identified by their position.
        LiberoError: A task cannot be perturbed so, or perturbations exclude each other.
    """
    if not shift:
        return None
    perturb = tuple(replace_perturbations(found, shift) for found in own)
    said = [reword_task(task, found).language for task, found in zip(tasks, own, strict=True)]
    words = [_instruction(task, found, data) for task, found in zip(tasks, perturb, strict=True)]
    if words == said:
        return HeldOutShift(format_perturbations(shift), perturb, languages)
    found = embed(words)
    if found.shape[1] != languages.shape[1]:
        raise ConfigError(
            f"eval.shift={format_perturbations(shift)} changes instructions, and this language encoder knows tasks by "
            "their position; choose another, such as language=minilm"
        )
    return HeldOutShift(format_perturbations(shift), perturb, found)


def _instruction(task: Task, perturb: Sequence[Perturbation], data: DataSettings) -> str:
    """Return the instruction of a perturbed task; its scene is built only where the problem changes in other ways."""
    if all(one.kind == "instruction" for one in perturb if one.definition.layer == "problem"):
        return reword_task(task, perturb).language
    scene = build_scene(task.problem, drawing=data.drawing, robot=data.robot)
    return perturb_task(task, perturb, scene).language
