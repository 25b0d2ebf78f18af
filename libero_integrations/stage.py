"""What `libero view` shows, without a browser: starts, perturbations, recorded demonstrations, a policy that acts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from libero_env.demos.agreement import recorded_frequency
from libero_env.demos.config import RenderConfig
from libero_env.demos.observe import fixture_poses, recorded_robot, recorded_task
from libero_env.demos.read import Episode, read_episodes
from libero_env.errors import InvalidInputError
from libero_env.mujoco_compat import mujoco
from libero_env.perturbations import Perturbation, format_perturbations, parse_perturbations
from libero_env.sim.observations import image_name
from libero_env.tasks import Task, find_tasks, read_task
from libero_eval.plan import load_policy, resolve_protocol
from libero_eval.protocols.environment import ProtocolEnv
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import EvalRequest, ViewRequest
from lifelong.evaluation.actors import Actor, Obs, WatchesWorld
from lifelong.evaluation.rollout import run_episodes

POLICY = "policy"  # what is shown where it is not a recorded demonstration
_TASK_FILES = (".bddl", ".yaml", ".yml")


@dataclass(frozen=True)
class Choice:
    """What is to be shown.

    Attributes:
        source: `POLICY`, or the name of a recorded demonstration.
        start: Initial state in which the policy starts.
        perturbations: Perturbations of a severity above 0.
    """

    task: Task
    source: str = POLICY
    start: int = 0
    perturbations: tuple[Perturbation, ...] = ()


class Stage:
    """A simulation that is put into the frames of an episode: of a recorded one, or of one in which a policy acts.

    Args:
        request: What is asked for.

    Attributes:
        tasks: Tasks to choose from.
        sources: What can be shown of them: `POLICY`, and the names of recorded demonstrations.
        initial: What is shown first.
        choice: What is shown.
        env: The simulation.
        frames: States of the episode: those of `BatchEnv.get_state`, or [time, qpos, qvel] of a recording.
        truths: Whether each atom of the goal holds in each frame.
        is_reached: Whether the goal holds in each frame.

    Raises:
        LiberoError: The task, the policy or the file does not exist, or is not valid.
    """

    def __init__(self, request: ViewRequest):
        self.request, what = request, request.what
        self._file = Path(what) if what.endswith(".hdf5") else None
        is_run = self._file is None and not what.endswith(_TASK_FILES) and Path(what).exists()
        if request.bddl is not None and self._file is None:
            raise InvalidInputError(f"--bddl is of demonstration files, and {what} is not one")
        if is_run and request.policy is not None:
            raise InvalidInputError(
                f"{what} is a run, whose policy acts: leave out --policy {request.policy}"
            )
        evaluation = EvalRequest(
            policy=what if is_run else request.policy or "expert",
            protocol=request.protocol,
            seed=request.seed,
            assets=request.assets,
            robot=None if self._file is None else recorded_robot(self._file),
            control_freq=None if self._file is None else recorded_frequency(self._file),
            device=request.device,
            allow=request.allow,
        )
        self.sources: tuple[str, ...] = (POLICY,)
        self.tasks: Sequence[Task] = ()
        if self._file is not None:
            self.tasks = [recorded_task(self._file) if request.bddl is None else read_task(request.bddl)]
            self.sources = (*(one.name for one in read_episodes(self._file, observations=False)), POLICY)
        elif not is_run:
            self.tasks = find_tasks([what])
        self.policy = load_policy(evaluation)
        self.tasks = self.tasks or self.policy.tasks
        base = self.policy.protocol(load_protocol(request.protocol))
        self._protocol = resolve_protocol(evaluation, base, self.tasks)
        perturb = request.perturb or self._protocol.world.perturb
        perturbations = parse_perturbations(perturb, request.perturb_seed)
        self.initial = Choice(
            self.tasks[0], self.sources[0], request.start, tuple(one for one in perturbations if one.severity)
        )
        self.choice: Choice | None = None
        self.env: ProtocolEnv | None = None
        self.frames: list[np.ndarray] = []
        self.truths: list[dict[str, bool]] = []
        self.is_reached: list[bool] = []

    @property
    def protocol(self) -> EvalProtocol:
        """Protocol of the episodes, with the perturbations that are chosen."""
        chosen = () if self.choice is None else self.choice.perturbations
        return self._protocol.changed({"world.perturb": format_perturbations(chosen)})

    def open(self, choice: Choice) -> None:
        """Take the episode that is chosen, or the first frame of the one that the policy would act in.

        Raises:
            LiberoError: The perturbations do not fit the task or the recording, or there is no such start.
        """
        before, self.choice = self.choice, choice
        self._clear()
        if choice.source != POLICY:
            RenderConfig(perturb=choice.perturbations)  # refuses those that recorded states do not have
        if before is None or (before.task, before.perturbations) != (choice.task, choice.perturbations):
            self.close()
        if self.env is None:
            self.env = ProtocolEnv(
                self.protocol, choice.task, 1, cameras=(), threads=1, assets=self.request.assets
            )
        if choice.source == POLICY:
            self.env.reset(options={"init_state": choice.start})
            self._add(self.env.get_state(0))
            return
        episode = self._recording(choice.source)
        self.env.simulations.fixtures[0] = fixture_poses(
            episode, self.env.scene, f"{self._file}: {episode.name}"
        )
        if self.env.perturbed is not None:
            self.env.perturbed.open(0, episode.name)
            self.env.observer.set_appearance(0, self.env.perturbed.appearance(0))
        for state in episode.states:
            self._add(state)

    def act(self, before_step: Callable[[], None]) -> None:
        """Let the policy act in a new episode, whose frames take the place of those that are shown.

        Args:
            before_step: Function that is called in each frame before the policy acts; it may raise to end the episode.

        Raises:
            LiberoError: The policy cannot act in this task, or the simulation fails.
        """
        choice, protocol = self.choice, self.protocol
        assert choice is not None
        self._clear()
        env = self.policy.env(choice.task, 1, protocol)

        def look() -> None:
            self._add(env.get_state(0))
            before_step()

        try:
            with self.policy.actor(env.task, [choice.start], protocol) as actor:
                if isinstance(actor, WatchesWorld):
                    actor.watch(env)
                run_episodes(
                    _WatchedActor(actor, look),
                    env,
                    [choice.start],
                    horizon=protocol.steps(choice.task),
                    settle_steps=protocol.settle_steps,
                    settle_action=protocol.episode.settle_action,
                )
            self._add(env.get_state(0))
        finally:
            env.close()

    def show(self, index: int) -> None:
        """Put the simulation into a frame; forces are those of the motors' commands where the frame has them."""
        assert self.env is not None
        self.env.set_state(0, self.frames[index])
        if self.env.perturbed is not None:
            self.env.perturbed.steps[0] = index
        simulations = self.env.simulations
        mujoco.mj_forward(simulations.model, simulations.data(0))

    def picture(self, camera: str) -> np.ndarray:
        """Return what arrives of a camera's picture in the frame that is shown, (H, W, 3) uint8.

        Pictures that perturbations delay or drop are not: each is that of its frame.
        """
        assert self.env is not None
        rows = self.env.observer.render(0, camera)[None]
        if self.env.perturbed is not None:
            self.env.perturbed.see_images([0], {image_name(camera, "rgb"): rows})
        return rows[0]

    def describe(self, index: int) -> str:
        """Return the instruction and the atoms of the goal in a frame, and since when they hold, as Markdown."""
        assert self.env is not None
        lines = [
            f"**{self.env.task.language}**",
            f"{index / self.env.config.control_freq:.2f} s, frame {index}:",
        ]
        for atom, holds in self.truths[index].items():
            since = index
            while since and self.truths[since - 1][atom] == holds:
                since -= 1
            word = f"● `{atom}` true" if holds else f"○ `{atom}` false"
            lines.append(f"{word}, since frame {since}" if since else word)
        lines.append("the goal is reached" if self.is_reached[index] else "the goal is not reached")
        return "\n\n".join(lines)

    def close(self) -> None:
        """Free the simulation."""
        if self.env is not None:
            self.env.close()
        self.env = None

    def _clear(self) -> None:
        self.frames, self.truths, self.is_reached = [], [], []

    def _add(self, state: np.ndarray) -> None:
        assert self.env is not None and self.choice is not None
        if self.frames and self.choice.source != POLICY:  # conditions over time remember the frames before
            self.env.simulations.set_physics_state(0, state)
        else:
            self.env.set_state(0, state)
        reached, truth = self.env.check_goal(0)
        self.frames.append(state)
        self.truths.append(truth)
        self.is_reached.append(reached)

    def _recording(self, name: str) -> Episode:
        assert self._file is not None
        return next(one for one in read_episodes(self._file, observations=False) if one.name == name)


class _WatchedActor:
    """An actor before whose every step a function is called."""

    action_dim: int
    views: tuple[str, ...]
    reset: Callable[[int], None]

    def __init__(self, actor: Actor, look: Callable[[], None]):
        self._actor, self._look = actor, look

    def __getattr__(self, name: str) -> Any:
        return getattr(self._actor, name)

    def act(self, obs: Obs) -> np.ndarray:
        self._look()
        return self._actor.act(obs)
