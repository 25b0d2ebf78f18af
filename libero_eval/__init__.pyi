from .evaluation_file import EvaluationResult, TaskResult
from .judging.comparison import Comparison, compare_groups
from .plan import evaluate
from .protocols.files import load_protocol
from .protocols.protocol import EvalProtocol
from .requests import EvalRequest

__all__ = [
    "Comparison",
    "EvalProtocol",
    "EvalRequest",
    "EvaluationResult",
    "TaskResult",
    "compare_groups",
    "evaluate",
    "load_protocol",
]

__distribution__: str
__version__: str
