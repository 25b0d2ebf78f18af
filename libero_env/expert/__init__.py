"""The scripted expert that makes demonstrations: goal -> skills -> actions."""

from libero_env.expert.expert import Expert
from libero_env.expert.plan import Shapes, UnsupportedGoalError, plan_goal
from libero_env.expert.style import Disturbance, Style

__all__ = ["Disturbance", "Expert", "Shapes", "Style", "UnsupportedGoalError", "plan_goal"]
