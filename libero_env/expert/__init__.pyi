from .expert import Expert
from .planning.goal_plan import UnsupportedGoalError, plan_goal
from .shapes import Shapes
from .variation import Disturbance, Style

__all__ = [
    "Disturbance",
    "Expert",
    "Shapes",
    "Style",
    "UnsupportedGoalError",
    "plan_goal",
]
