"""The scripted expert: it observes the whole state and acts as a policy does, with seven numbers."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from libero_env.envs.batch import BatchEnv
from libero_env.errors import InvalidInputError
from libero_env.expert.arm import OPEN, limit_elbow_extension
from libero_env.expert.guard import Guard
from libero_env.expert.planning.goal_plan import Step, UnsupportedGoalError, look, plan_goal
from libero_env.expert.planning.pick_planner import is_graspable
from libero_env.expert.shapes import Shapes
from libero_env.expert.skills.drag import Drag
from libero_env.expert.skills.drop_into_container import DropIntoContainer
from libero_env.expert.skills.move_joint import MoveJoint
from libero_env.expert.skills.pick_place import PickPlace
from libero_env.expert.skills.skill import Skill
from libero_env.expert.variation import ActionNoise, MotionStyle
from libero_env.objects.model import OPPOSITE_STATES
from libero_env.sim.history import History
from libero_env.sim.predicates import ground
from libero_env.sim.state import StateView
from libero_env.tasks import Task
from libero_env.timing import CONTROL_HZ, SUBSTEPS

MAX_STEPS = 600  # control steps of an attempt
LET_GO = 10  # control steps in which the hand opens before another plan


class Expert:
    """Scripted expert that reaches the goal of a task in one simulation, one skill after the other.

    It plans again whenever a skill is done, so that an object that slipped or was pushed is put right.

    Args:
        task: Task to solve.
        rng: Generator of the motion style; the same state gives the same behaviour.
        shapes: Shapes of the task's scene, to share between experts of the same task; computed at the first action
            if None.
        style: Motion style; sampled from `rng` if None.
        avoid: Whether it keeps clear of what the goal does not need, see `libero_env.sim.costs`: the hand of furniture
            and of other objects, and what it pushes of them, too. It then takes longer, and is not that of
            demonstrations.

    Attributes:
        skill: Skill that acts now; None before the first action and where nothing is left to do.

    Examples:
        >>> import numpy as np
        >>> from libero_env import Expert, LiberoEnv
        >>> env = LiberoEnv("libero_object/0", cameras=())
        >>> _ = env.reset(options={"init_state": 0})
        >>> expert = Expert(env.task, np.random.default_rng(0))
        >>> terminated = truncated = False
        >>> while not (terminated or truncated or expert.failure_reason):
        ...     _, _, terminated, truncated, info = env.step(expert.act(env.view))
        >>> terminated
        True
        >>> env.close()
    """

    def __init__(
        self,
        task: Task,
        rng: np.random.Generator,
        *,
        shapes: Shapes | None = None,
        style: MotionStyle | None = None,
        avoid: bool = False,
    ):
        self.task, self.shapes, self.avoid = task, shapes, avoid
        self._guard: Guard | None = None
        self.style = MotionStyle.sample(rng) if style is None else style
        self.skill: Skill | None = None
        self._finished_retries = 0  # of skills that are over
        self._letting_go = 0  # control steps that the hand still opens
        self._history: History | None = None  # of the goal, since the first action

    @property
    def phase(self) -> str:
        """Phase of the skill; `rest` without one."""
        return "rest" if self.skill is None else self.skill.phase

    @property
    def noise_scale(self) -> float:
        """Factor on the action noise that the phase tolerates, in [0, 1]."""
        return 0.0 if self.skill is None else self.skill.noise_scale

    @property
    def retries(self) -> int:
        """Number of times that a skill began again or was replaced."""
        return self._finished_retries + (0 if self.skill is None else self.skill.retries)

    @property
    def failure_reason(self) -> str:
        """Why the expert cannot continue, or ""."""
        return "" if self.skill is None or self.skill.fallback() else self.skill.failure_reason

    def replan(self, task: Task) -> None:
        """Plan again, for a task in the same scene; what is in the hand is let go before."""
        if task.problem.goal != self.task.problem.goal:
            self._history = None
        self.task, self.skill, self._letting_go, self._guard = task, None, LET_GO, None

    def act(self, view: StateView) -> np.ndarray:
        """Return the next action, (7,) in [-1, 1].

        Raises:
            UnsupportedGoalError: The goal needs a skill that does not exist.
            InvalidInputError: The simulation is not controlled at 20 Hz, for which its motions are made.
        """
        if (substeps := view.simulations.substeps) != SUBSTEPS:
            raise InvalidInputError(
                f"the expert acts at {CONTROL_HZ} Hz; this simulation has {substeps} physics steps per action, "
                f"expected {SUBSTEPS}: leave control_freq={CONTROL_HZ}"
            )
        if self.shapes is None:
            self.shapes = Shapes(view.scene)
        if self._history is None:
            self._history = History(ground(self.task.problem.goal, view.scene), 1)
        look(self._history, view)
        if self._letting_go:
            self._letting_go -= 1
            return np.array([0.0] * 6 + [OPEN])
        if self.skill is None or self.skill.done(view):
            self._finished_retries = self.retries
            steps = plan_goal(self.task.problem.goal, view, self._history)
            self.skill = self._skill_for(steps[0], view, self.shapes) if steps else None
        if self.skill is None:
            return np.array([0.0] * 6 + [OPEN])
        fallback = self.skill.fallback()
        if fallback is not None:
            self._finished_retries = self.retries + 1
            self.skill = fallback
        action = self.skill.act(view)
        if self.avoid:
            self._guard = self._guard or Guard(view, self.task.problem.goal)
            action = self._guard.steer(view, action, view.scene.owner(self.skill.atom.args[0]))
        return limit_elbow_extension(view, action)

    def _skill_for(self, step: Step, view: StateView, shapes: Shapes) -> Skill:
        atom, style = step.atom, self.style
        if atom.predicate.lower() in OPPOSITE_STATES:
            return MoveJoint(atom.args[0], atom.predicate.lower(), style=style)
        drop = DropIntoContainer.for_atom(view, atom, style=style, shapes=shapes)
        if drop is not None:
            return drop
        if Drag.applies(view, shapes, atom) and not is_graspable(view, shapes, atom.args[0]):
            return Drag(atom, style=style, shapes=shapes, avoid=self.avoid)
        return PickPlace(atom, style=style, shapes=shapes, slot=step.slot)


def solved_from_events(env: BatchEnv) -> np.ndarray:
    """Return whether the expert solves what is left of episodes just after events, in the time that is left.

    It plans anew there, for the goal that the episode has from then on. The environment is left somewhere else.

    Args:
        env: Environment whose episodes are over.

    Returns:
        (num_envs, events): 1 where it does, 0 where it does not, -1 where the event has not begun.
    """
    count = 0 if env.perturbed is None else len(env.perturbed.events)
    found, shapes = np.full((env.num_envs, count), -1), Shapes(env.scene)
    states = dict(env.perturbed.event_states) if count else {}
    env.render_images = False
    for event in range(count):
        ids = [i for i in range(env.num_envs) if (i, event) in states]
        for i in ids:
            env.set_state(i, states[i, event])
        tasks = [env.task_of(i) for i in range(env.num_envs)]
        experts = [Expert(task, np.random.default_rng(0), shapes=shapes) for task in tasks]
        for expert in experts:
            expert.replan(expert.task)
        attempts = run_experts(env, experts, max_steps=env.config.horizon)
        found[ids, event] = [attempts[i].success for i in ids]
    return found


@dataclass(frozen=True)
class Attempt:
    """What happened in one simulation.

    Attributes:
        success: Whether the goal was reached.
        states: [time, qpos, qvel] before each action and at the end, (T + 1, 1 + nq + nv).
        actions: Executed actions, (T, 7).
        expert_actions: Actions of the expert, without noise, (T, 7).
        retries: Number of times that the expert began again.
        reason: Why the attempt did not succeed, or "".
        fixtures: Poses of the fixtures, (nfixtures, 7): position, [m], and quaternion wxyz.
    """

    success: bool
    states: np.ndarray
    actions: np.ndarray
    expert_actions: np.ndarray
    retries: int
    reason: str
    fixtures: np.ndarray = field(default_factory=lambda: np.zeros((0, 7)))

    def __len__(self) -> int:
        return len(self.actions)


def run_experts(
    env: BatchEnv,
    experts: Sequence[Expert],
    noise: Sequence[ActionNoise | None] | None = None,
    *,
    max_steps: int = MAX_STEPS,
) -> list[Attempt]:
    """Let experts act in a batch of simulations.

    An attempt ends when the goal holds, when the expert gives up or has no skill for what is left, or after the largest
    number of steps. It depends on the start, the expert and the noise of its own simulation only.

    Args:
        env: Environment after `reset`; simulations beyond the number of experts stand still.
        experts: Experts of the first simulations, one each.
        noise: Noise on the executed actions of each expert, or None; no noise at all if None.
        max_steps: Largest number of steps of an attempt.

    Returns:
        One attempt for each expert, in order.
    """
    noise = noise or [None] * len(experts)
    states: list[list[np.ndarray]] = [[] for _ in experts]  # of each simulation, step by step
    executed: list[list[np.ndarray]] = [[] for _ in experts]
    chosen: list[list[np.ndarray]] = [[] for _ in experts]
    success, errors, unsupported = np.zeros(len(experts), bool), dict[int, str](), dict[int, str]()
    for _ in range(max_steps):
        running = map(int, np.flatnonzero(env.running[: len(experts)]))
        live = [i for i in running if not (experts[i].failure_reason or i in unsupported)]
        actions = np.zeros((env.num_envs, 7))
        for i in live:
            own_noise = noise[i]
            try:
                action = experts[i].act(env.views[i])
            except UnsupportedGoalError as error:  # of the state that this simulation is in
                unsupported[i] = str(error)
                continue
            actions[i] = action if own_noise is None else own_noise.apply(action, experts[i].noise_scale)
            states[i].append(env.simulations.physics_state(i))
            executed[i].append(actions[i].copy())
            chosen[i].append(action)
        if not (live := [i for i in live if i not in unsupported]):
            break
        infos = env.step(actions)[-1]
        success[live], errors = infos["success"][live], infos.get("errors", {})
    return [
        Attempt(
            success=bool(success[i]),
            states=np.array([*states[i], env.simulations.physics_state(i)]),
            actions=np.array(executed[i]),
            expert_actions=np.array(chosen[i]),
            retries=expert.retries,
            reason=""
            if success[i]
            else unsupported.get(i)
            or expert.failure_reason
            or errors.get(i)
            or f"in phase {expert.phase} after {len(executed[i])} steps, {expert.retries} retries",
            fixtures=env.simulations.fixtures[i].copy(),
        )
        for i, expert in enumerate(experts)
    ]
