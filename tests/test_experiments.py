"""Scripts of experiments are run by hand: that what they import from the project is still there is checked here."""

import ast
import importlib
import importlib.util
import json
import lzma
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from lifelong.results.records import from_line

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SCRIPTS = sorted(EXPERIMENTS.rglob("*.py"))
PACKAGES = ("libero", "libero_env", "libero_eval", "lifelong")
# of extras, and of environments in which some scripts are run
FOREIGN = (
    "easydict", "gymnasium", "liberoplus", "robomimic", "robosuite", "tests", "warp", "websocket_policy_server"
)  # fmt: skip
# started by another script, with arguments in order, in an environment without the project
WORKERS = ("original_training.py", "original_worker.py", "robomimic_loader.py")
COMMANDS = [p for p in SCRIPTS if "__main__" in p.read_text(encoding="utf-8") and p.name not in WORKERS]
RECORDS = EXPERIMENTS / "algorithms" / "records"
PAGES = sorted(RECORDS.parent.glob("*/comparison.json"))


def imported(tree: ast.AST) -> Iterator[tuple[str, str | None]]:
    """Yield (module, name) of every import, wherever it stands; name is None where a module is imported."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def top_level_names(path: Path) -> set[str]:
    """Return what a script defines or imports."""
    found: set[str] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        for part in ast.walk(node):
            if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                found.add(part.id)
            elif isinstance(part, ast.FunctionDef | ast.ClassDef):
                found.add(part.name)
            elif isinstance(part, ast.alias):
                found.add(part.asname or part.name)
    return found


def exists(module: str, name: str | None) -> bool:
    """Return whether an import from the project would work."""
    try:
        found = importlib.import_module(module)
    except ModuleNotFoundError as error:
        return not (error.name or "").startswith(PACKAGES)  # an extra that is not installed tells nothing
    if name is None or hasattr(found, name):
        return True
    return importlib.util.find_spec(f"{module}.{name}") is not None if hasattr(found, "__path__") else False


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(EXPERIMENTS)))
def test_what_a_script_imports_exists(script):
    missing = []
    for module, name in imported(ast.parse(script.read_text(encoding="utf-8"))):
        package, beside = module.split(".")[0], script.with_name(f"{module}.py")
        if beside.is_file():
            found = name is None or name in top_level_names(beside)
        elif package in PACKAGES:
            found = exists(module, name)
        else:
            found = importlib.util.find_spec(package) is not None or package in FOREIGN
        if not found:
            missing.append(f"{module}.{name}" if name else module)
    assert not missing, f"{script} imports what does not exist: {', '.join(missing)}"


@pytest.mark.parametrize("script", COMMANDS, ids=lambda path: str(path.relative_to(EXPERIMENTS)))
def test_a_script_explains_itself_and_does_not_start_when_asked_for_help(script):
    modules = {module for module, _ in imported(ast.parse(script.read_text(encoding="utf-8")))}
    assert modules & {"argparse", "hydra"}, (
        f"{script} starts its work on --help; parse its arguments, even if none"
    )


def test_what_is_held_out_is_not_learned():
    spec = importlib.util.spec_from_file_location("learn", EXPERIMENTS / "laptop" / "learn.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    script.find_demos = None  # nothing is read or recorded
    with pytest.raises(SystemExit, match="data.demos=80 and 30 held out are more than --demos 109"):
        script.learn([], "libero_object", 0, 1, 109)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.parent.name)
def test_a_page_of_the_study_is_of_all_its_records(page):
    groups = json.loads(page.read_text(encoding="utf-8"))["groups"].values()
    named = {run for group in groups for run in group["runs"]}
    files = (RECORDS / page.parent.name).rglob("*.json.xz")
    kept = {file.relative_to(RECORDS).as_posix().removesuffix(".json.xz") for file in files}
    for run in kept:  # what was kept is read today
        content = json.loads(lzma.decompress((RECORDS / f"{run}.json.xz").read_bytes()))
        assert from_line(content["records"].encode().partition(b"\n")[0]).seed == int(run[-1])
    assert named == kept, "the page is outdated: experiments/algorithms/study.py report writes it again"


def test_records_of_the_study_are_of_todays_configuration(monkeypatch):
    """Otherwise its report would leave them out as missing."""
    script = RECORDS.parent / "study.py"
    spec = importlib.util.spec_from_file_location("study", script)
    study = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "study", study)
    spec.loader.exec_module(study)
    kept = [run for run in study.planned() if run.record.exists()]
    for one in {run.study.name: run for run in kept}.values():
        assert one.is_done()
        monkeypatch.setitem(one.config["data"], "demos", None)  # which the record names
        assert not one.is_done()
    assert kept
