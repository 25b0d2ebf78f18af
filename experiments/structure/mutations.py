"""Change lines of the code one at a time, and see whether a test that runs the line fails.

    pip install coverage
    export PYTHONPATH=experiments/structure LINES=lines
    python -m pytest -p mutations -n 2                          # which tests run which lines: lines/*.jsonl
    python experiments/structure/mutations.py lines --out found.jsonl
    python experiments/structure/mutations.py lines --out found.jsonl --missed-by OTHER  # by tests of a checkout

Of the lines that tests run a sample is drawn, and of each line a mutation: another comparison, operator or constant, a
condition turned round, a value not returned, a call not made. The tests that run the line follow in a copy of the
checkout, quickest first and for a minute at most; a line that a fixture runs is answered for by the fixture's module.
What was tried stands in --out, and is not tried again. With --missed-by, these modules of another checkout's tests
follow on what was missed.
"""

import argparse
import ast
import collections
import functools
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from measure import PACKAGES

ROOT = Path(__file__).parents[2]
SECONDS = 60  # of tests that follow a mutation; what takes five times as long does not end
COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
OPERATED = {ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("lines", type=Path)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--missed-by", type=Path, metavar="CHECKOUT")
    args = parser.parse_args()
    runs, seconds = read(args.lines)
    records = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    done = {(r["file"], r["at"], r["change"]): r["by"] for r in records}
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder), args.missed_by or ROOT)
        for file, at, change in sample(runs, random.Random(args.seed), args.count):
            tests = quickest(runs[file][at], seconds)
            if args.missed_by:
                if done.get((file, at, change), "none"):
                    continue
                tests = [t for t in dict.fromkeys(t.partition("::")[0] for t in tests) if (copy / t).exists()]
            elif (file, at, change) in done:
                continue
            by = found(copy, file, at, change, tests)
            print(f"{file}:{at}: {change}: {by}", flush=True)
            if not args.missed_by:
                done[file, at, change] = by
                with args.out.open("a") as out:
                    out.write(json.dumps({"file": file, "at": at, "change": change, "by": by}) + "\n")
    if not args.missed_by:
        print(f"{sum(map(bool, done.values()))} of {len(done)} mutations are found")


def read(folder: Path) -> tuple[dict[str, dict[int, set[str]]], dict[str, float]]:
    """Return file -> line -> tests that run it, and the seconds that each test takes."""
    runs: dict[str, dict[int, set[str]]] = collections.defaultdict(lambda: collections.defaultdict(set))
    seconds: dict[str, float] = collections.Counter()
    for line in itertools.chain.from_iterable(map(open, sorted(folder.glob("*.jsonl")))):
        phase = json.loads(line)
        name = phase["id"] if phase["phase"] == "call" else phase["id"].partition("::")[0]
        seconds[name] += phase["wall"]
        for path, numbers in phase["lines"].items():
            for number in numbers if path.endswith(".py") else ():  # and not of a page's template
                runs[path][number].add(name)
    return runs, seconds


def sample(
    runs: dict[str, dict[int, set[str]]], rng: random.Random, count: int
) -> list[tuple[str, int, str]]:
    """Draw lines that tests run, each with one of its mutations."""
    lines = sorted((file, number) for file, numbers in runs.items() for number in numbers)
    rng.shuffle(lines)
    drawn: list[tuple[str, int, str]] = []
    for file, number in lines:
        if len(drawn) == count:
            break
        changes = sorted({change for change, _ in mutations((ROOT / file).read_text(), number)})
        if changes:
            drawn.append((file, number, rng.choice(changes)))
    return drawn


def quickest(tests: set[str], seconds: dict[str, float]) -> list[str]:
    """Return the quickest tests, one at least, that take `SECONDS` together."""
    names = sorted(tests, key=lambda name: (seconds[name], name))
    ends = itertools.accumulate(seconds[name] for name in names)
    return [name for name, end in zip(names, ends, strict=True) if name == names[0] or end < SECONDS]


def mutations(text: str, number: int) -> Iterator[tuple[str, str]]:
    """Yield the name of each mutation of a line with the text that has it."""
    functions = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef))
    inside: dict[Any, None] = {
        node: None for f in functions for statement in f.body for node in ast.walk(statement)
    }
    for node in inside:
        if getattr(node, "lineno", None) != number:
            continue
        for name, other in changed(node):
            yield f"{name} at {node.col_offset}", replaced(text, node, other)


def changed(node: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield names and texts of what may stand in place of a node."""
    match node:
        case ast.Compare(left=left, ops=[op, *more], comparators=values) if type(op) in COMPARED:
            yield "comparison", ast.unparse(ast.Compare(left, [COMPARED[type(op)](), *more], values))
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATED:
            yield "operator", ast.unparse(ast.BinOp(left, OPERATED[type(op)](), right))
        case ast.BoolOp(op=op, values=values):
            other = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield "and or", ast.unparse(ast.BoolOp(other, values))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            yield "not", ast.unparse(operand)
        case ast.Constant(value=bool() as value):
            yield "constant", str(not value)
        case ast.Constant(value=(int() | float()) as value):
            yield "constant", str(value + 1)
        case ast.Return(value=ast.expr()):
            yield "return", "return None"
        case ast.Expr(value=ast.Call()):
            yield "call", "pass"
        case ast.If() | ast.IfExp():
            yield "condition", ""


def replaced(text: str, node: Any, other: str) -> str:
    """Return the text with another one in place of a node; a condition is turned round."""
    if isinstance(node, ast.If | ast.IfExp):
        node, other = node.test, f"not ({ast.unparse(node.test)})"
    lines = [line.encode() for line in text.splitlines(keepends=True)]  # columns count bytes
    before = b"".join(lines[: node.lineno - 1]) + lines[node.lineno - 1][: node.col_offset]
    after = lines[node.end_lineno - 1][node.end_col_offset :] + b"".join(lines[node.end_lineno :])
    statement = isinstance(node, ast.stmt)
    return (before + (other if statement else f"({other})").encode() + after).decode()


def copied(folder: Path, other: Path) -> Path:
    """Copy what git knows of the checkout, with the tests of another one, and link what tests look for beside it."""
    copy = folder / "main"
    for checkout, part in ((ROOT, ""), (other, "tests/")):
        names = subprocess.run(
            ["git", "ls-files", "-z", "."], cwd=checkout, capture_output=True, text=True, check=True
        )
        for name in filter(None, names.stdout.split("\0")):
            if name.startswith("tests/") == bool(part) and (checkout / name).exists():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(checkout / name, copy / name)
    (folder / "shared").symlink_to(ROOT.parent / "shared")
    (copy / ".venv").symlink_to(ROOT / ".venv")
    return copy


def found(copy: Path, file: str, at: int, change: str, tests: list[str]) -> str | None:
    """Return the first test that fails with the mutation."""
    path = copy / file
    text = path.read_text()
    path.write_text(dict(mutations(text, at))[change])
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--no-header", "-p", "no:cacheprovider", *tests]
    try:
        run = subprocess.run(
            command,
            cwd=copy,
            capture_output=True,
            text=True,
            timeout=5 * SECONDS,
            env=os.environ | {"PYTHONPATH": str(copy)},
        )
        failed = [line for line in run.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        return failed[0].split()[1] if failed else None if run.returncode == 0 else f"exit {run.returncode}"
    except subprocess.TimeoutExpired:
        return "takes too long"
    finally:
        path.write_text(text)


def watch(phase: str) -> Callable:
    """Return a hook of pytest that writes the lines that a phase of each test runs."""

    @pytest.hookimpl(wrapper=True)
    def hook(item: Any) -> Iterator[None]:
        began, lines = time.perf_counter(), watched()
        for numbers in lines.values():
            numbers.clear()
        try:
            return (yield)
        finally:
            ran = {os.path.relpath(file, ROOT): sorted(numbers) for file, numbers in lines.items() if numbers}
            record = {"id": item.nodeid, "phase": phase, "wall": time.perf_counter() - began, "lines": ran}
            folder = Path(os.environ["LINES"])
            folder.mkdir(exist_ok=True)
            with (folder / f"{os.getpid()}.jsonl").open("a") as out:
                out.write(json.dumps(record) + "\n")

    return hook


@functools.cache
def watched() -> dict[str, set[int]]:
    """Begin to watch what runs, and return file -> lines that ran."""
    import coverage

    packages = [str(ROOT / package / "*") for package in PACKAGES]
    watcher = coverage.Coverage(data_file=None, include=packages, config_file=False)
    watcher.start()
    return watcher._collector.data


pytest_runtest_setup, pytest_runtest_call = watch("setup"), watch("call")

if __name__ == "__main__":
    main()
