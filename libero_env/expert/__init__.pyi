from .expert import Attempt, Expert, run_experts
from .planning.goal_plan import UnsupportedGoalError, plan_goal
from .shapes import Shapes
from .skills.skill import Skill
from .variation import ActionNoise, MotionStyle

__all__ = [
    "ActionNoise",
    "Attempt",
    "Expert",
    "MotionStyle",
    "Shapes",
    "Skill",
    "UnsupportedGoalError",
    "plan_goal",
    "run_experts",
]
