"""From the arguments of `libero eval` to the evaluation that they describe."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_env.tasks import Task
    from libero_eval.candidates import PolicyUnderTest
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.protocols.protocol import Card
    from libero_eval.work.suite import SuiteEvaluation

EXPERT = "expert"  # name of the scripted expert among policies


def plan_eval(args: argparse.Namespace, policy: "PolicyUnderTest | None" = None) -> "SuiteEvaluation":
    """Return the evaluation that the arguments describe.

    Args:
        args: Arguments of `libero eval`.
        policy: The policy that they name, where it is loaded already.

    Raises:
        LiberoError: The policy, a task, the protocol or the set of initial states does not exist.
    """
    from libero_env.cli.tasks import find_tasks
    from libero_env.tasks.published import require_available
    from libero_eval.protocols.packaged import choose_init_states
    from libero_eval.repeat import check_same
    from libero_eval.work.suite import SuiteEvaluation
    from libero_eval.work.units import UNIT_STARTS
    from lifelong.results.provenance import installed_versions

    args, card, earlier = _what_to_repeat(args)
    _check_idle(args, earlier)
    policy = policy or load_policy(args)
    tasks = find_tasks(args.suite) if args.suite else policy.tasks
    if not tasks:
        raise ConfigError("no tasks are given; name a suite, such as --suite libero_object")
    require_available(tasks)
    protocol = _protocol(args, policy.protocol(card), tasks)
    identity, versions = {**policy.identity, "seed": args.seed}, installed_versions(args.assets)
    if earlier is None:
        init_states = choose_init_states(args.starts, _episodes(args, tasks), policy.selection)
    else:
        init_states = earlier.init_states
        check_same(earlier, evaluated=identity, protocol=protocol, versions=versions, despite=args.despite)
    return SuiteEvaluation(
        identity=identity,
        tasks=tuple(dict.fromkeys(tasks)),
        init_states=init_states,
        protocol=protocol,
        out=args.out or policy.out,
        env=lambda task, count: policy.env(task, count, protocol),
        actor=lambda task, states: policy.actor(task, states, protocol),
        unit_starts=UNIT_STARTS if args.unit_starts is None else args.unit_starts,
        retries=args.retries,
        errors_are_failures=protocol.episode.errors == "failure",
        videos=args.videos,
        progress=sys.stderr.isatty() and args.workers == 1,
        versions=versions,
        policy_threads=args.policy_threads or (1 if policy.on_cpu else None),
    )


def _what_to_repeat(
    args: argparse.Namespace,
) -> "tuple[argparse.Namespace, Card, EvaluationResult | None]":
    """Return arguments, protocol and result, those of the result where one is run again; otherwise None for it."""
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.protocols.files import load_card
    from libero_eval.repeat import is_result, repeated, repeated_card

    if not is_result(args.policy):
        return args, load_card(args.protocol), None
    earlier = EvaluationResult.read(args.policy)
    return repeated(args, earlier), repeated_card(earlier, args.policy), earlier


def load_policy(args: argparse.Namespace) -> "PolicyUnderTest":
    """Return the policy that the arguments name: the expert, a server's, a user's own, or a run's."""
    from libero_eval.candidates import RunPolicy, UserPolicy

    if _is_expert(args.policy):
        from libero_eval.expert import ExpertPolicy

        return ExpertPolicy(args)
    if "://" in args.policy:
        from libero_eval.servers.policy import ServerPolicy

        return ServerPolicy(args)
    return UserPolicy(args) if _is_callable(args.policy) else RunPolicy(args)


def _episodes(args: argparse.Namespace, tasks: "Sequence[Task]") -> int | None:
    """Return the number of episodes of each task; None for all: LIBERO-Plus has one, from the first initial state.

    Raises:
        ConfigError: A task has fewer initial states.
    """
    scarce = [task for task in tasks if task.num_starts == 1]
    from_plus = [task for task in tasks if task.suite.startswith("libero_plus_")]
    count: int | None = args.episodes or (1 if len(from_plus) == len(tasks) else None)
    if scarce and (count != 1 or args.starts == "selection"):
        raise ConfigError(
            f"{scarce[0].id} has one initial state, number 0: --episodes 1, without --starts selection"
        )
    return count


def _protocol(args: argparse.Namespace, card: "Card", tasks: "Sequence[Task]") -> "Card":
    """Return the protocol on this machine, with what the arguments change; what was chosen is printed."""
    from libero_env.perturbations import format_perturbations, parse_perturbations
    from libero_env.sim.backend import Backend
    from libero_eval.protocols.environment import resolve_world

    protocol, notes = resolve_world(card, tasks, args.assets)
    if args.horizon:
        protocol = protocol.changed({"episode.horizon": args.horizon})
    if args.perturb is not None:
        perturbations = parse_perturbations(args.perturb, args.perturb_seed)
        protocol = protocol.changed({"world.perturb": format_perturbations(perturbations)})
    if args.robot:
        protocol = protocol.changed({"world.robot": args.robot})
    if args.backend is not None:
        protocol = protocol.changed({"world.backend": Backend.read(args.backend).name})
    Backend.read(args.backend or protocol.world.backend).require_installed()
    protocol.require()
    for note in notes:
        print(f"note: {note}", file=sys.stderr, flush=True)
    return protocol


def _check_idle(args: argparse.Namespace, earlier: "EvaluationResult | None") -> None:
    """Check that no option is given that means nothing for this kind of policy.

    Raises:
        ConfigError: One is; the message says what it is of.
    """
    own_run = "://" not in args.policy and not _is_callable(args.policy) and not _is_expert(args.policy)
    if args.after is not None and not own_run:
        raise ConfigError(f"--after is of runs, and {args.policy} is none")
    if args.despite and earlier is None:
        raise ConfigError(f"--despite is of results that are run again, and {args.policy} is none")


def _is_expert(text: str) -> bool:
    return text == EXPERT and not Path(text).exists()


def _is_callable(text: str) -> bool:
    return ":" in text and not Path(text).exists()
