"""A result that is run again: what it was of, what may be changed, and whether it would be the same evaluation."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from libero_env.sim.backend import Backend
from libero_env.storage import own_folder
from libero_env.tasks.task import FILE
from libero_env.text import json_safe
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.requests import EvalRequest
from lifelong.errors import ConfigError, ResultsError

# What a result states, so that it is run again with this
_STATED = (
    *("after", "starts", "episodes", "protocol", "perturb", "perturb_seed", "event", "clock", "horizon"),
    *("control_freq", "size", "names", "name", "seed", "robot", "unit_starts", "until"),
)
_OF_POLICY = ("after", "names", "name", "seed")  # of these, what a policy is identified by


def is_result(text: str) -> bool:
    """Return whether a word of the command line is a result: `eval.json`, or a folder that has one and is not a run."""
    path = Path(text)
    if path.is_dir():
        return (path / FILE_NAME).is_file() and not (path / "config.yaml").is_file()
    return path.suffix == ".json" and path.is_file()


def repeated(request: EvalRequest, result: EvaluationResult) -> EvalRequest:
    """Return the request that repeats a result.

    Args:
        request: Request with the result's file as the policy; processes, folder and device are taken from it.

    Raises:
        ResultsError: The result does not say which policy it is of.
        ConfigError: It is of a policy in a module or on a server that the user has not allowed, or of another backend,
            or what it states of its policy is not valid.
    """
    path = Path(request.policy_name)
    policy = result.policy
    if policy is None:
        raise ResultsError(f"{path} does not say which policy it is of: {dict(result.evaluated)}")
    _check_allowed(policy, request)
    if request.backend is not None and (asked := Backend.read(request.backend).name) != result.backend:
        raise ConfigError(
            f"--backend {asked}: the result is of backend={result.backend}, which it is repeated with"
        )
    if given := request.given(_STATED):
        raise ConfigError(f"{', '.join(given)}: the result is run again as it was; leave this out")
    own = [task.name for task in result.tasks if task.suite == FILE]
    if own and not request.suite:
        raise ConfigError(f"the result is of a task file, {own[0]}; name the file with --suite")
    if request.suite and not own:
        raise ConfigError("--suite: the result is run again on its own tasks; leave this out")
    threads = result.environment.get("policy_threads") if result.evaluated.get("run") else None
    if not (isinstance(threads, int) and 1 <= threads <= 1024):
        threads = None
    return replace(
        request,
        **{name: result.evaluated[name] for name in _OF_POLICY if name in result.evaluated},
        policy=policy,
        suite=request.suite or tuple(task.task for task in result.tasks),
        unit_starts=result.unit_starts or len(result.init_states),
        policy_threads=request.policy_threads or threads,
        out=request.out or own_folder(path if path.is_dir() else path.parent, "again", error=ConfigError),
    )


def _check_allowed(policy: str, request: EvalRequest) -> None:
    """Refuse code and servers that a result, which may be somebody else's, names: unless the user has allowed them."""
    names = permission_names(policy)
    what = "which would be connected to" if "://" in policy else "whose code would be run"
    if names and not set(names) & set(request.allow):
        raise ConfigError(
            f"{request.policy} is of the policy {policy}, {what}; if you know and trust it, "
            f"allow it with --allow {names[0]}"
        )


def check_same(
    result: EvaluationResult, identity: Mapping[str, Any], now: Mapping[str, Any], despite: Sequence[str]
) -> None:
    """Check that an evaluation is the one of a result.

    Args:
        identity: What identifies the policy now.
        now: Versions, and digests of the protocol and of each task; those that the result does not have are not
            compared.
        despite: Names of differences that the user accepts.

    Raises:
        ConfigError: Something differs; the message names both values of each.
    """
    then, identity = {**result.versions, "protocol": result.protocol.get("digest")}, json_safe(identity)
    then |= {f"task {task.task}": task.digest for task in result.tasks if task.digest}
    both = {
        name: (result.evaluated.get(name), identity.get(name)) for name in {**result.evaluated, **identity}
    }
    both |= {name: (value, now[name]) for name, value in then.items() if name in now}
    wrong = [
        f"{name}: {old} in the result, {new} here"
        for name, (old, new) in both.items()
        if old != new and name not in despite
    ]
    if wrong:
        names = " ".join(text.partition(":")[0] for text in wrong)
        raise ConfigError(
            f"the result cannot be repeated as it was; {'; '.join(wrong)}. To run it all the same: --despite {names}"
        )


def permission_names(policy: str) -> list[str]:
    """Return the names by which a user allows that a result's policy is run again; none where that needs no permission.

    Code of a module would be run. A server would be sent pictures, and the key that is in the environment.
    """
    if "://" in policy:
        host = policy.partition("://")[2].partition("/")[0]
        return [policy, host, host.rpartition(":")[0]]
    if ":" in policy and not Path(policy).exists():
        module = policy.partition(":")[0]
        return [module.partition(".")[0], module]
    return []


def again(result: EvaluationResult, path: str) -> str:
    """Return the command that runs a result again, from its file."""
    names = permission_names(result.policy or "")
    return shlex.join(["libero", "eval", path, *(["--allow", names[0]] if names else [])])
