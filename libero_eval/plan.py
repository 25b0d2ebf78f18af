"""From a request to a result: what is to be run, the processes that run it, and a result that is run again."""

import io
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, suppress
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field
from typing_extensions import TypedDict

from libero_env.cli import ending
from libero_env.init_states.store import NUM_INIT_STATES
from libero_env.memory import require_memory
from libero_env.perturbations import format_perturbations, parse_perturbations
from libero_env.sim.backend import Backend
from libero_env.tasks import Task
from libero_env.tasks.published import require_available
from libero_env.tasks.task import FILE
from libero_env.text import json_safe
from libero_env.timing import CONTROL_HZ
from libero_env.validation import validate
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult, TaskResult, permission_names
from libero_eval.policies import AVOIDING, EXPERT, SELECTION, ExpertPolicy, PolicyUnderTest, RunPolicy
from libero_eval.protocols.clock import Clock
from libero_eval.protocols.environment import resolve_world
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.requests import EvalRequest, Request
from libero_eval.work.evaluation import Evaluation, iso_time
from libero_eval.work.progress import Progress
from libero_eval.work.stopping import StoppingRule
from libero_eval.work.worker import Worker, Workers
from lifelong.errors import ConfigError, ResultsError
from lifelong.results.provenance import installed_versions, source_digest


def evaluate(
    request: EvalRequest,
    evaluation: Evaluation | None = None,
    *,
    on_task: Callable[[TaskResult], None] = lambda _: None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> EvaluationResult:
    """Evaluate a policy; what is done already in the folder is not run again.

    Args:
        request: Policy, tasks and episodes.
        evaluation: The evaluation that is asked for, where it is planned already, see `plan_evaluation`.
        on_task: Function called with the result of each task as soon as it is known.
        on_progress: Function called with the progress of all processes every half minute, and at the end.

    Returns:
        The result, which is also written to `eval.json` in the folder.

    Raises:
        LiberoError: The policy, a task, the protocol or the set of initial states does not exist, or the folder holds
            another evaluation.
        EvaluationIncompleteError: Episodes ended with errors; the others are kept.
    """
    evaluation = evaluation or plan_evaluation(request)
    store, units = evaluation.store, evaluation.units
    count = min(request.workers, len(units))
    remedy = "fewer --workers, --unit-starts or --videos, or a smaller --size"
    require_memory(evaluation.memory(count), f"an evaluation by {count} processes", remedy)
    if request.again:
        store.clear()
    store.join(units)
    done = store.done(units)
    here = str(evaluation.versions.get("source"))
    if others := sorted({str(one.versions.get("source")) for one in done.values()} - {here}):
        print(
            f"note: {store.path}: units that are done are of another source of this package ({', '.join(others)}; "
            f"here {here}), as the result will say; --again repeats them",
            file=sys.stderr,
        )
    if any(unit.name in done and not evaluation.is_filmed(unit) for unit in units):
        print(
            f"note: {store.path}: some of the episodes to be filmed are done, and are not filmed; --again repeats them",
            file=sys.stderr,
        )
    if evaluation.starts_needed(done):
        count, when = 1, iso_time(max(one.finished for one in done.values()))
        print(f"note: {store.path}: finished {when}, nothing was run; --again repeats it", file=sys.stderr)
    try:
        with policy_threads(evaluation), Workers(count - 1, _help, replace(request, again=False)) as workers:
            worker = Worker(evaluation, on_result=on_task, on_progress=on_progress, on_wait=workers.supervise)
            result = worker.run()
    except KeyboardInterrupt as error:
        error.add_note(f"{evaluation.out} keeps what is done; the same command goes on")
        raise
    assert result is not None, "others were waited for"
    return result


@contextmanager
def further_process() -> Iterator[None]:
    """Let an error of the block, all that a further process does, end the process with one line."""
    with suppress(KeyboardInterrupt), ending.interruptible():
        try:
            yield
        except Exception as error:  # noqa: BLE001 - told by kind
            sys.exit(ending.report(error, who="a worker ended: "))


@further_process()
def _help(request: EvalRequest) -> None:
    """Work on the evaluation of another process, which prints it; errors go to the standard error."""
    with redirect_stderr(io.StringIO()):  # the other process says the same
        evaluation = plan_evaluation(request)
    with policy_threads(evaluation):
        Worker(evaluation).run()


@contextmanager
def policy_threads(evaluation: Evaluation) -> Iterator[None]:
    """Give PyTorch the number of threads that the evaluation names; their number changes the bits of a policy."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(evaluation.policy_threads or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def plan_evaluation(request: EvalRequest, policy: PolicyUnderTest | None = None) -> Evaluation:
    """Return the evaluation that is asked for.

    Args:
        request: Policy, tasks and episodes.
        policy: The policy that it names, where it is loaded already.

    Raises:
        LiberoError: The policy, a task, the protocol or the set of initial states does not exist.
    """
    from libero_env.tasks import find_tasks

    earlier = EvaluationResult.read(request.policy_name) if is_result(request.policy_name) else None
    if earlier is None:
        base = load_protocol(request.protocol)
    else:
        base = EvalProtocol.read(earlier.protocol, request.policy_name)
        request = repeated(request, earlier)
    _check_options(request, earlier)
    policy = policy or load_policy(request)
    tasks = find_tasks(request.suite) if request.suite else policy.tasks
    if not tasks:
        raise ConfigError("no tasks are given; name a suite, such as --suite libero_object")
    require_available(tasks)
    protocol = resolve_protocol(request, policy.protocol(base), tasks)
    if policy.relative and not protocol.world.delta:
        raise ConfigError(
            f"{request.policy_name} moves relative to the present pose; protocol {protocol.name} has absolute actions "
            "(world.delta: false)"
        )
    Clock.read(protocol.action.clock).check(policy.chunk, policy.inpaints)
    events = parse_perturbations(protocol.world.perturb, events=True)
    if not policy.hears and (told := [str(one) for one in events if one.name.startswith("goal@")]):
        raise ConfigError(
            f"{told[0]}: {request.policy_name} cannot be told another instruction during an episode; "
            "runs and the expert can"
        )
    identity = {**policy.identity, "seed": request.seed}
    versions = {**installed_versions(request.assets), "source": source_digest()}
    if earlier is None:
        init_states = choose_init_states(
            request.starts, _episodes(request, tasks, protocol), policy.selection
        )
    else:
        init_states = earlier.init_states
        tasks_here = {f"task {task.id}": task.digest for task in tasks}
        check_same(
            earlier, identity, {**versions, **tasks_here, "protocol": protocol.digest}, request.despite
        )
    tasks = tuple(dict.fromkeys(tasks))
    ids = [task.id for task in tasks]
    if twice := [task.name for task in tasks if ids.count(task.id) > 1]:
        raise ConfigError(
            f"{' and '.join(twice)}: task files are evaluated one by one; name one with --suite"
        )
    until = StoppingRule.read(request.until, protocol, tasks, init_states) if request.until else None
    return Evaluation(
        identity=identity,
        tasks=tasks,
        until=until,
        stopped=earlier.stopped if earlier else None,
        init_states=init_states,
        protocol=protocol,
        out=request.out or policy.out,
        env=lambda task, count: policy.env(task, count, protocol),
        actor=lambda task, states: policy.actor(task, states, protocol),
        unit_starts=request.unit_starts,
        retries=request.retries,
        errors_are_failures=protocol.episode.errors == "failure",
        videos=request.videos,
        progress=sys.stderr.isatty() and request.workers == 1,
        versions=versions,
        probe=policy.probe(protocol),
        policy_threads=request.policy_threads or (1 if policy.on_cpu else None),
    )


def load_policy(request: Request) -> PolicyUnderTest:
    """Return the policy that is asked for: the expert, a server's, a user's own, or a run's."""
    policy: PolicyUnderTest
    match _kind(request.policy_name):
        case "server":
            from libero_eval.servers.policy import ServerPolicy

            policy = ServerPolicy(request)
        case "module":
            from libero_eval.user_policy import UserPolicy

            policy = UserPolicy(request)
        case "expert":
            policy = ExpertPolicy(request)
        case _:
            policy = RunPolicy(request)
    if request.name:
        policy.identity = {**policy.identity, "name": request.name}
        word = re.sub(r"[^\w.-]+", "_", request.name)
        policy.out = policy.out.with_name(f"{policy.out.name}_{word}")
    return policy


def _kind(policy: str) -> str:
    if "://" in policy:
        return "server"
    if Path(policy).exists():
        return "run"
    if re.fullmatch(r"(\[[0-9a-fA-F:]+\]|[\w.-]+):\d+(/.*)?", policy):
        raise ConfigError(
            f"{policy} is an address without the kind of its server: write ws://{policy} (openpi, libero serve), "
            f"vla-eval://{policy} or gr00t://{policy}"
        )
    return "expert" if policy in (EXPERT, AVOIDING) else "module" if ":" in policy else "run"


def choose_init_states(
    which: str, count: int | None, selection: Sequence[int] = SELECTION
) -> tuple[int, ...]:
    """Return the indices of the initial states to evaluate.

    Args:
        which: `all`; `selection`: those by which a checkpoint may have been chosen; `reporting`: the others.
        count: Number of them, from the first on; None: all of them.
        selection: Initial states for selection.

    Raises:
        ConfigError: There are fewer than `count`.
    """
    sets: dict[str, Sequence[int]] = {
        "all": range(NUM_INIT_STATES),
        "selection": selection,
        "reporting": [i for i in range(NUM_INIT_STATES) if i not in selection],
    }
    chosen = tuple(sets[which])
    count = len(chosen) if count is None else count
    if not 1 <= count <= len(chosen):
        raise ConfigError(f"{count} episodes of a task; {which} has 1 to {len(chosen)} initial states")
    return chosen[:count]


def _episodes(request: EvalRequest, tasks: Sequence[Task], protocol: EvalProtocol) -> int | None:
    """Return the number of episodes of each task, by default the protocol's; None for all.

    LIBERO-Plus has one, from the first initial state.

    Raises:
        ConfigError: A task has fewer initial states, or a suite another number of tasks than the protocol counts.
    """
    suites = Counter(task.suite for task in tasks)
    if other := [name for name, n in suites.items() if n != (protocol.counting.tasks or n)]:
        raise ConfigError(
            f"protocol {protocol.name} counts {protocol.counting.tasks} tasks of a suite (counting.tasks); these are "
            f"{suites[other[0]]} of {other[0]}"
        )
    scarce = [task for task in tasks if task.num_starts == 1]
    from_plus = all(task.suite.startswith("libero_plus_") for task in tasks)
    trials = protocol.counting.trials if request.starts == "all" else None
    count = request.episodes or (1 if from_plus else trials)
    if scarce and (count != 1 or request.starts == "selection"):
        raise ConfigError(
            f"{scarce[0].id} has one initial state, number 0: --episodes 1, without --starts selection"
        )
    return count


def resolve_protocol(request: EvalRequest, base: EvalProtocol, tasks: Sequence[Task]) -> EvalProtocol:
    """Return the protocol on this machine, with what the request changes; what was chosen is printed."""
    protocol, notes = resolve_world(base, tasks, request.assets)
    asked = {
        "episode.horizon": request.horizon,
        "world.control_freq": request.control_freq,
        "world.robot": request.robot,
    }
    changes: dict[str, object] = {name: value for name, value in asked.items() if value}
    perturb = protocol.world.perturb
    if request.perturb is not None:
        perturb = format_perturbations(parse_perturbations(request.perturb, request.perturb_seed))
        changes["world.perturb"] = perturb
    if request.event:
        known = parse_perturbations(perturb, events=True)
        events = parse_perturbations(",".join(request.event), request.perturb_seed, events=True)
        if at_start := [str(one) for one in events if not one.trigger]:
            raise ConfigError(
                f"--event {at_start[0]}: expected KIND=SEVERITY@TRIGGER, such as camera=0.5@lifted"
            )
        changes["world.perturb"] = format_perturbations((*known, *events))
    if request.clock is not None:
        changes["action.clock"] = str(Clock.read(request.clock)) if request.clock else ""
    if request.backend is not None:
        changes["world.backend"] = Backend.read(request.backend).name
    protocol = protocol.changed(changes)
    Backend.read(request.backend or protocol.world.backend).require_installed()
    protocol.require()
    for note in notes:
        print(f"note: {note}", file=sys.stderr, flush=True)
    return protocol


def _check_options(request: EvalRequest, earlier: EvaluationResult | None) -> None:
    """Check that no option is given that means nothing for this kind of policy.

    Raises:
        ConfigError: One is; the message says what it is of.
    """
    kind = _kind(request.policy_name)
    for name, kinds in _OF.items():
        if kind not in kinds and (given := _given(request, [name])):
            of = " and ".join(_KINDS[one] for one in kinds)
            raise ConfigError(f"{given[0]} is of {of}, and {request.policy} is {_KINDS[kind]}")
    if request.allow and kind != "run" and earlier is None:
        raise ConfigError("--allow is of runs, and of results that are run again")
    if request.perturb_seed and request.perturb is None and not request.event and earlier is None:
        raise ConfigError("--perturb-seed draws what --perturb and --event ask for, and neither is given")
    if request.control_freq not in (None, CONTROL_HZ) and kind == "expert":
        raise ConfigError(f"--control-freq {request.control_freq}: the expert acts at {CONTROL_HZ} Hz only")
    if request.despite and earlier is None:
        raise ConfigError(f"--despite is of results that are run again, and {request.policy} is none")


def _given(request: EvalRequest, names: Iterable[str]) -> list[str]:
    """Return the options of these names that have other values than the defaults."""
    plain = EvalRequest()
    return [f"--{name.replace('_', '-')}" for name in names if getattr(request, name) != getattr(plain, name)]


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
# What a result states, so that it is run again with this
_STATED = (
    *("after", "starts", "episodes", "protocol", "perturb", "perturb_seed", "event", "clock", "horizon"),
    *("control_freq", "size", "names", "name", "seed", "robot", "unit_starts", "until"),
)


class _Evaluated(TypedDict, total=False):
    """What of `evaluated` an evaluation is repeated by."""

    run: Annotated[str, Field(min_length=1)]
    policy: Annotated[str, Field(min_length=1)]
    server: Annotated[str, Field(min_length=1)]
    name: Annotated[str, Field(min_length=1, max_length=100)]
    after: Annotated[int, Field(ge=0)] | None
    names: Literal["native", "original", "protocol"] | None
    seed: Annotated[int, Field(ge=0)]


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
        ConfigError: It is of a policy in a module or on a server that the user has not allowed, or of another backend.
    """
    path = Path(request.policy_name)
    stated = {key: value for key, value in result.evaluated.items() if key in _Evaluated.__annotations__}
    evaluated = validate(_Evaluated, stated, source=str(path), prefix=("evaluated",), error=ResultsError)
    policy = result.policy
    if policy is None:
        raise ResultsError(f"{path} does not say which policy it is of: {dict(result.evaluated)}")
    _check_allowed(policy, request)
    if request.backend is not None and (asked := Backend.read(request.backend).name) != result.backend:
        raise ConfigError(
            f"--backend {asked}: the result is of backend={result.backend}, which it is repeated with"
        )
    if given := _given(request, _STATED):
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
        policy=policy,
        after=evaluated.get("after"),
        names=evaluated.get("names"),
        name=evaluated.get("name"),
        seed=evaluated.get("seed", 0),
        suite=request.suite or tuple(task.task for task in result.tasks),
        unit_starts=result.unit_starts or len(result.init_states),
        policy_threads=request.policy_threads or threads,
        out=request.out or (path if path.is_dir() else path.parent) / "again",
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
