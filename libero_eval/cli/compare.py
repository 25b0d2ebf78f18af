"""`libero compare`, `libero power` and `libero results`: is a policy better, and what do others read of its results."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from libero_env.cli import arguments
from libero_env.cli.arguments import Subparsers
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.judging.comparability import Side
    from lifelong.stats.power import Question

RESULT_HELP = "a file eval.json or its folder; NAME=RESULT names it in the tables"


def register(subparsers: Subparsers) -> None:
    """Add the commands `libero compare`, `libero power` and `libero results export`."""
    _add_compare(subparsers)
    _add_power(subparsers)
    _add_results(subparsers)


def _add_compare(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser(
        "compare", help="whether evaluated policies differ, start by start, and what chance alone makes"
    )
    parser.add_argument("results", nargs="*", metavar="RESULT", help=RESULT_HELP)
    parser.add_argument(
        "--group",
        nargs="+",
        action="append",
        default=[],
        metavar=("NAME", "RESULT"),
        help="results of several runs of one method, such as training seeds; give it once for each method",
    )
    parser.add_argument(
        "--control", nargs=2, metavar="RESULT", help="one policy evaluated twice, with different seeds"
    )
    parser.add_argument(
        "--allow",
        action="append",
        default=[],
        metavar="FIELD",
        help="compare although this setting differs, such as protocol.horizon, environment.robot or tasks",
    )
    parser.add_argument(
        "--alpha",
        type=arguments.probability,
        default=0.05,
        help="probability of a false difference (default: 0.05)",
    )
    parser.add_argument("--tasks", action="store_true", help="show every task in the terminal")
    parser.add_argument(
        "--out", type=arguments.path, metavar="DIR", help="folder for compare.html and compare.json"
    )
    parser.set_defaults(run=run_compare)


def _add_power(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser("power", help="how many episodes a difference in success needs")
    parser.add_argument(
        "results", nargs="*", metavar="RESULT", help="two results to take the success and discordance from"
    )
    parser.add_argument("--base", type=arguments.share, help="success rate of the one policy (default: 0.9)")
    parser.add_argument(
        "--difference",
        type=arguments.number(-1, 1),
        help="success of the other minus that, such as 0.03 (default: a table of several)",
    )
    share = parser.add_mutually_exclusive_group()
    share.add_argument(
        "--discordance", type=arguments.share, help="share of starts in which exactly one of the two succeeds"
    )
    share.add_argument(
        "--correlation",
        type=arguments.number(-1, 1),
        help="correlation of the two outcomes in a start, instead",
    )
    parser.add_argument(
        "--power", type=arguments.probability, default=0.8, help="probability of showing it (default: 0.8)"
    )
    parser.add_argument(
        "--alpha",
        type=arguments.probability,
        default=0.05,
        help="probability of a false difference (default: 0.05)",
    )
    parser.add_argument(
        "--tests",
        type=arguments.whole(1, 1_000_000),
        default=1,
        help="number of comparisons that share alpha",
    )
    parser.add_argument(
        "--episodes",
        type=arguments.whole(1, 2_000_000),
        help="print the smallest difference that they show instead",
    )
    parser.set_defaults(run=run_power)


def _add_results(subparsers: Subparsers) -> None:
    parser = subparsers.add_parser("results", help="write results of an evaluation for other tools")
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    export = actions.add_parser("export", help="write a result as another tool's result file")
    export.add_argument("result", metavar="RESULT", help="a file eval.json or its folder")
    export.add_argument(
        "--as",
        dest="format",
        required=True,
        choices=("vla-eval", "lerobot"),
        help="vla-eval: SUITE_aggregate.json for each suite; lerobot: eval_info.json",
    )
    export.add_argument(
        "--out", type=arguments.path, metavar="DIR", help="folder of the files (default: the result's)"
    )
    export.set_defaults(run=run_export)


def run_compare(args: argparse.Namespace) -> None:
    """Print the comparison; write the page and the JSON file if a folder is given."""
    from libero_eval.judging.comparison import judge, write_judgement
    from libero_eval.judging.text import render

    sides = [*_single_sides(args.results), *(_group(words) for words in args.group)]
    control = None
    if args.control:
        first, second = _single_sides(args.control)
        control = (first, second)
    found = judge(sides, control=control, allow=args.allow, alpha=args.alpha)
    print(render(found, tasks=args.tasks))
    if args.out:
        from libero_eval.judging.page import write_page

        print()
        print(write_page(found, args.out / "compare.html"))
        print(write_judgement(found, args.out / "compare.json"))


def run_power(args: argparse.Namespace) -> None:
    """Print how many episodes a difference needs, a table of them, or the difference that can be shown."""
    from libero_eval.judging import power_text

    question = _question(args)
    if args.episodes:
        print(power_text.shown(question, args.episodes))
    elif args.difference is None and not args.results:
        print(power_text.table(question))
    else:
        print(power_text.answer(question))


def run_export(args: argparse.Namespace) -> None:
    """Write a result in another tool's format and print the files."""
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.exports import export_lerobot, export_vla_eval

    result = EvaluationResult.read(args.result)
    path = Path(args.result)
    folder = args.out or (path if path.is_dir() else path.parent)
    for written in {"vla-eval": export_vla_eval, "lerobot": export_lerobot}[args.format](result, folder):
        print(written)


def _question(args: argparse.Namespace) -> "Question":
    from lifelong.stats.power import Question, discordance_of

    base, gap, discordance = args.base, args.difference, args.discordance
    if args.results:
        seen = _observed(args.results)
        base = seen[0] if base is None else base
        gap = seen[1] if gap is None else gap
        discordance = seen[2] if discordance is None and args.correlation is None else discordance
    base = 0.9 if base is None else base
    known = 0.03 if gap is None else gap
    if known > 0 and base + known > 1:
        raise ConfigError(
            f"--base {base:g} and --difference {known:g} give a success of {base + known:g}, above 1"
        )
    if args.correlation is not None:
        discordance = discordance_of(base, known, args.correlation)
    return Question(base, known, discordance, args.power, args.alpha, args.tests)


def _observed(words: Sequence[str]) -> tuple[float, float, float]:
    """Return the success of the first of two results, the second's minus it, and their discordance."""
    from libero_eval.judging.comparability import match
    from lifelong.stats.episodes import count

    if len(words) != 2:
        raise ConfigError(f"libero power takes two results, not {len(words)}")
    pairs = match(*_single_sides(words)).pairs
    counts = count(pairs)
    first, second = float(pairs.first.mean()), float(pairs.second.mean())
    print(
        f"observed in {counts.pairs} pairs: success {100 * first:.1f} % and {100 * second:.1f} %, "
        f"discordance {counts.discordant / counts.pairs:.3f}"
    )
    return first, second - first, counts.discordant / counts.pairs


def _single_sides(words: Sequence[str]) -> "list[Side]":
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.comparability import Side

    split = [_named(w) for w in words]
    labels = _labels([path for _, path in split])
    return [
        Side(name or label, (EvaluationResult.read(path),), (path,))
        for (name, path), label in zip(split, labels, strict=True)
    ]


def _group(words: Sequence[str]) -> "Side":
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.comparability import Side

    if len(words) < 2:
        raise ConfigError(f"--group {' '.join(words)}: write --group NAME RESULT RESULT ...")
    return Side(words[0], tuple(EvaluationResult.read(w) for w in words[1:]), tuple(words[1:]))


def _named(word: str) -> tuple[str | None, str]:
    name, sign, path = word.partition("=")
    return (name, path) if sign and name and not Path(word).exists() else (None, word)


def _labels(paths: Sequence[str]) -> list[str]:
    """Return the parts of the paths that distinguish them."""
    if not paths:
        return []
    parts = [Path(p).parts for p in paths]
    parts = [p[:-1] if p and p[-1] == "eval.json" else p for p in parts]
    start = len(os.path.commonprefix(parts)) if len(parts) > 1 else max(0, len(parts[0]) - 1)
    end = len(os.path.commonprefix([p[::-1] for p in parts])) if len(parts) > 1 else 0
    cut = ["/".join(p[start : max(start, len(p) - end)]) for p in parts]
    return [c or "/".join(p) or "." for c, p in zip(cut, parts, strict=True)]
