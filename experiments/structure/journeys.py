"""What share of the benchmark's core two journeys run: environments, and a demonstration that is recorded and read.

    python experiments/structure/journeys.py

What numba compiles counts as not run.
"""

import argparse
import ast
import sys
import tempfile
import threading
from collections import defaultdict
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

import numpy as np
from measure import rooms

ROOT = Path(__file__).parents[2]
PACKAGE = f"{ROOT / 'libero_env'}/"
ran: dict[str, set[int]] = defaultdict(set)


def look(frame: FrameType, event: str, argument: Any) -> Any:
    """Note the lines that run in files of the package."""
    file = frame.f_code.co_filename
    if not file.startswith(PACKAGE):
        return None
    ran[file].add(frame.f_lineno)
    return look


def statements(path: Path) -> set[int]:
    """Return the lines on which statements begin that the interpreter runs, without docstrings."""
    text, lines = path.read_text(encoding="utf-8"), set[int]()

    def visit(code: CodeType) -> None:
        lines.update(line for _, _, line in code.co_lines() if line)
        for one in code.co_consts:
            if isinstance(one, CodeType):
                visit(one)

    visit(compile(text, str(path), "exec"))
    nodes = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt)]
    texts = {n.lineno for n in nodes if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)}
    return lines & {node.lineno for node in nodes} - texts


def environments() -> None:
    """Build five tasks, reset from stored and new states, step, restore a state; step two side by side."""
    from libero_env import BatchEnv, LiberoEnv

    for task in ("libero_spatial/0", "libero_object/3", "libero_goal/0", "libero_goal/7", "libero_10/2"):
        with LiberoEnv(task, camera_size=(32, 32)) as env:
            env.reset(seed=0)
            env.reset(options={"init_state": 1})
            env.step(np.full(7, 0.1))
            env.set_state(env.get_state())
    with BatchEnv("libero_goal/0", 2, camera_size=(32, 32)) as envs:
        envs.reset(options={"init_state": [0, 1]})
        envs.step(np.zeros((2, 7)))


def demonstrations() -> None:
    """Record a demonstration and read it."""
    from libero_env import ensure_demos, get_task, read_demos

    with tempfile.TemporaryDirectory() as folder:
        task, size = get_task("libero_object/0"), (32, 32)
        (path,) = ensure_demos([task], 1, camera_size=size, root=folder, workers=1, progress=False)
        read_demos(path)


def main() -> None:
    """Print the share of core, and of each room, that ran."""
    threading.settrace(look)
    sys.settrace(look)
    environments()
    demonstrations()
    sys.settrace(None)
    counts: dict[str, list[int]] = {}
    for path in (ROOT / "libero_env").rglob("*.py"):
        name = str(path.relative_to(ROOT))
        kind = next((room for room in rooms(ROOT) if name.startswith(f"{room}/")), "core of libero_env")
        all_of, run = statements(path), ran[str(path)]
        found = counts.setdefault(kind, [0, 0])
        found[0] += len(all_of & run)
        found[1] += len(all_of)
    for kind, (run_here, total) in sorted(counts.items()):
        print(f"{kind}: {run_here} of {total} statements = {100 * run_here / total:.0f} %")


if __name__ == "__main__":
    argparse.ArgumentParser(description="Measure what share of the core two journeys run.").parse_args()
    main()
