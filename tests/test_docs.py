"""README.md, CONTRIBUTING.md and docs/: what they show runs, what they name exists, and nothing is left out of them."""

import ast
import base64
import importlib.util
import inspect
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest
import torch
import yaml

from experiments.structure import measure
from libero._adapters.config import load_config
from libero_cli.main import ALL, bind, find, load, main
from libero_env.cli.options import options_of
from libero_env.envs.env import LiberoEnv
from libero_env.objects import catalog
from libero_env.tasks import Task
from libero_env.tasks.builder import build_problem
from libero_env.tasks.merging import load_scene
from lifelong.algorithms import Algorithm
from lifelong.composition import compose_run, swept

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
CONFIGS = ROOT / "configs"
PAGES = sorted(DOCS.glob("*.md"))
GUIDE = ROOT / "CONTRIBUTING.md"
GENERATED = ("commands.md", "configuration.md", "python.md")
NOT_RUN = r"<!-- not run: \S[^>]*-->\n+"  # before a block that is not, with the reason


@cache
def generate() -> ModuleType:
    """docs/generate.py, which no package holds."""
    spec = importlib.util.spec_from_file_location("docs_generate", DOCS / "generate.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.path.insert(0, str(DOCS))  # as MkDocs does
    spec.loader.exec_module(module)
    sys.path.remove(str(DOCS))
    return module


def text(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def blocks(page: Path, *languages: str) -> list[str]:
    """The blocks that are meant to be run."""
    found = re.findall(rf"({NOT_RUN})?^```({'|'.join(languages)})\n(.*?)^```", text(page), re.M | re.S)
    return [code for excuse, _, code in found if not excuse]


def lines(page: Path) -> Iterator[str]:
    """Command lines without comments, of blocks and of indented text."""
    indented = re.findall(r"^    (?! )(?:libero|python|torchrun|lifelong\.) .*$", text(page), re.M)
    for line in [*"".join(blocks(page, "sh")).splitlines(), *indented]:
        for part in line.split(" && "):
            words = shlex.split(part, comments=True)
            if words:
                yield shlex.join(words)


PYTHON = [
    pytest.param(page, code, id=f"{page.stem}-{i}")
    for page in [*PAGES, ROOT / "README.md"]
    for i, code in enumerate(blocks(page, "python"))
]


@pytest.mark.sim
@pytest.mark.parametrize(("page", "code"), PYTHON)
def test_python_blocks_run(page, code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LIBERO_CONFIG_PATH", str(tmp_path))
    monkeypatch.setenv("LIBERO_OBJECTS", str(tmp_path))
    monkeypatch.setattr(catalog, "_registered", {})
    exec(compile(code, str(page), "exec"), {"__name__": "shown"})  # noqa: S102


@pytest.mark.sim
def test_the_policy_of_the_guide_is_evaluated(tmp_path, monkeypatch, capsys):
    (code,) = blocks(DOCS / "evaluating.md", "python")
    (tmp_path / "my_policy.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    tiny = ["--suite", "libero_object/0", "--episodes", "2", "--horizon", "3", "--out", "eval/my_policy"]
    assert main(["eval", "my_policy:make", *tiny]) == 0
    assert "eval/my_policy/eval.json" in capsys.readouterr().out
    block = r"^```python\n(from libero_eval.evaluation_file.*?)^```"
    (reading,) = re.findall(block, text(DOCS / "evaluating.md"), re.M | re.S)
    exec(compile(reading, "evaluating.md", "exec"), {})  # noqa: S102
    assert "libero_object/0 Estimate(value=0.0" in capsys.readouterr().out
    (again,) = (line for line in lines(DOCS / "evaluating.md") if "my_policy/eval.json" in line)
    assert main(shlex.split(again)[1:]) == 0
    assert "eval/my_policy/again/eval.json" in capsys.readouterr().out
    assert main(["eval", "--status", "eval/my_policy"]) == 0
    assert "1 of 1 units, 2 of 2 episodes" in capsys.readouterr().out


def test_the_algorithm_of_the_guide():
    code, config = blocks(GUIDE, "python")[0], yaml.safe_load(blocks(GUIDE, "yaml")[0])
    names: dict = {}
    exec(compile(code, "l2.py", "exec"), names)  # noqa: S102
    assert config.pop("_target_").endswith(".l2.L2")
    algorithm = names["L2"](**config)
    policy = torch.nn.Linear(2, 2)
    assert algorithm.penalty(policy) is None
    algorithm.end_task(0, None, policy, torch.Generator())
    assert algorithm.penalty(policy).item() == 0
    with torch.no_grad():
        policy.bias += 1.0
    assert algorithm.penalty(policy).item() == pytest.approx(2 * config["strength"])
    resumed = names["L2"](**config)
    resumed.load_state_dict(algorithm.state_dict(), policy.state_dict())
    assert resumed.penalty(policy) == algorithm.penalty(policy)


@pytest.mark.sim
def test_the_object_and_the_task_of_the_guide(monkeypatch):
    monkeypatch.setattr(catalog, "_registered", {})
    exec(compile(blocks(GUIDE, "python")[1], "red_cube.py", "exec"), {})  # noqa: S102
    (facts,) = yaml.safe_load(blocks(GUIDE, "yaml")[1])
    problem = build_problem(load_scene(facts["scene"]), facts)
    env = LiberoEnv(Task("mine", 0, facts["name"], "pick it up", problem.language, problem), cameras=())
    env.reset(seed=1)
    assert list(problem.objects)[0] == "red_cube_1"
    assert not env.step(env.action_space.sample() * 0)[4]["success"]
    env.close()


@cache
def composes(*overrides: str) -> None:
    lists = swept(overrides)
    single = [word for word in overrides if word.split("=")[0] not in lists]
    for i in range(max(map(len, lists.values()), default=1)):  # of a sweep each value, not each job
        compose_run([*single, *(f"{key}={values[i % len(values)]}" for key, values in lists.items())])


def check_line(line: str) -> None:
    """Raise SystemExit or another error unless the program of a command line would take it."""
    words = shlex.split(line)
    if words[0] == "torchrun":
        words = ["python", *words[words.index("train.py") :]]
    if words[0].endswith("/python"):
        words[0] = "python"
    if words[:2] in (["python", "train.py"], ["libero", "train"]):
        overrides = [w for w in words[2:] if w not in ("-m", "--cfg", "job")]
        composes(*overrides)
    elif words[0].endswith("libero"):
        name = find(words[1:])
        bind(name, words[1 + len(name.split()) :])
    elif words[0] == "python":
        assert (ROOT / words[1]).is_file() or words[1] == "-m", line
    else:
        known = ("docker", "export", "git", "pip", "python3.11", ".venv/bin/pip", "source", "make", "uv")
        assert words[0] in known, line


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_command_lines_are_valid(page):
    for line in lines(page):
        try:
            check_line(line)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{page.name}: {line}") from error


def written() -> str:
    """All pages but those that are generated."""
    return "\n".join(text(page) for page in PAGES if page.name not in GENERATED)


def test_every_command_is_shown():
    assert not [name for name in ALL if not re.search(rf"\blibero {re.escape(name)}\b", written())]


def test_every_command_and_argument_is_in_the_reference():
    page = "".join(generate().command_reference().values())
    for name, command in ALL.items():
        assert f"## libero {name}\n" in page
        if not command.reads_words:
            section = page.split(f"## libero {name}\n")[1].split("\n## ")[0]
            section = section.replace("--for OVERRIDE", "--training").replace("--as {", "--format {").lower()
            for option in inspect.signature(options_of(load(command))).parameters:
                assert option.replace("_", "-") in section, (name, option)


OPTIONS = [
    (file.parent.relative_to(CONFIGS).as_posix(), file.stem)
    for file in sorted(CONFIGS.rglob("*/*.yaml"))
    if "hydra" not in file.parts  # launchers, which scale.md shows
]


@pytest.mark.parametrize("group", sorted({group for group, _ in OPTIONS}))
def test_every_option_of_a_group_is_shown(group):
    for folder in ("compat/libero", "tuned"):  # chosen by compat, or by the policy's head
        if group.startswith(folder):
            assert f"configs/{folder}" in written()
            return
    said = {name for found in re.findall(rf"\b{group}=([\w,]+)", written()) for name in found.split(",")}
    assert not {option for g, option in OPTIONS if g == group} - said


@pytest.mark.parametrize("algo", [option for group, option in OPTIONS if group == "algo"])
def test_every_algorithm_has_a_section_that_names_its_keys(algo):
    assert re.search(rf"^\| `{algo}` \|", text(DOCS / "algorithms.md"), re.M)
    sections = text(DOCS / "methods.md") + text(DOCS / "adapters.md")
    section = sections.split(f"\n## algo={algo}\n")[1].split("\n## ")[0]
    keys = set(yaml.safe_load((CONFIGS / "algo" / f"{algo}.yaml").read_text())) - {"_target_", "defaults"}
    missing = [key for key in keys if not re.search(rf"\b{key}\b", section)]
    assert not missing


def test_hooks_of_the_guide_are_those_of_algorithms():
    shown = text(DOCS / "algorithms.md").split("## Your own")[1]
    hooks = (
        "begin_task phases begin_phase mix penalty after_backward after_step end_phase end_task policy_for"
    )
    for hook in [*hooks.split(), "state_dict", "load_state_dict"]:
        assert hasattr(Algorithm, hook) and hook in shown


def test_every_key_is_in_the_reference_with_its_meaning():
    page = "".join(generate().configuration_keys.configuration_reference().values())
    for group, option in OPTIONS:
        values = yaml.safe_load((CONFIGS / group / f"{option}.yaml").read_text(encoding="utf-8"))
        assert f"- `{group}={option}`" in page
        if f"`configs/{group}/{option}.yaml`\n\n```yaml" in page:  # shown whole
            continue
        for key, *_ in generate().configuration_keys.leaves(values or {}):
            assert f"| `{group.replace('/', '.')}.{key}` |" in page
    rows = re.findall(r"^\| `[\w.]+` \|.*$", page, re.M)
    assert len(rows) > 100
    assert not [row for row in rows if not row.split("|")[-2].strip()]


def shown_keys(column: int) -> Iterator[list[str]]:
    """Overrides of a column of the table of keys: those of an algorithm by themselves, all others together."""
    table = text(DOCS / "migrating.md").split("## Keys")[1].split("\n## ")[0]
    rest: list[str] = []
    for row in re.findall(r"^\| `.*$", table, re.M):
        for found in re.findall(r"`([^`]+)`", row.split("|")[column]):
            words = [w if "=" in w else f"{w}=1" for w in found.replace("...", "x").split()]
            if re.match("(lifelong|algo)=", words[0]):
                yield words
            else:
                rest += words
    assert len(rest) > 10
    yield rest


def test_keys_of_the_migration_guide_exist():
    for words in shown_keys(1):
        load_config(*words)
    for words in shown_keys(2):
        composes(*words)


def test_extras_and_variables_are_told():
    page = text(DOCS / "install.md")
    extras = tomllib.loads(text(ROOT / "pyproject.toml"))["project"]["optional-dependencies"]
    packages = ("libero_env", "lifelong", "libero_eval")
    code = "".join(text(file) for p in packages for file in (ROOT / p).rglob("*.py"))
    variables = set(re.findall(r"\b(?:LIBERO|MUJOCO)_[A-Z_]+\b(?!\.TXT)", code))
    assert "LIBERO_CACHE" in variables
    assert not [name for name in {*extras, *variables} if f"\n| `{name}` |" not in page]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md", GUIDE], ids=lambda page: page.stem)
def test_what_a_page_names_exists(page):
    content = text(page)
    folders = "libero_env|lifelong|configs|tests|experiments|scripts|benchmark_scripts"
    named = [ROOT / name for name in re.findall(rf"`((?:{folders})/[\w./]+)`", content) if "l2." not in name]
    named += [page.parent / link for link in re.findall(r"\]\((?!http|#)([^)#]+)", content)]
    assert not [path for path in named if not path.exists()]


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda page: page.stem)
def test_pages_are_short(page):
    assert len(text(page).split()) <= 1500
    assert page.name != "README.md" or len(text(page).splitlines()) <= 110


NOT_OF_A_USER = ("make", "pip")  # CI does these: they install, train for minutes, and run all tests


@pytest.mark.sim
@pytest.mark.slow
def test_commands_of_the_readme_run_one_after_another_and_both_tasks_are_learned(tmp_path, demos):
    home = {"HOME": str(tmp_path / "home"), "LIBERO_CACHE": str(tmp_path / "cache"), "LIBERO_QUIET": "1"}
    home["LIBERO_DEMOS"] = str(demos)  # recorded with other seeds of this training, in test_smoke
    env = {**os.environ, **home, "PYTHONPATH": str(ROOT)}
    ran = []
    for line in "".join(blocks(ROOT / "README.md", "sh")).splitlines():
        program, *words = shlex.split(line, comments=True)
        if program in NOT_OF_A_USER or words == ["doctor"]:
            continue
        assert program == "libero"
        command = [sys.executable, "-m", "libero_cli", *words]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, (line, done.stdout, done.stderr)
        ran.append((words[0], done.stdout))
    assert [word for word, _ in ran] == ["train", "eval", "eval", "compare", "tasks"]
    (file,) = (tmp_path / "runs" / "first_steps").rglob("results.json")
    (first, _), (_, second) = json.loads(file.read_text())["success_matrix"]["rates"]
    assert first >= 0.6 and second >= 0.3
    assert re.search(r"^mine +1 +10 ", ran[3][1], re.M) and re.search(r"^expert +1 +10 ", ran[3][1], re.M)


def test_the_two_commands_stand_in_one_block_before_any_picture():
    start = text(ROOT / "README.md").partition("![")[0]
    block = start.partition("```sh\n")[2].partition("```")[0]
    assert [line.split("#")[0].strip() for line in block.splitlines()] == ["make train", "make test"]
    assert len(start.splitlines()) <= 40


def test_small_scale_numbers_of_table_8_are_those_of_the_study():
    study, page = text(ROOT / "experiments/algorithms/README.md"), text(DOCS / "reproducing.md")
    paper = text(ROOT / "experiments/paper/README.md").split("## Table 8")[1]
    columns = {"goal": (4, 2), "ten_demonstrations": (3, 4)}  # of the paper's table, of the page's
    for name, (published, here) in columns.items():
        table = study.split(f"<!-- {name}: metrics -->")[1].split("<!--")[0]
        for algo in ("sequential", "er", "ewc", "packnet"):
            row = re.search(rf"^\| `{algo}` \|.*$", page, re.M)[0].split("|")
            theirs = re.search(rf"^\| {algo} \|.*$", paper, re.M)[0].split("|")[published + 1]
            assert re.sub(r"±[.\d]+", "", theirs).split() == row[here].split()
            measured = re.search(rf"^\| {algo} \|.*$", table, re.M)
            cells = [measured[0].split("|")[c].split()[0] for c in (8, 10, 11)] if measured else ["not run"]
            shown = row[here + 1].strip().split(" / ")
            assert [c.replace("0.", ".").replace("-", "−") for c in cells] == shown


def test_every_page_is_in_the_navigation():
    def pages(node) -> Iterator[str]:
        for part in node if isinstance(node, list) else node.values():
            yield from [part] if isinstance(part, str) else pages(part)

    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]
    names = [*generate().ROOT_PAGES.values(), *(page.name for page in PAGES)]
    assert sorted(pages(nav)) == sorted(names)


def test_files_outside_lead_to_their_repository_where_it_is_known(monkeypatch):
    monkeypatch.delenv("GITHUB_REPOSITORY", raising=False)
    shown = "[First](../notebooks/1_quick_walkthrough.ipynb), [laptop](../experiments/laptop/README.md)"
    plain = "First (`notebooks/1_quick_walkthrough.ipynb`), `experiments/laptop`"
    assert generate().on_page_markdown(shown) == plain
    monkeypatch.setenv("GITHUB_REPOSITORY", "someone/robots")
    monkeypatch.setenv("GITHUB_REF_NAME", "v1.0.0")
    colab = "https://colab.research.google.com/github/someone/robots/blob/v1.0.0"
    assert generate().on_page_markdown(shown) == (
        f"[First (in Colab)]({colab}/notebooks/1_quick_walkthrough.ipynb), "
        "[laptop](https://github.com/someone/robots/blob/v1.0.0/experiments/laptop/README.md)"
    )


def test_a_notebook_is_a_page_with_its_outputs(tmp_path, monkeypatch):
    picture, module = b"\x89PNG", generate()
    outputs = [
        {"output_type": "stream", "name": "stdout", "text": ["two\n", "lines\n"]},
        {"output_type": "stream", "name": "stderr", "text": ["progress"]},
        {"output_type": "display_data", "data": {"image/png": base64.b64encode(picture).decode()}},
    ]
    title = ["# A title\n", "\n", "What it is, as in [tasks](../docs/tasks.md)."]
    code = {"cell_type": "code", "source": ["print(1)"], "outputs": []}
    cells = [{"cell_type": "markdown", "source": title}, code]
    source, done = tmp_path / "one.ipynb", tmp_path / "done.ipynb"
    source.write_text(json.dumps({"cells": cells}))
    monkeypatch.setattr(module, "executed", lambda path: done)
    content, pictures = module.notebook_page(source)
    assert "not executed" in content and not pictures
    code["outputs"] = outputs
    done.write_text(json.dumps({"cells": cells}))
    content, pictures = module.notebook_page(source)
    assert "not executed" not in content and "progress" not in content
    assert content.startswith("# A title\n") and "[tasks](tasks.md)" in content
    assert "```python\nprint(1)\n```\n\n```text\ntwo\nlines\n```" in content
    assert pictures == {"images/notebooks/one-0.png": picture}
    monkeypatch.setattr(module, "NOTEBOOKS", [source])
    assert module.notebook_list() == "- [A title](notebook-one.md): What it is, as in [tasks](tasks.md)."


def test_tests_that_are_named_exist():
    pages = [*PAGES, *ROOT.glob("experiments/*/README.md")]
    named = {m for page in pages for m in re.findall(r"(tests/[\w/]+\.py)::(\w+)", page.read_text())}
    assert named
    for file, name in named:
        assert f"def {name}(" in (ROOT / file).read_text(), f"{file}::{name}"


def test_the_guide_answers_questions_with_functions_that_exist():
    places = re.findall(r"`([\w/]+\.py):([\w.]+)`", text(GUIDE))
    assert len(places) > 12
    for path, name in places:
        nodes: list[ast.AST] = [ast.parse(text(ROOT / path))]
        for part in name.split("."):
            inside = [n for node in nodes for n in ast.iter_child_nodes(node)]
            nodes = [n for n in inside if isinstance(n, ast.ClassDef | ast.FunctionDef) and n.name == part]
        assert nodes, f"{path} has no {name}"


def test_the_files_to_read_first_are_few_and_short():
    block = text(GUIDE).split("Twelve files")[1].split("| question")[0]
    files = [ROOT / name for name in re.findall(r"`([\w/]+\.py)`", block)]
    assert len(files) == 12 and sum(measure.code_lines(text(f), ast.parse(text(f))) for f in files) < 3000


def test_the_documents_have_no_more_words_than_were_agreed():
    """A reader's time; what is added is paid for by what goes."""
    assert measure.words([ROOT / "README.md", GUIDE, *DOCS.glob("*.md")]) <= 24_000
