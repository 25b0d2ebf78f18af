"""A result is run again from its file alone: the same policy, protocol, tasks, initial states and seed."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from libero_env.sim.backend import MUJOCO, Backend
from libero_env.validation import validate
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import EvalRequest
from lifelong.errors import ConfigError, ResultsError


class _Evaluated(TypedDict, total=False):
    """What of `evaluated` an evaluation is repeated by."""

    run: Annotated[str, Field(min_length=1)]
    policy: Annotated[str, Field(min_length=1)]
    server: Annotated[str, Field(min_length=1)]
    after: Annotated[int, Field(ge=0)] | None
    names: Literal["native", "original", "protocol"] | None
    seed: Annotated[int, Field(ge=0)]


def is_result(text: str) -> bool:
    """Return whether a word of the command line is a result: `eval.json`, or a folder that has one and is no run."""
    path = Path(text)
    if path.is_dir():
        return (path / FILE_NAME).is_file() and not (path / "config.yaml").is_file()
    return path.suffix == ".json" and path.is_file()


def repeated(request: EvalRequest, result: EvaluationResult) -> EvalRequest:
    """Return the request that repeats a result.

    Args:
        request: Request with the result's file as the policy; processes, folder and device are taken from it.
        result: The result.

    Raises:
        ResultsError: The result does not say which policy it is of.
        ConfigError: It is of a policy in a module that the user has not allowed, or of another backend.
    """
    path = Path(request.policy_name)
    stated = {key: value for key, value in result.evaluated.items() if key in _Evaluated.__annotations__}
    evaluated = validate(_Evaluated, stated, source=str(path), prefix=("evaluated",), error=ResultsError)
    policy = next((evaluated[key] for key in ("run", "policy", "server") if key in evaluated), None)
    if policy is None:
        raise ResultsError(f"{path} does not say which policy it is of: {dict(result.evaluated)}")
    _check_code(policy, request)
    _check_backend(request, result)
    return replace(
        request,
        policy=policy,
        after=evaluated.get("after"),
        names=evaluated.get("names"),
        seed=evaluated.get("seed", 0),
        suite=tuple(task.task for task in result.tasks),
        unit_starts=result.unit_starts or len(result.init_states),
        policy_threads=request.policy_threads or _threads(result),
        horizon=None,
        robot=None,
        perturb=None,
        size=None,
        out=request.out or (path if path.is_dir() else path.parent) / "again",
    )


def _check_backend(request: EvalRequest, result: EvaluationResult) -> None:
    world = result.protocol.get("world")
    backend = str(world.get("backend", MUJOCO)) if isinstance(world, dict) else MUJOCO
    if request.backend is not None and (asked := Backend.read(request.backend).name) != backend:
        raise ConfigError(f"--backend {asked}: the result is of backend={backend}, which it is repeated with")


def _check_code(policy: str, request: EvalRequest) -> None:
    """Refuse to run code that a result, which may be somebody else's, names: unless the user has allowed it."""
    module, colon, _ = policy.partition(":")
    package = module.partition(".")[0]
    runs_code = bool(colon) and "://" not in policy and not Path(policy).exists()
    if runs_code and not {module, package} & set(request.allow):
        raise ConfigError(
            f"{request.policy} is of the policy {policy}, whose code would be run; if you know and trust it, "
            f"allow it with --allow {package}"
        )


def check_same(
    result: EvaluationResult,
    *,
    evaluated: Mapping[str, Any],
    protocol: EvalProtocol,
    versions: Mapping[str, str],
    despite: Sequence[str],
) -> None:
    """Check that an evaluation is the one of a result.

    Args:
        result: The result.
        evaluated: What identifies the policy now.
        protocol: Protocol now.
        versions: Versions now.
        despite: Names of differences that the user accepts.

    Raises:
        ConfigError: Something differs; the message names both values of each.
    """
    then = {**result.evaluated, **result.versions, "protocol": result.protocol.get("digest")}
    now = {**evaluated, **versions, "protocol": protocol.digest}
    wrong = [
        f"{name}: {then[name]} in the result, {now[name]} here"
        for name in then
        if name in now and then[name] != now[name] and name not in despite
    ]
    if wrong:
        names = " ".join(text.partition(":")[0] for text in wrong)
        raise ConfigError(
            f"the result cannot be repeated as it was; {'; '.join(wrong)}. To run it all the same: --despite {names}"
        )


def _threads(result: EvaluationResult) -> int | None:
    threads = result.environment.get("policy_threads") if result.evaluated.get("run") else None
    return threads if isinstance(threads, int) and 1 <= threads <= 1024 else None
