"""A result is run again from its file alone: the same policy, protocol, tasks, initial states and seed."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from libero_env.sim.backend import MUJOCO, Backend
from libero_env.validation import validate
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.protocols.files import parse_card
from libero_eval.protocols.protocol import Card
from lifelong.errors import ConfigError, ResultsError

POLICIES = ("run", "policy", "server")  # keys of `evaluated` that name a policy, one for each kind


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


def repeated(args: argparse.Namespace, result: EvaluationResult) -> argparse.Namespace:
    """Return the arguments of `libero eval` that repeat a result.

    Args:
        args: Arguments with the result's file as the policy; processes, folder and device are taken from them.
        result: The result.

    Raises:
        ResultsError: The result does not say which policy it is of.
        ConfigError: It is of a policy in a module that the user has not allowed.
    """
    evaluated = result.evaluated
    known = {key: value for key, value in evaluated.items() if key in _Evaluated.__annotations__}
    validate(_Evaluated, known, source=str(args.policy), prefix=("evaluated",), error=ResultsError)
    kind = next((name for name in POLICIES if evaluated.get(name)), None)
    if kind is None:
        raise ResultsError(f"{args.policy} does not say which policy it is of: {dict(evaluated)}")
    _check_code(str(evaluated[kind]), args)
    path = Path(args.policy)
    folder = path if path.is_dir() else path.parent
    changes = {
        "policy": str(evaluated[kind]),
        "after": evaluated.get("after"),
        "names": evaluated.get("names"),
        "seed": int(evaluated.get("seed", 0)),
        "suite": [task.task for task in result.tasks],
        "unit_starts": result.unit_starts,
        "policy_threads": args.policy_threads or _threads(result),
        "horizon": None,
        "robot": None,
        "backend": _same_back_end(args, result),
        "perturb": None,
        "size": None,
        "out": args.out or folder / "again",
    }
    return argparse.Namespace(**(vars(args) | changes))


def _same_back_end(args: argparse.Namespace, result: EvaluationResult) -> str | None:
    """Return the back end that a result is repeated with: its own, with the settings that the arguments have.

    Raises:
        ConfigError: The arguments name another one.
    """
    world = result.protocol.get("world")
    own = str(world.get("backend", MUJOCO)) if isinstance(world, dict) else MUJOCO
    if args.backend is not None and (given := Backend.read(args.backend).name) != own:
        raise ConfigError(f"--backend {given}: the result is of backend={own}, which it is repeated with")
    return args.backend


def _check_code(policy: str, args: argparse.Namespace) -> None:
    """Refuse to run code that a result, which may be somebody else's, names: unless the user has allowed it."""
    module, colon, _ = policy.partition(":")
    package = module.partition(".")[0]
    runs_code = bool(colon) and "://" not in policy and not Path(policy).exists()
    if runs_code and not {module, package} & set(args.allow):
        raise ConfigError(
            f"{args.policy} is of the policy {policy}, whose code would be run; if you know and trust it, "
            f"allow it with --allow {package}"
        )


def repeated_card(result: EvaluationResult, where: str) -> Card:
    """Return the protocol of a result.

    Raises:
        ProtocolError: The result was edited.
    """
    return parse_card(result.protocol, str(result.protocol.get("name", "result")), where)


def check_same(
    result: EvaluationResult,
    *,
    evaluated: Mapping[str, Any],
    protocol: Card,
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
    found = result.environment.get("policy_threads") if result.evaluated.get("run") else None
    return found if isinstance(found, int) and 1 <= found <= 1024 else None
