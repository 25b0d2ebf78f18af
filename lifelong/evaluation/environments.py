"""Environments of an evaluation: the interface that rollouts use, a pool, held-out shifts, what numbers depend on."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.errors import RenderError
from libero_env.perturbations import (
    Perturbation,
    format_perturbations,
    perturb_task,
    replace_perturbations,
    reword_task,
)
from libero_env.sim.render import renderer_name
from libero_env.sim.scene import build_scene
from libero_env.tasks import Task
from lifelong.data.settings import CAMERAS, DataSettings
from lifelong.errors import ConfigError
from lifelong.evaluation.actors import Obs
from lifelong.evaluation.settings import EvalSettings
from lifelong.types import PolicySpec

if TYPE_CHECKING:  # judging needs no PyTorch
    from torch import Tensor


class VectorEnv(Protocol):
    """Interface of `libero_env.envs.batch.BatchEnv` that rollouts use; finished simulations are not stepped.

    An environment may have `atoms`, the atoms of the goal as text; then its infos report under `progress` which of
    them hold, (B, atoms) bool.
    """

    num_envs: int

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> tuple[Obs, dict]: ...

    def step(self, actions: np.ndarray) -> tuple[Obs, np.ndarray, np.ndarray, np.ndarray, dict]: ...

    def close(self) -> None: ...


class EnvPool:
    """Environments by task, at most `capacity` of them open; the least recently used is closed first."""

    def __init__(self, make: Callable[[Any], VectorEnv], capacity: int = 4):
        """Initialise an empty pool.

        Args:
            make: Function that builds the environment of a key.
            capacity: Maximum number of open environments.
        """
        self._make, self._capacity = make, max(1, capacity)
        self._open: OrderedDict[Hashable, VectorEnv] = OrderedDict()

    def get(self, key: Hashable) -> VectorEnv:
        """Return the environment of a key; it is built if it is not open."""
        if key not in self._open:
            while len(self._open) >= self._capacity:
                self._open.popitem(last=False)[1].close()
            self._open[key] = self._make(key)
        self._open.move_to_end(key)
        return self._open[key]

    def empty(self) -> EnvPool:
        """Return another pool that builds as this one does."""
        return EnvPool(self._make, self._capacity)

    def close(self) -> None:
        """Close all environments."""
        while self._open:
            self._open.popitem()[1].close()

    def __enter__(self) -> EnvPool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run_environment(
    task: Task,
    simulations: int,
    spec: PolicySpec,
    settings: EvalSettings,
    data: DataSettings,
    perturb: Sequence[Perturbation] = (),
    horizon: int | None = None,
) -> BatchEnv:
    """Return an environment in which a run's policy acts.

    Args:
        simulations: Number of episodes that run side by side.
        spec: What the policy observes.
        settings: Back end, threads and horizon.
        data: Model of the arm, and how images are drawn.
        horizon: Maximum number of the policy's control steps; None for that of the settings.
    """
    return BatchEnv(
        task,
        simulations,
        num_threads=settings.sim_threads,
        cameras=tuple(CAMERAS[view] for view in spec.views),
        camera_size=spec.image_size,
        horizon=(settings.horizon if horizon is None else horizon) + settings.settle_steps,
        drawing=data.drawing,
        robot=data.robot,
        backend=settings.backend,
        perturb=tuple(perturb),
    )


@dataclass(frozen=True)
class HeldOutShift:
    """Perturbations under which a run's policies are evaluated besides its success matrix.

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
    again, found = embed([*said, *words]).split(len(said))
    if not again.equal(languages):  # the same texts, at other positions
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


def describe_environment(env: VectorEnv) -> dict[str, Any]:
    """Return the models, robot, drawing and back end of an environment, and the machine that runs it, as plain data.

    Args:
        env: Environment; one that is not a `libero_env.envs.batch.BatchEnv` contributes nothing.
    """
    found: dict[str, Any] = {}
    scene, simulations = getattr(env, "scene", None), getattr(env, "simulations", None)
    if scene is not None and simulations is not None:
        found |= {
            "models": scene.pack.name,
            "models_digest": getattr(scene.pack, "digest", None),
            "robot": scene.robot,
            "drawing": scene.drawing,
            **simulations.record(),
        }
    if (config := getattr(env, "config", None)) is not None and config.cameras and not config.backend.is_warp:
        backend, renderer = renderer_name()
        found |= {"gl": backend, "renderer": renderer}
    if find_spec("torch") is None:
        return found
    import torch

    return found | {
        "instruction_set": torch.backends.cpu.get_cpu_capability(),
        "policy_threads": torch.get_num_threads(),
    }


def renderer_name_or_none() -> str | None:
    """Return the name of the OpenGL renderer, such as `llvmpipe (LLVM 15.0.6)`; None where nothing can be drawn."""
    try:
        return renderer_name()[1]
    except RenderError:  # said where something is drawn
        return None


def common_environment(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the environments of several processes as one; a value that differs becomes the list of its values."""
    together: dict[str, Any] = {}
    for name in dict.fromkeys(key for one in found for key in one):
        values: list[Any] = []
        for one in found:
            if one.get(name) not in values:
                values.append(one.get(name))
        together[name] = values[0] if len(values) == 1 else values
    return together
