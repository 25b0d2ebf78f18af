"""What README.md and CONTRIBUTING.md show is run here; tests/test_docs_site.py does it for docs/."""

import re
from pathlib import Path

import pytest
import torch
import yaml

from libero_env.envs.env import LiberoEnv
from libero_env.objects import catalog
from libero_env.tasks import Task
from libero_env.tasks.builder import build_problem, load_scene

ROOT = Path(__file__).parents[1]


def blocks(file: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / file).read_text(encoding="utf-8"), re.M | re.S)


def test_there_is_something_to_run():
    assert len(blocks("README.md", "python")) == 1
    assert len(blocks("CONTRIBUTING.md", "python")) == 2
    assert len(blocks("CONTRIBUTING.md", "yaml")) == 2


@pytest.mark.parametrize("block", [b for kind in ("python", "yaml") for b in blocks("CONTRIBUTING.md", kind)])
def test_examples_are_short(block):
    assert len([line for line in block.splitlines() if line.strip()]) <= 15


@pytest.mark.sim
@pytest.mark.parametrize("block", blocks("README.md", "python"))
def test_the_environment_of_the_readme(block, capsys):
    exec(compile(block, "README.md", "exec"), {})  # noqa: S102
    assert "128, 128, 3)" in capsys.readouterr().out


@pytest.mark.unit
def test_the_algorithm_of_the_guide():
    code, config = (
        blocks("CONTRIBUTING.md", "python")[0],
        yaml.safe_load(blocks("CONTRIBUTING.md", "yaml")[0]),
    )
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


@pytest.mark.sim
def test_the_object_and_the_task_of_the_guide(monkeypatch):
    monkeypatch.setattr(catalog, "_registered", {})
    exec(compile(blocks("CONTRIBUTING.md", "python")[1], "red_cube.py", "exec"), {})  # noqa: S102
    (facts,) = yaml.safe_load(blocks("CONTRIBUTING.md", "yaml")[1])
    problem = build_problem(load_scene(facts["scene"]), facts)
    env = LiberoEnv(Task("mine", 0, facts["name"], "pick it up", problem.language, problem), cameras=())
    env.reset(seed=1)
    assert list(problem.objects)[0] == "red_cube_1"
    assert not env.step(env.action_space.sample() * 0)[4]["success"]
    env.close()


@pytest.mark.unit
@pytest.mark.parametrize("file", ["README.md", "CONTRIBUTING.md"])
def test_what_is_named_exists(file):
    text = (ROOT / file).read_text(encoding="utf-8")
    named = re.findall(r"`((?:libero_env|lifelong|configs|tests|experiments)/[\w./]*)`", text)
    named += re.findall(r"\]\((?!http)([^)#]+)\)", text)
    missing = [name for name in named if not (ROOT / name).exists() and "l2." not in name]
    assert named and not missing, f"{file} names what is not there: {missing}"


@pytest.mark.unit
def test_tests_that_are_named_exist():
    pages = [*ROOT.glob("docs/*.md"), *ROOT.glob("experiments/*/README.md")]
    named = {m for page in pages for m in re.findall(r"(tests/[\w/]+\.py)::(\w+)", page.read_text())}
    assert named
    for file, name in named:
        assert f"def {name}(" in (ROOT / file).read_text(), f"{file}::{name}"
