from .demos.generate import ensure_demos
from .demos.read import read_demos
from .envs.batch import BatchEnv
from .envs.env import LiberoEnv
from .errors import LiberoError, UnknownNameError
from .expert.expert import Expert
from .objects.catalog import register_object
from .sim.predicates import register_predicate
from .tasks.builder import make_task
from .tasks.cameras import Camera
from .tasks.suites import get_suite, get_task, read_task
from .tasks.task import Suite, Task

__all__ = [
    "BatchEnv",
    "Camera",
    "Expert",
    "LiberoEnv",
    "LiberoError",
    "Suite",
    "Task",
    "UnknownNameError",
    "ensure_demos",
    "get_suite",
    "get_task",
    "make_task",
    "read_demos",
    "read_task",
    "register_object",
    "register_predicate",
]

__distribution__: str
__version__: str
