"""`libero perturb`: what can be perturbed, what it looks like, and whether the expert solves it."""

import argparse
from pathlib import Path

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers


def register(subparsers: Subparsers) -> None:
    """Add the command `libero perturb`."""
    parser = subparsers.add_parser("perturb", help="perturbations of tasks and episodes")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    listing = commands.add_parser("list", help="the kinds, with the unit and what severity 1 is")
    listing.set_defaults(run=run_list)
    show = commands.add_parser(
        "show", help="a picture of a start without and with perturbations, side by side"
    )
    show.add_argument("task", help="such as libero_goal/3")
    show.add_argument(
        "--perturb", required=True, metavar="KIND=SEVERITY,...", help="such as camera=0.3,light=0.5"
    )
    show.add_argument("--seed", type=arguments.seed, default=0, help="seed of what is drawn (default: 0)")
    show.add_argument("--start", type=arguments.whole(0, 49), default=0, help="initial state (default: 0)")
    show.add_argument(
        "--size", type=arguments.side, default=256, help="side of each picture, pixels (default: 256)"
    )
    show.add_argument(
        "--out", type=arguments.path, default=Path("perturbed.png"), help="file (default: perturbed.png)"
    )
    show.set_defaults(run=run_show)
    _register_certify(commands)


def _register_certify(commands: Subparsers) -> None:
    certify = commands.add_parser(
        "certify", help="whether the expert solves what is drawn; draws again what it does not; resumes"
    )
    certify.add_argument("tasks", nargs="+", metavar="TASK", help="such as libero_goal/3, or a suite")
    certify.add_argument(
        "--kinds",
        nargs="+",
        metavar="KIND",
        help="kinds (default: all that change physics, start or actions)",
    )
    certify.add_argument(
        "--severities",
        nargs="+",
        type=arguments.share,
        default=[0.2, 0.4, 0.6, 0.8, 1.0],
        metavar="S",
        help="severities of each kind (default: 0.2 0.4 0.6 0.8 1)",
    )
    certify.add_argument(
        "--starts", type=arguments.whole(1, 50), default=10, help="initial states of each task (default: 10)"
    )
    certify.add_argument(
        "--redraws", type=arguments.whole(0, 20), default=3, help="further draws after a failure (default: 3)"
    )
    certify.add_argument("--seed", type=arguments.seed, default=0, help="seed of what is drawn (default: 0)")
    certify.add_argument(
        "--jobs",
        type=arguments.processes_or_all,
        default=0,
        help="number of processes (default: one per core)",
    )
    certify.add_argument(
        "--out",
        type=arguments.path,
        default=Path("certificates/perturbed"),
        help="folder of the results (default: certificates/perturbed)",
    )
    certify.add_argument("--again", action="store_true", help="run again what is in the folder")
    certify.add_argument(
        "--keep",
        action="store_true",
        help="let environments use the draws that were solved (writes to the package)",
    )
    certify.set_defaults(run=run_certify, go_on="what is measured is kept; the same command goes on")


def run_list(args: argparse.Namespace) -> None:
    """Print a line for each kind, in the order in which they are applied."""
    from libero_env.perturbations import KINDS

    print(f"{'layer':12} {'kind':14} {'at 1':>5} {'unit':22} what changes")
    for kind in KINDS.values():
        print(f"{kind.layer:12} {kind.name:14} {kind.at_one:5g} {kind.unit:22} {kind.what}")


def run_show(args: argparse.Namespace) -> None:
    """Write the picture; print the file, the instruction and the amounts."""
    from libero_env.cli.tasks import find_tasks
    from libero_env.design.preview import compare_starts
    from libero_env.perturbations import parse_perturbations

    perturbations = parse_perturbations(args.perturb, args.seed)
    for task in find_tasks([args.task]):
        changed = compare_starts(task, perturbations, args.out, start=args.start, size=args.size)
        for one in perturbations:
            print(f"{one!s:22} {one.amount:g} {one.definition.unit}")
        print(f"{changed.language}\n{args.out}")


def run_certify(args: argparse.Namespace) -> None:
    """Run what is missing, print the share that the expert solves of each kind and severity, and note the draws."""
    import json

    from libero_env.cli.tasks import find_tasks
    from libero_env.design.certify_perturbed import certify_perturbed, shares_table
    from libero_env.parallel import cpu_count
    from libero_env.perturbations import KINDS, Perturbation
    from libero_env.perturbations.draws import kept_path
    from libero_env.storage import atomic_write_text

    kinds = args.kinds or [name for name, kind in KINDS.items() if kind.physical]
    severities = [severity for severity in args.severities if severity]
    perturbations = [Perturbation(kind, s, args.seed) for kind in dict.fromkeys(kinds) for s in severities]
    found = certify_perturbed(
        find_tasks(args.tasks),
        perturbations,
        args.starts,
        redraws=args.redraws,
        jobs=args.jobs or cpu_count(),
        out=args.out,
        again=args.again,
    )
    print(*shares_table(found, perturbations), sep="\n")
    if args.keep:
        named = {str(one): one for one in perturbations}
        kept = json.loads(kept_path().read_text(encoding="utf-8")) if kept_path().is_file() else {}
        for certificate in found:
            kept |= certificate.attempts(named[certificate.perturbation])
        atomic_write_text(kept_path(), json.dumps(dict(sorted(kept.items())), indent=0) + "\n")
        print(kept_path())
