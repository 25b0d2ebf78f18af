"""`libero robustness`: what perturbations do to a policy, kind by kind and severity by severity."""

import argparse
import io
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli import arguments, ending
from libero_env.cli.arguments import Subparsers
from libero_env.parallel import cpu_count
from libero_eval.cli import evaluate
from libero_eval.cli.plan import load_policy, plan_eval
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.candidates import PolicyUnderTest
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.robustness.page import Robustness
    from libero_eval.work.suite import SuiteEvaluation

DESCRIPTION = """\
Evaluate a policy under every kind of perturbation at several severities, each episode from the start of one without
perturbation, and write a page: success against severity with intervals, the area under it, the severity at which half
is lost, and what two perturbations take together. It can be stopped; the same command goes on.

examples:
  libero robustness runs/libero_goal/er/bc_mlp_small_seed1 --workers 2
  libero robustness expert --suite libero_goal --out eval/expert         what can be done at all
  libero robustness my_policy:make --suite libero_goal --kinds camera light --beside expert=eval/expert
  libero robustness --report er=eval/er sequential=eval/sequential       only the page, of what is there"""
KINDS: tuple[str, ...] = ("layout", "distractors", "instruction", "camera", "light", "table", "background")
KINDS += ("robot", "noise", "occlusion", "latency", "gain")
SEVERITIES = (0.2, 0.4, 0.6, 0.8, 1.0)
PAIRS = ("camera=0.4,light=0.4", "camera=0.4,robot=0.4", "light=0.4,noise=0.4")
EPISODES = 10
CONDITIONS = "conditions"  # folder of the evaluations


def register(subparsers: Subparsers) -> None:
    """Add the command `libero robustness POLICY`."""
    parser = subparsers.add_parser(
        "robustness",
        help="what perturbations do to a policy: success against severity, kind by kind",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("policy", nargs="?", help=evaluate.POLICY_HELP)
    measured = parser.add_argument_group("what is measured")
    evaluate.add_episode_options(measured)
    measured.add_argument(
        "--kinds", nargs="+", default=KINDS, metavar="KIND", help=f"(default: {' '.join(KINDS)})"
    )
    measured.add_argument(
        "--severities",
        nargs="+",
        type=arguments.number(0, 1),
        default=SEVERITIES,
        metavar="S",
        help=f"above 0 (default: {' '.join(map(str, SEVERITIES))})",
    )
    measured.add_argument(
        "--pairs",
        nargs="*",
        default=PAIRS,
        metavar="KIND=S,KIND=S",
        help=f"two perturbations at once (default: {' '.join(PAIRS)})",
    )
    page = parser.add_argument_group("the page")
    page.add_argument("--name", help="name of the policy on the page (default: what names it)")
    page.add_argument(
        "--beside",
        nargs="+",
        default=[],
        metavar="NAME=DIR",
        help="other policies' folders, which are drawn beside it",
    )
    page.add_argument(
        "--report",
        nargs="+",
        default=[],
        metavar="NAME=DIR",
        help="only write the page of the first folder, with the others beside it",
    )
    evaluate.add_work_options(parser.add_argument_group("how it is run"))
    parser.set_defaults(run=run_robustness, episodes=EPISODES, despite=[], status=None)


def run_robustness(args: argparse.Namespace) -> None:
    """Evaluate all conditions, print the table, and write the page."""
    from libero_eval.work.workers import Crew

    if args.report:
        first, *others = [_read(word) for word in args.report]
        _finish([first, *others], args.out or Path(args.report[0].rpartition("=")[2]))
        return
    if args.policy is None:
        raise ConfigError("no policy is named; it comes first: libero robustness RUN_DIR --suite libero_goal")
    args.threads = args.threads or max(1, cpu_count() // args.workers)
    beside = [_read(word) for word in args.beside]  # before hours of work
    conditions = _conditions(args)
    policy = load_policy(args)
    folder = args.out or policy.out / "robustness"
    if args.again:
        for _, plan in _plans(args, policy, folder, conditions):
            plan.folder.clear()
    helpers = argparse.Namespace(**(vars(args) | {"again": False, "out": folder}))
    workers = min(args.workers, len(conditions))
    try:
        with Crew(workers - 1, help_robustness, helpers) as crew:
            _work(args, policy, folder, conditions, crew)
    except KeyboardInterrupt as error:
        error.add_note(f"{folder} keeps what is done; the same command goes on")
        raise
    name = args.name or _name(policy)
    _finish([_read(f"{name}={folder}"), *beside], folder)


def help_robustness(args: argparse.Namespace) -> None:
    """Work on the conditions of another process of this command; errors go to the standard error."""
    with suppress(KeyboardInterrupt), ending.interruptible():
        try:
            with redirect_stderr(io.StringIO()):  # the other process says the same
                policy = load_policy(args)
            _work(args, policy, args.out, _conditions(args), None)
        except Exception as error:  # noqa: BLE001 - told by kind
            sys.exit(ending.report(error, who="a worker ended: "))


def _work(
    args: argparse.Namespace, policy: "PolicyUnderTest", folder: Path, conditions: Sequence[str], crew
) -> None:
    """Take units of all conditions until none is free, and wait for those of others at the end."""
    from libero_eval.work.worker import Worker

    told: set[str] = set()
    finished = 0
    for wait in (False, True) if crew else (False,):
        for condition, plan in _plans(args, policy, folder, conditions):
            if condition in told:
                continue

            def tend(done: int, before: int = finished) -> None:
                if crew:
                    crew.tend(before + done)

            with evaluate.policy_threads(plan):
                result = Worker(plan, on_wait=tend).work(wait=wait)
            if result is not None:
                told.add(condition)
                finished += len(plan.units)
                if crew:
                    _tell(condition, result, len(told), len(conditions))


def _tell(condition: str, result: "EvaluationResult", done: int, of: int) -> None:
    e = result.success
    print(
        f"{time.strftime('%H:%M')} {done:>3}/{of}  {condition or 'without perturbations':<28} "
        f"{100 * e.value:5.1f} % [{100 * e.low:.1f}, {100 * e.high:.1f}]",
        flush=True,
    )


def _plans(
    args: argparse.Namespace, policy: "PolicyUnderTest", folder: Path, conditions: Sequence[str]
) -> "Iterator[tuple[str, SuiteEvaluation]]":
    """Yield the evaluation of each condition."""
    for number, condition in enumerate(conditions):
        own = {"perturb": condition, "out": folder / CONDITIONS / (condition or "none")}
        with redirect_stderr(io.StringIO() if number else sys.stderr):  # notes are said once
            yield condition, plan_eval(argparse.Namespace(**(vars(args) | own)), policy)


def _conditions(args: argparse.Namespace) -> list[str]:
    """Return the texts of all conditions, the one without perturbations first.

    Raises:
        LiberoError: A kind does not exist, or a text is not valid.
    """
    from libero_env.perturbations import format_perturbations, get_kind, parse_perturbations

    texts = [
        f"{get_kind(kind).name}={severity:g}" for kind in args.kinds for severity in sorted(args.severities)
    ]
    found = [format_perturbations(parse_perturbations(text, args.perturb_seed)) for text in texts]
    for text in args.pairs:
        pair = parse_perturbations(text, args.perturb_seed)
        if len(pair) != 2:
            raise ConfigError(f"--pairs {text}: expected two perturbations, such as camera=0.4,light=0.4")
        if {one.kind for one in pair} <= set(args.kinds) and {one.severity for one in pair} <= set(
            args.severities
        ):
            found.append(format_perturbations(pair))
        elif tuple(args.pairs) != PAIRS:  # those that were named
            raise ConfigError(
                f"--pairs {text}: each must also be run alone; name its kind in --kinds and its severity in "
                "--severities"
            )
    return list(dict.fromkeys(("", *found)))


def _read(word: str) -> "Robustness":
    """Return the outcomes in a folder of this command, NAME=DIR or DIR.

    Raises:
        ConfigError: It holds no finished conditions.
    """
    from libero_env.perturbations import parse_perturbations
    from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
    from libero_eval.robustness.page import Robustness
    from libero_eval.robustness.results import Outcomes, name_of

    name, _, text = word.rpartition("=")
    folder = Path(text)
    results, again = {}, {}
    for path in sorted((folder / CONDITIONS).glob(f"*/{FILE_NAME}")):
        result = EvaluationResult.read(path)
        world = result.protocol.get("world", {})
        perturbations = parse_perturbations(world.get("perturb", ""))
        condition = tuple((one.kind, one.severity) for one in perturbations)
        results[condition] = result
        again[name_of(condition)] = sum(sum(row) for task in result.tasks for row in task.attempts)
    if not results:
        raise ConfigError(
            f"{folder} holds no finished conditions; `libero robustness POLICY --out {folder}` makes them"
        )
    return Robustness(name or folder.name, Outcomes.of(results), (str(folder),), again)


def _finish(policies: "Sequence[Robustness]", folder: Path) -> None:
    """Print the table of the first policy, and write the page."""
    from libero_env.perturbations import KINDS as ALL
    from libero_eval.robustness.page import render, write_robustness

    first = policies[0]
    print(f"\n{render(first)}\n")
    outcomes = first.outcomes
    suites = ", ".join(dict.fromkeys(task.partition("/")[0] for task in outcomes.tasks))
    facts = [
        ("tasks", f"{len(outcomes.tasks)} of {suites}"),
        ("starts", f"{len(outcomes.starts)} a task"),
        ("conditions", str(len(outcomes.conditions))),
        ("episodes", str(outcomes.successes.size)),
    ]
    units = {name: f"{kind.at_one:g} {kind.unit}" for name, kind in ALL.items()}
    print(write_robustness(policies, folder, units=units, facts=facts))


def _name(policy: "PolicyUnderTest") -> str:
    """Return a short name of a policy."""
    identity = policy.identity
    if "run" in identity:
        return "/".join(Path(str(identity["run"])).parts[-3:])
    return str(identity.get("policy", identity.get("server", "policy")))
