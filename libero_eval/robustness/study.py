"""Evaluations of a policy under many perturbations, each episode from the start of one without: run, and read again."""

import io
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import replace
from pathlib import Path

from libero_env.perturbations import format_perturbations, parse_perturbations
from libero_env.storage import own_folder
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.judging.comparability import settings
from libero_eval.plan import load_policy, plan_evaluation, setting
from libero_eval.policies import PolicyUnderTest
from libero_eval.protocols.files import load_protocol
from libero_eval.protocols.naming import protocol_label, section_of
from libero_eval.requests import (
    CLOCK,
    EVENT_SEVERITIES,
    EVENTS,
    KINDS,
    PAIRS,
    SEVERITIES,
    RobustnessRequest,
)
from libero_eval.robustness.results import LATENCY, Condition, Outcomes, Robustness, events_of, name_of
from libero_eval.work.evaluation import Evaluation
from libero_eval.work.scheduler import Told, carry_out
from lifelong.errors import ConfigError

CONDITIONS = "conditions"  # folder of the evaluations


def study_robustness(request: RobustnessRequest, on_condition: Told = lambda *_: None) -> tuple[str, Path]:
    """Evaluate a policy under all conditions; what is done already is not run again.

    Args:
        request: Policy, tasks, kinds and severities.
        on_condition: Function called with each condition, its result, and how many are done of how many.

    Returns:
        A name of the policy, and the folder of the results.
    """
    conditions = conditions_of(request)
    if perturb := load_protocol(request.protocol).world.perturb:
        raise ConfigError(
            f"protocol {request.protocol} has the perturbations {perturb}, and each condition has its own: name a "
            "protocol without world.perturb"
        )
    policy = load_policy(request)
    out = request.out or policy.folder(*setting(request), "robustness")
    for one in conditions:
        own_folder(out, CONDITIONS, one or "none", error=ConfigError)
    request = replace(request, out=out)
    evaluations = _plan(request, policy)
    clock = evaluations[""].protocol.action.clock
    if clock and request.clock is None and any(one.startswith(CLOCK) for one in conditions):
        raise ConfigError(
            f"--kinds clock: protocol {request.protocol} has the clock {clock}; say with --clock what of it holds for "
            "all latencies, such as wait=hold"
        )
    carry_out(_plan, request, evaluations, on_done=on_condition)
    return _name(policy), out


def _plan(request: RobustnessRequest, policy: PolicyUnderTest | None = None) -> dict[str, Evaluation]:
    """Return the evaluation of each condition; notes are said once."""
    assert request.out is not None
    policy, planned = policy or load_policy(request), dict[str, Evaluation]()
    for condition in conditions_of(request):
        with redirect_stderr(io.StringIO() if planned else sys.stderr):
            out = request.out / CONDITIONS / (condition or "none")
            planned[condition] = plan_evaluation(request.condition(condition, out), policy)
    return planned


def conditions_of(request: RobustnessRequest) -> list[str]:
    """Return the texts of all conditions, the one without perturbations first.

    Raises:
        LiberoError: A kind does not exist, a text is not valid, two differ in their seeds alone, or there are none.
    """
    seed = request.perturb_seed
    defaults = (EVENTS, EVENT_SEVERITIES, ()) if request.events else (KINDS, SEVERITIES, PAIRS)
    kinds = defaults[0] if request.kinds is None else request.kinds
    severities = defaults[1] if request.severities is None else request.severities
    pairs = defaults[2] if request.pairs is None else request.pairs
    conditions = []
    for kind, at, trigger in (kind.partition("@") for kind in kinds):
        for severity in sorted(severities):
            text = f"{kind}={severity:g}{at}{trigger}"
            if text.startswith(CLOCK) and not at:
                conditions.append(text if severity else "")
            else:
                conditions.append(format_perturbations(parse_perturbations(text, seed, events=True)))
    for text in pairs:
        pair = parse_perturbations(text, seed, events=True)
        if len(pair) != 2:
            raise ConfigError(f"--pairs {text}: expected two perturbations, such as camera=0.4,light=0.4")
        if all(str(one) in conditions for one in pair):
            conditions.append(format_perturbations(pair))
        elif request.pairs is not None:
            raise ConfigError(
                f"--pairs {text}: each must also be run alone; name its kind in --kinds and its severity in "
                "--severities, and give it no other seed"
            )
    found: dict[Condition, str] = {}
    for text in ("", *conditions):
        known = found.setdefault(_condition(text), text)
        if known != text:
            raise ConfigError(
                f"--kinds and --pairs name {known} and {text}, which differ in their seeds alone; run one of them with "
                "an --out of its own"
            )
    if len(found) == 1:
        raise ConfigError("--kinds and --severities name no condition; name a kind, and a severity above 0")
    return list(found.values())


def _condition(text: str) -> Condition:
    """Return the condition of a text of `conditions_of`, without the seeds."""
    if text.startswith(CLOCK):
        return ((LATENCY, float(text.removeprefix(CLOCK))),)
    return tuple((one.name, one.severity) for one in parse_perturbations(text, events=True))


def read_study(folder: Path, name: str = "", conditions: Sequence[str] | None = None) -> Robustness:
    """Return the outcomes in a folder of this command.

    Args:
        folder: The folder.
        name: Name of the policy (default: that of the folder).
        conditions: Texts of the conditions to read, from `conditions_of` (default: all that are finished).

    Raises:
        ConfigError: It holds no finished conditions, or two that differ in their seeds alone.
        ResultsError: A condition was run in other episodes, with another policy or under other settings than the base.
    """
    results, redrawn, events = {}, {}, {}
    folders: dict[Condition, str] = {}
    seeds = set[int]()
    paths = sorted((folder / CONDITIONS).glob(f"*/{FILE_NAME}"))
    if conditions is not None:
        paths = [folder / CONDITIONS / (one or "none") / FILE_NAME for one in conditions]
    for path in paths:
        result, text = EvaluationResult.read(path), path.parent.name
        perturb = result.protocol.get("world", {}).get("perturb", "")
        perturbations = parse_perturbations(perturb, events=True)
        condition = _condition(text if text.startswith(CLOCK) else perturb)
        if (known := folders.setdefault(condition, text)) != text:
            raise ConfigError(
                f"{folder / CONDITIONS} holds {name_of(condition)} twice, {known} and {text}; move one of them to "
                "another folder"
            )
        results[condition] = result
        seeds |= {one.seed for one in perturbations}
        if any(one.trigger for one in perturbations):
            events[condition] = events_of(result)
        else:
            redrawn[name_of(condition)] = sum(sum(row) for task in result.tasks for row in task.attempts)
    if not any(len(condition) == 1 for condition in results):  # one perturbation by itself
        raise ConfigError(
            f"{folder} holds no finished conditions; `libero robustness POLICY --out {folder}` makes them"
        )
    outcomes, base = Outcomes.of(results), results[()]
    common = settings(base)
    common["versions.mujoco"] = base.versions.get("mujoco")
    common["seeds of perturbations"] = ", ".join(map(str, sorted(seeds)))
    horizon = section_of(base.protocol, "episode").get("horizon") or 0
    label = protocol_label(base.protocol, base.suites)
    return Robustness(name or folder.name, outcomes, (str(folder),), redrawn, events, horizon, label, common)


def _name(policy: PolicyUnderTest) -> str:
    identity = policy.identity
    if "run" in identity:
        return "/".join(Path(str(identity["run"])).parts[-3:])
    return str(identity.get("policy", identity.get("server", "policy")))
