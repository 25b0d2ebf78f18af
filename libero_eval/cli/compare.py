"""`libero compare`, `libero power` and `libero results`: is a policy better, and what do others read of its results."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from libero_env.cli.ending import UNDECIDED
from libero_env.cli.options import Answer, Field, FilePath, Positional, Probability, Share, arg
from libero_env.doors import enter
from libero_env.storage import files_below
from lifelong.errors import ConfigError

if TYPE_CHECKING:
    from libero_eval.judging.comparability import Group

_Signed = Annotated[float, Field(ge=-1, le=1)]


def compare(
    results: Positional[tuple[str, ...]] = (),
    *,
    group: tyro.conf.UseAppendAction[tuple[tuple[str, ...], ...]] = (),
    control: tuple[str, str] | None = None,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    alpha: Probability = 0.05,
    tasks: bool = False,
    gate: Share | None = None,
    published: str | None = None,
    out: FilePath | None = None,
) -> Answer:
    """Say whether evaluated policies differ, start by start, and what chance alone makes.

    Args:
        results: Files eval.json or their folders; NAME=RESULT names one in the tables.
        group: NAME RESULT...: results of several runs of one method, such as training seeds; give it once for each
            method.
        control: One policy evaluated twice, with different seeds.
        allow: Compare although this setting differs, such as protocol.episode.horizon, environment.robot or tasks.
        alpha: Probability of a false difference.
        tasks: Show every task in the terminal.
        gate: Say whether the second result is worse than the first by more than this difference in success, such as
            0.05. The exit status is 1 for a regression, 3 where these episodes do not decide it.
        published: Compare one result with the success that is published of this policy, such as pi05 (all of them are
            in docs/known-answers.md), by counts instead of starts. The exit status is 1 where they contradict it.
        out: Folder for compare.html and compare.json.
    """
    if published is not None:
        if len(results) != 1 or group or control or allow or tasks or gate is not None or out:
            raise ConfigError(
                "--published is of one result; besides, only --alpha, --json and --open can be given"
            )
        return _against_published(results[0], published, alpha)
    groups = [*_single_groups(results), *(_group(words) for words in group)]
    first_twice = _single_groups(control) if control else None
    from libero_eval.judging.comparison import compare_groups, write_comparison
    from libero_eval.judging.comparison import gate as judge
    from libero_eval.judging.page import gate_text, render, write_page

    pair = (first_twice[0], first_twice[1]) if first_twice else None
    comparison = compare_groups(groups, control=pair, allow=allow, alpha=alpha)
    lines, status, page = [render(comparison, tasks=tasks)], 0, None
    found = None if gate is None else judge(comparison, gate)
    if found:
        lines += ["", gate_text(found, comparison)]
        status = {"regression": 1, "no regression": 0, "undecided": UNDECIDED}[found.verdict]
    if out:
        lines += ["", str(write_comparison(comparison, out / "compare.json", found))]
        page = write_page(comparison, out / "compare.html")
    return Answer("\n".join(lines), comparison.to_plain(found), page, status)


def _against_published(word: str, name: str, alpha: float) -> Answer:
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.published import agreement, render

    found, notes = agreement(EvaluationResult.read(named(word)[1]), name)
    data = {"published": name, "suites": [asdict(row) for row in found], "conditions": notes}
    status = int(any(row.adjusted <= alpha for row in found))
    return Answer(render(found, notes, name, alpha), data, status=status)


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
    if options.discordance is not None and options.correlation is not None:
        raise ConfigError("--correlation stands for --discordance; give one of them")
    if options.episodes and options.difference is not None:
        raise ConfigError("--episodes asks which difference is shown; leave --difference out")
    of_one = options.difference is not None or options.results or options.episodes
    if not of_one and (options.discordance is not None or options.correlation is not None):
        raise ConfigError(
            "--discordance and --correlation are of one case; name it with --difference or --episodes"
        )
    base, gap, discordance = _observed(options.results) if options.results else (0.9, None, None)
    from libero_eval.judging import power_text
    from libero_eval.stats.power import Question, discordance_of

    base = base if options.base is None else options.base
    gap = gap if options.difference is None else options.difference
    discordance = discordance if options.discordance is None else options.discordance
    levels: dict[str, Any] = {"power": options.power, "alpha": options.alpha, "tests": options.tests}
    if options.episodes or gap is None:
        question = Question(base, -base / 1000, **levels)
        if options.episodes:
            pairs = {"discordance": discordance, "correlation": options.correlation}
            print(power_text.shown(question, options.episodes, **pairs))
        else:
            print(power_text.table(question))
        return
    if gap > 0 and base + gap > 1:
        raise ConfigError(
            f"--base {base:g} and --difference {gap:g} give a success of {base + gap:g}, above 1"
        )
    if options.correlation is not None:
        discordance = discordance_of(base, gap, options.correlation)
    print(power_text.answer(Question(base, gap, discordance, **levels)))


def board(
    results: Positional[Annotated[tuple[str, ...], Field(min_length=1)]],
    *,
    allow: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    alpha: Probability = 0.05,
    out: FilePath = Path("board.html"),
) -> Answer:
    """Rank evaluated policies on a page: success with intervals, tiers by paired tests, commands that run them again.

    Args:
        results: Files eval.json, or folders, for all such files in them that can be compared (those of robustness left
            out); NAME=RESULT names one. Results of one policy on other tasks make one row.
        allow: Rank although this setting differs, such as protocol.episode.horizon or environment.robot; starts: rank
            by the episodes that all have.
        alpha: Probability of a false difference among all pairs.
        out: The page, or a folder for it.
    """
    words = [(word, given) for given in results for word in _results_in(given)]
    entries = _single_groups([word for word, _ in words], by_name=True)
    searched = [
        word != given and Path(named(word)[1]) != Path(named(given)[1], "eval.json") for word, given in words
    ]
    from libero_eval.judging.board import alike, make_board, render_board, write_board

    entries, notes = alike(entries, searched, allow)
    found = make_board(entries, allow, alpha)
    found = replace(found, notes=(*found.notes, *notes))
    return Answer(render_board(found), asdict(found), write_board(found, entries, out))


def _results_in(word: str) -> list[str]:
    """Return the results that a word names: all files eval.json in a folder."""
    name, path = named(word)
    if not Path(path).is_dir():
        return [word]
    files = sorted(
        file for file in files_below(Path(path), "eval.json") if "conditions" not in file.parts[:-1]
    )
    if not files:
        raise ConfigError(
            f"{path} holds no evaluation: there is no eval.json in it; `libero eval` writes one"
        )
    return [f"{name}={file}" if name else str(file) for file in files]


def export(
    results: Positional[Annotated[tuple[str, ...], Field(min_length=1)]],
    *,
    format: Annotated[
        Literal["vla-eval", "lerobot", "eval-results", "csv", "latex", "parquet"], arg(name="as")
    ],
    dataset: str = "",
    source: str = "",
    partial: bool = False,
    out: FilePath | None = None,
) -> None:
    """Write an evaluation as another tool's result file, or runs as a table, and print the files.

    Args:
        results: A file eval.json or its folder; for a table runs, folders of runs, or patterns.
        format: vla-eval: SUITE_aggregate.json for each suite; lerobot: eval_info.json; eval-results:
            .eval_results/SUITE.yaml, which the Hugging Face Hub shows on the model's page; csv, parquet: a row a run,
            with metrics, costs and configuration; latex: a row a method, means over seeds with 95 % intervals.
        dataset: With eval-results: the benchmark's data set on the Hub, ORG/NAME.
        source: With eval-results: address of where the result is from, such as a repository with eval.json.
        partial: With eval-results: write a part of a suite, or of a protocol's episodes, too; its notes say so.
        out: Folder of the files (default: the evaluation's, or the working directory).
    """
    from libero_eval.evaluation_file import EvaluationResult

    if (dataset or source or partial) and format != "eval-results":
        raise ConfigError(f"--dataset, --source and --partial are of --as eval-results, not of --as {format}")
    if format in ("csv", "latex", "parquet"):
        from lifelong.report.export import export_runs

        print(
            export_runs(results, format, (out or Path()) / f"runs.{'tex' if format == 'latex' else format}")
        )
        return
    if len(results) > 1:
        raise ConfigError(f"--as {format} takes one evaluation, not {len(results)}")
    content, path = EvaluationResult.read(results[0]), Path(results[0])
    folder = out or (path if path.is_dir() else path.parent)
    written = enter("exports", "results")(content, folder, format, dataset, source, partial=partial)
    print(*written, sep="\n")


def _observed(words: Sequence[str]) -> tuple[float, float | None, float | None]:
    """Return the success of the first of two results, the second's minus it, and their discordance."""
    if len(words) != 2:
        raise ConfigError(f"libero power takes two results, not {len(words)}")
    groups = _single_groups(words)
    from libero_eval.judging.comparability import check_comparable, match
    from libero_eval.stats.episodes import count

    for note in check_comparable(groups, allow=("protocol", "environment", "tasks")):
        print(f"note: {note}")
    pairs = match(*groups).pairs
    counts = count(pairs)
    first, second = float(pairs.first.mean()), float(pairs.second.mean())
    print(
        f"observed in {counts.pairs} pairs: success {100 * first:.1f} % and {100 * second:.1f} %, "
        f"discordance {counts.discordant / counts.pairs:.3f}"
    )
    return first, second - first, counts.discordant / counts.pairs


def _single_groups(words: Sequence[str], *, by_name: bool = False) -> "list[Group]":
    """Return a group for each result: its label is the one that is given, or tells the paths apart.

    Args:
        words: Results, RESULT or NAME=RESULT.
        by_name: Whether the name that its evaluation gave to the policy goes before the path.
    """
    from libero_eval.evaluation_file import EvaluationResult

    split = [named(w) for w in words]
    labels = _labels([path for _, path in split])
    read = [EvaluationResult.read(path) for _, path in split]
    from libero_eval.judging.comparability import Group

    groups = []
    for (name, path), label, result in zip(split, labels, read, strict=True):
        stated = result.evaluated.get("name") if by_name else None
        groups.append(Group(str(name or stated or label), (result,), (path,)))
    return groups


def _group(words: Sequence[str]) -> "Group":
    from libero_eval.evaluation_file import EvaluationResult
    from libero_eval.judging.comparability import Group

    if len(words) < 2:
        raise ConfigError(f"--group {' '.join(words)}: write --group NAME RESULT RESULT ...")
    return Group(words[0], tuple(EvaluationResult.read(w) for w in words[1:]), tuple(words[1:]))


def named(word: str) -> tuple[str | None, str]:
    """Return the name, if one is given, and the path of a word NAME=PATH or PATH; paths may hold "=", too."""
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
