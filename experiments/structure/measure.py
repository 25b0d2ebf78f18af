"""Measure the shape of the code: lines, files, functions, circles of imports, tests, documents, configurations.

    python experiments/structure/measure.py [CHECKOUT ...]

Imports are those of grimp (the library behind import-linter), inside functions and under TYPE_CHECKING included.
"""

import argparse
import ast
import io
import json
import re
import subprocess
import sys
import tokenize
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

PACKAGES = ("libero_cli", "libero_env", "lifelong", "libero_eval", "libero", "libero_integrations")
LONG = 40  # lines of a function

_GRAPH = """
import json, sys
import grimp
sys.path.insert(0, sys.argv[1])
graph = grimp.build_graph(*sys.argv[2:], cache_dir=None)
print(json.dumps({m: sorted(graph.find_modules_directly_imported_by(m)) for m in graph.modules}))
"""


def import_graph(checkout: Path) -> dict[str, list[str]]:
    """Return module -> modules it imports, read in a process of its own from this checkout."""
    command = [
        sys.executable,
        "-P",
        "-c",
        _GRAPH,
        str(checkout),
        *(p for p in PACKAGES if (checkout / p).is_dir()),
    ]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True, cwd="/").stdout)


def circles(graph: dict[str, list[str]]) -> list[set[str]]:
    """Return the sets of nodes that reach each other (Tarjan's strongly connected components of two or more)."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[set[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in graph.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            at = stack.index(node)
            if len(stack) - at > 1:
                found.append(set(stack[at:]))
            del stack[at:]

    for node in sorted(graph):
        if node not in index:
            visit(node)
    return found


def entries(graph: dict[str, list[str]], package: str) -> dict[str, list[str]]:
    """Return the import graph between what lies directly in a package."""
    depth = package.count(".") + 1

    def entry(module: str) -> str | None:
        inside = module.startswith(f"{package}.")
        return module.split(".")[depth] if inside else None

    found: dict[str, set[str]] = {}
    for module, imported in graph.items():
        if (own := entry(module)) is not None:
            others = {entry(other) for other in imported} - {None, own}
            found.setdefault(own, set()).update(others)  # type: ignore[arg-type]
    return {own: sorted(others) for own, others in found.items()}


def levels(graph: dict[str, list[str]]) -> int:
    """Return the length of the longest chain of imports, in which a circle counts once for each member."""
    member = {node: i for i, circle in enumerate(circles(graph)) for node in circle}
    group = {node: f"circle {member[node]}" if node in member else node for node in graph}
    size: dict[str, int] = {}
    below: dict[str, set[str]] = {}
    for node, others in graph.items():
        size[group[node]] = size.get(group[node], 0) + 1
        below.setdefault(group[node], set()).update(group[other] for other in others)
    height: dict[str, int] = {}

    def measure(node: str) -> int:
        if node not in height:
            height[node] = size[node] + max((measure(o) for o in below[node] - {node}), default=0)
        return height[node]

    return max(map(measure, below), default=0)


def sources(checkout: Path, package: str) -> Iterator[tuple[str, ast.Module]]:
    """Yield text and syntax tree of the files of a package."""
    for file in sorted((checkout / package).rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        yield text, ast.parse(text)


def long_functions(trees: Sequence[ast.Module]) -> tuple[int, int]:
    """Return how many functions are longer than `LONG` lines: whole, and without signature and docstring."""
    kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
    found = [node for tree in trees for node in ast.walk(tree) if isinstance(node, kinds)]
    whole = [n for n in found if _end(n) - n.lineno + 1 > LONG]
    body = [n for n in whole if _end(n) - _end(n.body[0]) * bool(ast.get_docstring(n)) - _first(n) > LONG]
    return len(whole), len(body)


def _end(node: ast.stmt) -> int:
    return node.end_lineno or node.lineno


def _first(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Return the line before the body, 0 where a docstring is subtracted anyway."""
    return 0 if ast.get_docstring(function) else function.body[0].lineno - 1


def code_lines(text: str, tree: ast.Module) -> int:
    """Return how many lines hold code: neither blank nor only a comment or a docstring."""
    silent = (
        tokenize.COMMENT,
        tokenize.NL,
        tokenize.NEWLINE,
        tokenize.INDENT,
        tokenize.DEDENT,
        tokenize.ENDMARKER,
    )
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in silent:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstring_lines(tree))


def docstring_lines(tree: ast.Module) -> set[int]:
    """Return the numbers of the lines that are docstrings."""
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    owners = [
        n for n in ast.walk(tree) if isinstance(n, kinds) and ast.get_docstring(n, clean=False) is not None
    ]
    return {line for n in owners for line in range(n.body[0].lineno, _end(n.body[0]) + 1)}


def functions(tree: ast.Module) -> int:
    """Return the number of functions and methods."""
    return sum(isinstance(n, (ast.FunctionDef, ast.AsyncFunctionDef)) for n in ast.walk(tree))


def words(files: Iterable[Path]) -> int:
    """Return the number of words of text files."""
    return sum(len(re.findall(r"\S+", file.read_text(encoding="utf-8"))) for file in files)


def exempt_modules(checkout: Path) -> int:
    """Return how many modules mypy leaves out."""
    overrides = tomllib.loads((checkout / "pyproject.toml").read_text())["tool"]["mypy"]["overrides"]
    return sum(len(o["module"]) for o in overrides if o.get("ignore_errors"))


def rooms(checkout: Path) -> list[str]:
    """Return the folders that no core module may import: what the contracts protect."""
    tool = tomllib.loads((checkout / "pyproject.toml").read_text())["tool"]["importlinter"]
    named = [name for contract in tool["contracts"] for name in contract.get("protected_modules", ())]
    return [name.replace(".", "/") for name in named]


def measure(checkout: Path) -> dict[str, str]:
    """Return the figures of a checkout."""
    graph, figures = import_graph(checkout), {}
    for package in (*(p for p in PACKAGES if (checkout / p).is_dir()), "libero_env.expert"):
        own = entries(graph, package)
        inside = sum(
            len({*others} & circle) for circle in circles(own) for n, others in own.items() if n in circle
        )
        figures[package] = (
            f"{len(own)} entries, {levels(own)} levels, {sum(map(len, own.values()))} imports between them, "
            f"{inside} of them in circles"
        )
    figures["circles of modules"] = str(len(circles(graph)))
    present = [package for package in PACKAGES if (checkout / package).is_dir()]
    read = {package: list(sources(checkout, package)) for package in present}
    for name, count in {
        "code lines": lambda text, tree: code_lines(text, tree),
        "files": lambda text, tree: 1,
        "functions": lambda text, tree: functions(tree),
        "raw lines": lambda text, tree: text.count("\n"),
        "lines of docstrings": lambda text, tree: len(docstring_lines(tree)),
    }.items():
        each = {package: sum(count(*file) for file in files) for package, files in read.items()}
        figures[name] = f"{sum(each.values())}: " + ", ".join(f"{k} {v}" for k, v in each.items())
    apart = {
        room: sum(code_lines(text, tree) for text, tree in sources(checkout, room))
        for room in rooms(checkout)
    }
    for package in present:
        own = {k: v for k, v in apart.items() if k.startswith(f"{package}/")}
        if own:
            core = sum(code_lines(*file) for file in read[package]) - sum(own.values())
            each_room = ", ".join(f"{room.rpartition('/')[2]} {lines}" for room, lines in own.items())
            figures[f"core of {package}"] = f"{core}, and in rooms {sum(own.values())}: {each_room}"
    tests = list((checkout / "tests").rglob("*.py"))
    figures["raw lines of tests"] = str(sum(f.read_text(encoding="utf-8").count("\n") for f in tests))
    guide = [checkout / "README.md", checkout / "CONTRIBUTING.md", *(checkout / "docs").glob("*.md")]
    figures["words of documents"] = str(words(guide))
    figures["files of configuration"] = str(sum(f.is_file() for f in (checkout / "configs").rglob("*")))
    trees = [tree for files in read.values() for _, tree in files]
    whole, bodies = long_functions(trees)
    figures[f"functions over {LONG} lines"] = f"{whole}, {bodies} of them without signature and docstring"
    figures["modules exempt from mypy"] = str(exempt_modules(checkout))
    skipped = sum(
        file.read_text(encoding="utf-8").count("# fmt: " + "skip")
        for folder in (*present, "tests", "experiments")
        for file in (checkout / folder).rglob("*.py")
    )
    figures["lines that the formatter skips"] = str(skipped)
    return figures


def main() -> None:
    """Print the figures of one checkout, or of several side by side."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkouts", nargs="*", type=Path, default=[Path(__file__).parents[2]])
    for checkout in parser.parse_args().checkouts:
        print(checkout)
        for name, value in measure(checkout.resolve()).items():
            print(f"  {name:32} {value}")


if __name__ == "__main__":
    main()
