"""The classes of vla-eval that ours derive from; where it is not installed, ours can be imported but not made."""

from typing import Any

from libero_env.errors import MissingPackageError

VERSION = "0.8.0"  # that the tests run

try:
    from vla_eval.benchmarks.base import StepBenchmark, StepResult
    from vla_eval.model_servers.predict import PredictModelServer

    INSTALLED = True
except ImportError:
    INSTALLED = False
    StepBenchmark: Any = object  # type: ignore[no-redef]
    StepResult: Any = object  # type: ignore[no-redef]
    PredictModelServer: Any = object  # type: ignore[no-redef]

__all__ = ["PredictModelServer", "StepBenchmark", "StepResult", "require"]


def require() -> None:
    """Check that vla-eval is installed.

    Raises:
        MissingPackageError: It is not.
    """
    if not INSTALLED:
        raise MissingPackageError(
            "this class is one of vla-eval's, which is not installed", f"pip install vla-eval=={VERSION}"
        )
