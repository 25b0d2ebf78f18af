from .kinds import LAYERS, ActionFilter, Episode, Kind, ObservationFilter, StartChange, sample_key
from .perturbation import (
    KINDS,
    Perturbation,
    format_perturbations,
    get_kind,
    parse_perturbations,
    perturb_task,
    replace_perturbations,
    reword_task,
)
from .starts import RobotJoints

__all__ = [
    "KINDS",
    "LAYERS",
    "ActionFilter",
    "Episode",
    "Kind",
    "ObservationFilter",
    "Perturbation",
    "RobotJoints",
    "StartChange",
    "format_perturbations",
    "get_kind",
    "parse_perturbations",
    "perturb_task",
    "replace_perturbations",
    "reword_task",
    "sample_key",
]
