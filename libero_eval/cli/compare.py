"""`libero compare`, `libero power` and `libero results`: is a policy better, and what do others read of its results."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from libero_env.cli.options import Field, FilePath, Positional, Probability, Share, arg
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.judging.comparability import Group
    from lifelong.stats.power import Question

_Signed = Annotated[float, Field(ge=-1, le=1)]


def compare(
    results: Positional[tuple[str, ...]] = (),
    *,
    group: tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]] = (),
    control: tuple[str, str] | None = None,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    alpha: Probability = 0.05,
    tasks: bool = False,
    out: FilePath | None = None,
) -> None:
    """Say whether evaluated policies differ, start by start, and what chance alone makes.

    Args:
        results: Files eval.json or their folders; NAME=RESULT names one in the tables.
        group: NAME RESULT...: results of several runs of one method, such as training seeds; give it once for each
            method.
        control: One policy evaluated twice, with different seeds.
        allow: Compare although this setting differs, such as protocol.horizon, environment.robot or tasks.
        alpha: Probability of a false difference.
        tasks: Show every task in the terminal.
        out: Folder for compare.html and compare.json.
    """
    from libero_eval.judging.comparison import compare_groups, write_comparison
    from libero_eval.judging.page import render

    groups = [*_single_groups(results), *(_group(words) for words in group)]
    first_twice = _single_groups(control) if control else None
    pair = (first_twice[0], first_twice[1]) if first_twice else None
    comparison = compare_groups(groups, control=pair, allow=allow, alpha=alpha)
    print(render(comparison, tasks=tasks))
    if out:
        from libero_eval.judging.page import write_page

        print()
        print(write_page(comparison, out / "compare.html"))
        print(write_comparison(comparison, out / "compare.json"))


@dataclass(frozen=True, kw_only=True)
class PowerOptions:
    """Say how many episodes a difference in success needs.

    Attributes:
        results: Two results to take the success and discordance from.
        base: Success rate of the one policy (default: 0.9).
        difference: Success of the other minus that, such as 0.03 (default: a table of several).
        discordance: Share of starts in which exactly one of the two succeeds.
        correlation: Correlation of the two outcomes in a start, instead of the discordance.
        power: Probability of showing it.
        alpha: Probability of a false difference.
        tests: Number of comparisons that share alpha.
        episodes: Print the smallest difference that they show instead.
    """

    results: Positional[tuple[str, ...]] = ()
    base: Share | None = None
    difference: _Signed | None = None
    discordance: Share | None = None
    correlation: _Signed | None = None
    power: Probability = 0.8
    alpha: Probability = 0.05
    tests: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    episodes: Annotated[int, Field(ge=1, le=2_000_000)] | None = None


def power(options: PowerOptions) -> None:
    """Print how many episodes a difference needs, a table of them, or the difference that can be shown."""
    from libero_eval.judging import power_text

    if options.discordance is not None and options.correlation is not None:
        raise ConfigError("--correlation stands for --discordance; give one of them")
    question = _question(options)
    if options.episodes:
        print(power_text.shown(question, options.episodes))
    elif options.difference is None and not options.results:
        print(power_text.table(question))
    else:
        print(power_text.answer(question))


def export(
    results: Positional[Annotated[tuple[str, ...], Field(min_length=1)]],
    *,
    format: Annotated[Literal["vla-eval", "lerobot", "csv", "latex", "parquet"], arg(name="as")],
    out: FilePath | None = None,
) -> None:
    """Write an evaluation as another tool's result file, or runs as a table, and print the files.

    Args:
        results: A file eval.json or its folder; for a table runs, folders of runs, or patterns.
        format: vla-eval: SUITE_aggregate.json for each suite; lerobot: eval_info.json; csv, parquet: a row a run, with
            metrics, costs and configuration; latex: a row a method, means over seeds with 95 % intervals.
        out: Folder of the files (default: the evaluation's, or the working directory).
    """
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.exports import export_lerobot, export_vla_eval

    if format in ("csv", "latex", "parquet"):
        from lifelong.report.export import export_runs

        print(
            export_runs(results, format, (out or Path()) / f"runs.{'tex' if format == 'latex' else format}")
        )
        return
    if len(results) > 1:
        raise ConfigError(f"--as {format} takes one evaluation, not {len(results)}")
    content, path = EvaluationResult.read(results[0]), Path(results[0])
    write = {"vla-eval": export_vla_eval, "lerobot": export_lerobot}[format]
    print(*write(content, out or (path if path.is_dir() else path.parent)), sep="\n")


def _question(options: PowerOptions) -> "Question":
    from lifelong.stats.power import Question, discordance_of

    usual = _observed(options.results) if options.results else (0.9, 0.03, None)
    base = usual[0] if options.base is None else options.base
    gap = usual[1] if options.difference is None else options.difference
    discordance = usual[2] if options.discordance is None else options.discordance
    if gap > 0 and base + gap > 1:
        raise ConfigError(
            f"--base {base:g} and --difference {gap:g} give a success of {base + gap:g}, above 1"
        )
    if options.correlation is not None:
        discordance = discordance_of(base, gap, options.correlation)
    return Question(base, gap, discordance, options.power, options.alpha, options.tests)


def _observed(words: Sequence[str]) -> tuple[float, float, float]:
    """Return the success of the first of two results, the second's minus it, and their discordance."""
    from libero_eval.judging.comparability import match
    from lifelong.stats.episodes import count

    if len(words) != 2:
        raise ConfigError(f"libero power takes two results, not {len(words)}")
    pairs = match(*_single_groups(words)).pairs
    counts = count(pairs)
    first, second = float(pairs.first.mean()), float(pairs.second.mean())
    print(
        f"observed in {counts.pairs} pairs: success {100 * first:.1f} % and {100 * second:.1f} %, "
        f"discordance {counts.discordant / counts.pairs:.3f}"
    )
    return first, second - first, counts.discordant / counts.pairs


def _single_groups(words: Sequence[str]) -> "list[Group]":
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.comparability import Group

    split = [_named(w) for w in words]
    labels = _labels([path for _, path in split])
    return [
        Group(name or label, (EvaluationResult.read(path),), (path,))
        for (name, path), label in zip(split, labels, strict=True)
    ]


def _group(words: Sequence[str]) -> "Group":
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.comparability import Group

    if len(words) < 2:
        raise ConfigError(f"--group {' '.join(words)}: write --group NAME RESULT RESULT ...")
    return Group(words[0], tuple(EvaluationResult.read(w) for w in words[1:]), tuple(words[1:]))


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
