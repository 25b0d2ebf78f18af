from .catalog import KINDS, get_kind
from .channels import ActionChannel, ActionFilter, ObservationChannel, ObservationFilter
from .drawing import draw_key
from .kind import LAYERS, Kind
from .problem import perturb_task, reword_task
from .starts import RobotJoints, StartChange
from .value import Perturbation, format_perturbations, parse_perturbations, replace_perturbations

__all__ = [
    "KINDS",
    "LAYERS",
    "ActionChannel",
    "ActionFilter",
    "Kind",
    "ObservationChannel",
    "ObservationFilter",
    "Perturbation",
    "RobotJoints",
    "StartChange",
    "draw_key",
    "format_perturbations",
    "get_kind",
    "parse_perturbations",
    "perturb_task",
    "replace_perturbations",
    "reword_task",
]
