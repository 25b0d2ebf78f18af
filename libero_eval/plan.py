"""From a request to a result: what is to be run, the processes that run it, and a result that is run again."""

import hashlib
import re
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from libero_env.perturbations import Perturbation, format_perturbations, parse_perturbations
from libero_env.published import require_available
from libero_env.sim.backend import Backend
from libero_env.sim.render import renderer_name
from libero_env.tasks import Task
from libero_env.tasks.task import NUM_INIT_STATES
from libero_eval.evaluation_file import EvaluationResult, TaskResult
from libero_eval.policies import SELECTION, ExpertPolicy, PolicyUnderTest, RunPolicy
from libero_eval.protocols.clock import Clock
from libero_eval.protocols.environment import resolve_world
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.protocol import EvalProtocol
from libero_eval.repeating import check_same, is_result, repeated
from libero_eval.requests import EvalRequest, Request
from libero_eval.words import check_options, policy_kind
from libero_eval.work.evaluation import Evaluation
from libero_eval.work.progress import Progress
from libero_eval.work.scheduler import carry_out
from libero_eval.work.stopping import StoppingRule
from libero_eval.work.store import PLAN_NAME, read_plan
from lifelong.errors import ConfigError
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
    evaluations = {"": evaluation or plan_evaluation(request)}
    return carry_out(_plan, request, evaluations, on_task=on_task, on_progress=on_progress)[""]


def _plan(request: EvalRequest) -> dict[str, Evaluation]:
    return {"": plan_evaluation(request)}


def plan_evaluation(request: EvalRequest, policy: PolicyUnderTest | None = None) -> Evaluation:
    """Return the evaluation that is asked for.

    Args:
        request: Policy, tasks and episodes.
        policy: The policy that it names, where it is loaded already.

    Raises:
        LiberoError: The policy, a task, the protocol or the set of initial states does not exist, or nothing can be
            drawn here.
    """
    from libero_env.tasks import find_tasks

    earlier = EvaluationResult.read(request.policy_name) if is_result(request.policy_name) else None
    if earlier is None:
        base = load_protocol(request.protocol)
    else:
        base = EvalProtocol.read(earlier.protocol, request.policy_name)
        request = repeated(request, earlier)
    check_options(request, earlier is not None)
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
    if protocol.pixels.cameras and not Backend.read(protocol.world.backend).is_warp:
        renderer_name()  # before a folder is made
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
    out = request.out or policy.folder(*setting(request))
    return Evaluation(
        identity=identity,
        tasks=tasks,
        until=until,
        stopped=earlier.stopped if earlier else None,
        shuffled=_shuffled(request, out, until is not None or bool(earlier and earlier.stopped)),
        init_states=init_states,
        protocol=protocol,
        out=out,
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


def _shuffled(request: EvalRequest, out: Path, default: bool) -> bool:
    """Return whether units are of starts in the order in which `--until` looks at them: as the folder was begun."""
    begun = (out / PLAN_NAME).is_file() and not request.again
    return read_plan(out)["shuffled"] if begun else default


def load_policy(request: Request) -> PolicyUnderTest:
    """Return the policy that is asked for: the expert, a server's, a user's own, or a run's."""
    policy: PolicyUnderTest
    match policy_kind(request.policy_name):
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
        policy.place = policy.place.with_name(re.sub(r"[^\w.-]+", "_", request.name).lstrip(".") or "_")
    return policy


def setting(request: Request) -> tuple[str, ...]:
    """Return the folder, below that of the policy, of an evaluation that is not the protocol `libero` as it is.

    It names what was asked for: `openpi`, `camera=0.5@lifted+latency=120ms`; nothing for the plain evaluation.
    """
    words = []
    for name in _SETTINGS:
        value = getattr(request, name, plain := getattr(EvalRequest(), name))
        if value == plain:
            continue
        text = ",".join(value) if isinstance(value, tuple) else str(value)
        if name in ("protocol", "assets"):
            words.append(Path(text).stem)
        else:
            words.append(
                text if text and name in ("perturb", "event", "clock") else f"{name}={text or 'none'}"
            )
    word = re.sub(r"[^\w.=,@%+-]+", "_", "+".join(words))
    if len(word) > _LONGEST:
        word = f"{word[: _LONGEST - 9]}-{hashlib.sha256(word.encode()).hexdigest()[:8]}"
    return (word,) if word else ()


# What an evaluation may ask for besides the policy and its tasks, in the order in which its folder names it
_SETTINGS = (
    *("protocol", "perturb", "perturb_seed", "event", "clock", "horizon", "control_freq", "robot", "backend"),
    *("size", "names", "assets", "starts", "seed"),
)
_LONGEST = 80  # characters of a folder's name


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
        asked_for = parse_perturbations(request.perturb, request.perturb_seed)
        _require_severity("--perturb", asked_for)
        perturb = format_perturbations(asked_for)
        changes["world.perturb"] = perturb
    if request.event:
        known = parse_perturbations(perturb, events=True)
        events = parse_perturbations(",".join(request.event), request.perturb_seed, events=True)
        if at_start := [str(one) for one in events if not one.trigger]:
            raise ConfigError(
                f"--event {at_start[0]}: expected KIND=SEVERITY@TRIGGER, such as camera=0.5@lifted"
            )
        _require_severity("--event", events)
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


def _require_severity(option: str, perturbations: Sequence[Perturbation]) -> None:
    if none := [str(one) for one in perturbations if not one.severity]:
        raise ConfigError(
            f"{option} {none[0]}: severity 0 changes nothing; leave it out, or ask for one up to 1"
        )
