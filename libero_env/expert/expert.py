"""A scripted expert: sees the whole state, acts through the environment's seven numbers."""

from typing import Protocol

import numpy as np

from libero_env.expert.arm.reach import limit_elbow_extension
from libero_env.expert.arm.servo import OPEN
from libero_env.expert.planning.goal_plan import JOINT_STATES, Shapes, Step, plan_goal
from libero_env.expert.planning.pick_plan import is_graspable
from libero_env.expert.skills.drag import Drag
from libero_env.expert.skills.drop_into_container import DropIntoContainer
from libero_env.expert.skills.move_joint import MoveJoint
from libero_env.expert.skills.pick_place import PickPlace
from libero_env.expert.variation import MotionStyle
from libero_env.sim.state import StateView
from libero_env.tasks import Task


class Skill(Protocol):
    """Works until an atom of the goal holds."""

    phase: str
    retries: int
    failure_reason: str

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]."""

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1]."""

    def done(self, view: StateView) -> bool:
        """Whether the atom holds and the hand is free for what comes next."""


class Expert:
    """Reaches the goal of a task in one simulation, one skill after the other.

    It plans anew whenever a skill is done, so that what slipped or was pushed is put right.

    Args:
        task: what to do.
        rng: draws the manner; the same generator state gives the same behaviour.
        shapes: of the task's scene, to share between experts of the same task; made from the first view otherwise.
        style: the manner, instead of drawing it.

    Attributes:
        skill: what it is at; None before the first action and where nothing is left to do.
    """

    def __init__(
        self,
        task: Task,
        rng: np.random.Generator,
        *,
        shapes: Shapes | None = None,
        style: MotionStyle | None = None,
    ):
        self.task, self.shapes = task, shapes
        self.style = MotionStyle.sample(rng) if style is None else style
        self.skill: Skill | None = None
        self._retries = 0  # of skills that are over

    @property
    def phase(self) -> str:
        """What it is doing."""
        return "rest" if self.skill is None else self.skill.phase

    @property
    def noise_scale(self) -> float:
        """How much disturbance the moment bears, in [0, 1]: none while the fingers move."""
        return 0.0 if self.skill is None else self.skill.noise_scale

    @property
    def retries(self) -> int:
        """How often it had to begin something again."""
        return self._retries + (0 if self.skill is None else self.skill.retries)

    @property
    def failure_reason(self) -> str:
        """Why it cannot go on, or ""."""
        return (
            ""
            if self.skill is None or isinstance(self.skill, DropIntoContainer)
            else self.skill.failure_reason
        )

    def act(self, view: StateView) -> np.ndarray:
        """The next action, (7,) in [-1, 1].

        Raises:
            UnsupportedGoalError: the task's goal needs a skill that there is not.
        """
        if self.shapes is None:
            self.shapes = Shapes(view.scene)
        if self.skill is None or self.skill.done(view):
            self._retries = self.retries
            steps = plan_goal(self.task.problem.goal, view)
            self.skill = self._skill_for(steps[0], view) if steps else None
        if self.skill is None:
            return np.array([0.0] * 6 + [OPEN])
        if isinstance(self.skill, DropIntoContainer) and self.skill.failure_reason:
            self._retries = self.retries + 1
            self.skill = PickPlace(self.skill.atom, style=self.style, shapes=self.shapes)
        return limit_elbow_extension(view, self.skill.act(view))

    def _skill_for(self, step: Step, view: StateView) -> Skill:
        state = JOINT_STATES.get(step.atom.predicate)
        if state is not None:
            return MoveJoint(step.atom.args[0], state, style=self.style)
        container = DropIntoContainer.container_of(view, self.shapes, step.atom)
        if container is not None:
            return DropIntoContainer(step.atom, container, style=self.style, shapes=self.shapes)
        if Drag.suits(view, self.shapes, step.atom) and not is_graspable(
            view, self.shapes, step.atom.args[0]
        ):
            return Drag(step.atom, style=self.style, shapes=self.shapes)
        return PickPlace(step.atom, style=self.style, shapes=self.shapes, share=step.share)
