"""Scripts of tasks: check them, and draw them."""

from pathlib import Path

from libero.libero.benchmark import libero_suites
from libero.scripts.command import script
from libero_cli.main import main as libero
from libero_env.cli.options import Positional, Positive, Side
from libero_env.errors import LiberoError


@script()
def check_task_suites(suites: Positional[tuple[str, ...]] = tuple(libero_suites)) -> int:
    """Check the tasks of the benchmark, and that their initial states exist, by `libero tasks lint`.

    Args:
        suites: Names of suites.
    """
    return libero(["tasks", "lint", *suites, "--starts", "0"])


@script()
def render_single_task(
    *,
    benchmark_name: str | None = None,
    task_id: int | None = None,
    bddl_file: str | None = None,
    num: Positive = 5,
    size: Side = 256,
    out: Path = Path("benchmark_tasks"),
) -> int:
    """Draw the initial states of a task by `libero tasks preview`.

    Args:
        benchmark_name: Such as libero_goal.
        task_id: Index of the task in the suite.
        bddl_file: Task file, instead of a task of a benchmark.
        num: Number of states.
        size: Size of each picture, pixels.
        out: Folder.
    """
    named = None if benchmark_name is None or task_id is None else f"{benchmark_name.lower()}/{task_id}"
    if (named is None) == (bddl_file is None) or (benchmark_name is None) != (task_id is None):
        raise LiberoError("which task? Pass --benchmark_name and --task_id, or --bddl_file")
    out.mkdir(parents=True, exist_ok=True)
    task = bddl_file or named or ""
    path = out / f"{Path(task).stem if bddl_file else task.replace('/', '_')}.png"
    words = ["--starts", str(num), "--size", str(size), "--cameras", "agentview", "--out", str(path)]
    return libero(["tasks", "preview", task, *words])
