from .expert import Expert
from .planning.goal_plan import UnsupportedGoalError, plan_goal
from .shapes import Shapes
from .variation import ActionNoise, MotionStyle

__all__ = [
    "ActionNoise",
    "Expert",
    "Shapes",
    "MotionStyle",
    "UnsupportedGoalError",
    "plan_goal",
]
