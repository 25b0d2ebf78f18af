"""What the words of an evaluation name, checked before what they ask for is imported, which takes seconds."""

import os
import re
import sys
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path

from libero_env.perturbations import get_kind, parse_perturbations
from libero_env.tasks import find_tasks
from libero_env.timing import CONTROL_HZ
from libero_eval.protocols.clock import Clock
from libero_eval.protocols.files import load_protocol
from libero_eval.repeating import is_result
from libero_eval.requests import CLOCK, EvalRequest, Request
from lifelong.errors import ConfigError, LifelongError, require_run

EXPERT, AVOIDING = "expert", "expert-avoid"
WRITE = "write module:function, such as my_policy:make"


def check_words(request: Request) -> None:
    """Raise the `LiberoError` of a word that names nothing: a policy, task, protocol, kind of perturbation or clock."""
    name = request.policy_name
    if is_result(name):
        return
    if (kind := policy_kind(name)) == "run":
        require_run(Path(name))
    elif kind == "module":
        require_module(name)
    find_tasks(request.suite)
    load_protocol(request.protocol)
    if isinstance(request, EvalRequest):
        check_options(request)
        parse_perturbations(request.perturb or "")
        parse_perturbations(",".join(request.event), events=True)
    for kind in getattr(request, "kinds", None) or ():
        if kind != CLOCK.rstrip("="):
            get_kind(kind.partition("@")[0])
    Clock.read(request.clock or "")


def require_module(text: str) -> str:
    """Return the module of `module:function`.

    Raises:
        LifelongError: The text is of another form, or the module is neither in the current folder nor installed.
    """
    module, _, function = text.partition(":")
    first, *rest = module.split(".")
    if module.endswith(".py"):
        raise LifelongError(
            f"{text}: a module is named without .py: write {Path(module).stem}:{function}, in the folder of the file"
        )
    if not all(part.isidentifier() for part in (first, *rest)):
        raise LifelongError(f"{text}: {module!r} is not a name of a module; {WRITE}")
    if first not in sys.modules and not (PathFinder.find_spec(first, [os.getcwd()]) or find_spec(first)):
        raise no_module(first, text)
    return module


def no_module(name: str, text: str) -> LifelongError:
    """Return the error for a module that does not exist.

    Args:
        text: What names it.
    """
    return LifelongError(
        f"{text}: there is no module {name}, neither in the current folder ({Path.cwd()}) nor installed; "
        f"type the command in the folder of {name}.py"
    )


def policy_kind(policy: str) -> str:
    """Return what a word of the command line names: a `run`, a `module`, a `server` or the `expert`."""
    if "://" in policy:
        return "server"
    if Path(policy).exists():
        return "run"
    if re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):\d+(/.*)?", policy):
        raise ConfigError(
            f"{policy} is an address without the kind of its server: write ws://{policy} (openpi), "
            f"vla-eval://{policy} or gr00t://{policy}"
        )
    return "expert" if policy in (EXPERT, AVOIDING) else "module" if ":" in policy else "run"


def check_options(request: EvalRequest, again: bool = False) -> None:
    """Check that no option is given that means nothing for this kind of policy.

    Args:
        again: Whether the request is of a result that is run again.

    Raises:
        ConfigError: One is; the message says what it is of.
    """
    kind = policy_kind(request.policy_name)
    for name, kinds in _OF.items():
        if kind not in kinds and (given := request.given([name])):
            of = " and ".join(_KINDS[one] for one in kinds)
            raise ConfigError(f"{given[0]} is of {of}, and {request.policy} is {_KINDS[kind]}")
    if request.allow and kind != "run" and not again:
        raise ConfigError("--allow is of runs, and of results that are run again")
    if request.perturb_seed and request.perturb is None and not request.event and not again:
        raise ConfigError("--perturb-seed draws what --perturb and --event ask for, and neither is given")
    if request.control_freq not in (None, CONTROL_HZ) and kind == "expert":
        raise ConfigError(f"--control-freq {request.control_freq}: the expert acts at {CONTROL_HZ} Hz only")
    if request.despite and not again:
        raise ConfigError(f"--despite is of results that are run again, and {request.policy} is none")


_KINDS = {
    "run": "a run",
    "module": "a policy of your own",
    "server": "a policy server",
    "expert": "the expert",
}
_OF: dict[str, tuple[str, ...]] = {  # option -> the kinds that obey it
    **dict.fromkeys(("after", "device"), ("run",)),
    **dict.fromkeys(("names", "size"), ("module",)),
    **dict.fromkeys(("timeout", "in_flight"), ("server",)),
    "policy_threads": ("run", "module"),
}
