"""Scripts of experiments are run by hand: that what they import from the project is still there is checked here."""

import argparse
import ast
import importlib
import importlib.util
import json
import lzma
import re
import runpy
import shlex
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from lifelong.results.log import ResultLog
from lifelong.results.records import from_line
from lifelong.stats.metrics import metric_values, other_conventions

EXPERIMENTS = Path(__file__).parents[1] / "experiments"
SCRIPTS = sorted(EXPERIMENTS.rglob("*.py"))
PACKAGES = ("libero", "libero_cli", "libero_env", "libero_eval", "lifelong")
# of extras, and of environments in which some scripts are run
FOREIGN = (
    "coverage", "easydict", "gymnasium", "liberoplus", "robomimic", "robosuite", "tests", "torchrl", "warp",
    "websocket_policy_server",
)  # fmt: skip
# started by another script, with arguments in order, in an environment without the project
WORKERS = ("original_training.py", "original_worker.py", "robomimic_loader.py")
COMMANDS = [p for p in SCRIPTS if "__main__" in p.read_text(encoding="utf-8") and p.name not in WORKERS]
RECORDS = EXPERIMENTS / "algorithms" / "records"
PAGES = sorted(RECORDS.parent.glob("*/comparison.json"))


def imported(tree: ast.AST) -> Iterator[tuple[str, str | None]]:
    """Yield (module, name) of every import and of `-m`, wherever it stands; name is None where it is the module."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)
        elif isinstance(node, ast.List):  # perhaps a command line
            words = [part.value if isinstance(part, ast.Constant) else None for part in node.elts]
            for flag, module in pairwise(words):
                if flag == "-m" and str(module).partition(".")[0] in PACKAGES:
                    found = importlib.util.find_spec(str(module))
                    yield str(module), "__main__" if found and found.submodule_search_locations else None


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
    assert modules & {"argparse", "hydra"}, f"{script} starts its work on --help; parse its arguments"


def printed(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield (script, words behind it) of each command of a page that runs a script of the experiments."""
    text = page.read_text(encoding="utf-8").replace("\\\n", " ")
    blocks = re.findall(r"(?m)^ {4,}(.*)$", text) + re.findall(r"`([^`]*)`", text)
    for command in (block for block in blocks if re.search(r"python\S* experiments/\S+\.py", block)):
        words = shlex.split(re.sub(r"[;&|].*|[\[\]]", "", command), comments=True)
        at = next(i for i, word in enumerate(words) if word.startswith("experiments/"))
        found = [sorted(EXPERIMENTS.parent.glob(word)) if "*" in word else [word] for word in words[at + 1 :]]
        yield words[at], [str(f).removeprefix(f"{EXPERIMENTS.parent}/") for files in found for f in files]


PRINTED = sorted({(script, *words) for page in EXPERIMENTS.rglob("*.md") for script, words in printed(page)})
PARSED = [  # prose names expert_here.py without its words
    (script, *words)
    for script, *words in PRINTED
    if "argparse" in (EXPERIMENTS.parent / script).read_text() and (words or "expert_here" not in script)
]
# what reads committed files, or none, and the words that make it short; where there are several, the last holds
SHORT = {
    "algorithms/along.py": (),
    "algorithms/frontier.py": ("--check",),
    "algorithms/recompute.py": (),
    "algorithms/table.py": ("--check",),  # the README's tables are those of the records
    "comparisons/sampled_cells.py": ("--draws", "1", "--tasks", "11", "--shares", "0.3"),
    "comparisons/transfer.py": ("--simulations", "2"),
    "expert/summary.py": (),
}


class Parsed(Exception):
    """The words of a command are accepted."""


@pytest.mark.parametrize("command", PARSED, ids=" ".join)
def test_a_script_accepts_the_words_that_a_page_prints(command, monkeypatch):
    script, *words = command
    tree = ast.parse((EXPERIMENTS.parent / script).read_text(encoding="utf-8"))
    for package in {module.split(".")[0] for module, _ in imported(tree)} & {*FOREIGN}:
        pytest.importorskip(package)

    plain = argparse.ArgumentParser.parse_args, argparse.ArgumentParser.parse_known_args

    def parse(self, *args, **known):  # the former calls the latter
        with monkeypatch.context() as back:
            back.setattr(argparse.ArgumentParser, "parse_known_args", plain[1])
            raise Parsed(plain[0](self, *args, **known))

    def parse_known(self, *args, **known):
        raise Parsed(plain[1](self, *args, **known))

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr(argparse.ArgumentParser, "parse_known_args", parse_known)
    monkeypatch.setattr(sys, "argv", [script, *words])
    monkeypatch.setattr(sys, "path", [str((EXPERIMENTS.parent / script).parent), *sys.path])
    with pytest.raises(Parsed):
        runpy.run_path(str(EXPERIMENTS.parent / script), run_name="__main__")


ONE_BY_ONE = """
import json, runpy, sys
for sys.argv in json.loads(sys.argv[1]):
    sys.path.insert(0, sys.argv[0].rpartition("/")[0])
    try:
        runpy.run_path(sys.argv[0], run_name="__main__")
    except SystemExit as ended:
        assert not ended.code, (sys.argv, ended, "or its page has other numbers")
"""


def run_one_by_one(*commands: list[str]) -> None:
    """Run scripts in one process: they read the same records, of configurations that take long to compose."""
    command = [sys.executable, "-c", ONE_BY_ONE, json.dumps(commands)]
    done = subprocess.run(command, cwd=EXPERIMENTS.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def shortened(folder: str) -> list[list[str]]:
    """Return the first printed command of each script of a folder, with the words that make it short."""
    found = []
    for script, more in SHORT.items():
        if script.startswith(folder):
            words = next(words for name, *words in PRINTED if name == f"experiments/{script}")
            found.append([f"experiments/{script}", *words, *more])
    return found


@pytest.mark.slow
@pytest.mark.parametrize("folder", sorted({name.partition("/")[0] for name in SHORT} - {"algorithms"}))
def test_printed_commands_that_read_what_is_committed_run(folder):
    run_one_by_one(*shortened(folder))


@pytest.mark.slow
def test_commands_of_the_study_run_and_its_archive_is_read_by_what_is_in_it(tmp_path):
    archive = ["experiments/algorithms/archive.py", str(tmp_path / "study.zip"), "--runs", str(tmp_path)]
    run_one_by_one(*shortened("algorithms"), archive)
    zipfile.ZipFile(tmp_path / "study.zip").extractall(tmp_path)
    told = subprocess.check_output([sys.executable, "-I", "read.py"], cwd=tmp_path, text=True)
    found = {line.split()[0]: line.split()[1:] for line in told.splitlines()}
    for name, told in found.items():
        record = json.loads((tmp_path / "records" / f"{name}.json").read_text())["records"]
        (tmp_path / "results.jsonl").write_text(record)
        scores = ResultLog(tmp_path / "results.jsonl").read().scores()
        assert float(told[1]) == pytest.approx(other_conventions(scores.matrix)["bwt"], abs=6e-4)
        assert float(told[5]) == pytest.approx(metric_values(scores)["nbt"], abs=6e-4, nan_ok=True)
    assert found


def test_what_is_held_out_is_not_learned():
    learn = runpy.run_path(str(EXPERIMENTS / "laptop" / "learn.py"))["learn"]
    learn.__globals__["find_demos"] = None  # nothing is read or recorded
    with pytest.raises(SystemExit, match="data.demos=80 and 30 held out are more than --demos 109"):
        learn([], "libero_object", 0, 1, 109)


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


def test_records_of_the_study_are_of_todays_configuration(monkeypatch, tmp_path):
    """Otherwise its report would leave them out as missing."""
    script = RECORDS.parent / "study.py"
    spec = importlib.util.spec_from_file_location("study", script)
    study = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "study", study)
    spec.loader.exec_module(study)
    every = (*study.planned(), *study.planned(study.EARLIER))
    kept = [run for run in every if run.record.exists()]
    for one in {run.study.name: run for run in kept}.values():
        assert one.is_done()
        results = ResultLog(one.unpack(tmp_path) / "results.jsonl").read()
        assert results.learned_tasks() == len(results.run.tasks)  # measured in the cells that it says
        monkeypatch.setitem(one.config["data"], "demos", None)  # which the record names
        assert not one.is_done()
    assert kept
