"""Every command works with the packages that its extra installs, or says in one line which extra it needs."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, distribution, packages_distributions
from pathlib import Path

import numpy as np
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from libero_cli.main import ALL
from libero_env.errors import EXTRAS
from tests.harness.policy_servers import openpi
from tests.harness.results import drawn_result
from tests.harness.runs import make_run
from tests.harness.scenes import write_box

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
NEEDS_EXTRA = re.compile(r"error: .*pip install 'libero-lifelong\[\w+\]'.*\n")
# what each command is given: little to do, and nothing from the network
REFUSED = (  # rather than hours
    *("tasks init-states", "demos download", "teleop", "sweep status", "assets install"),
    *("relearn", "diagnose"),  # whose run has no demonstrations
)
TASK, RUN, SAVED, DEMOS = "libero_object/0", "run", "saved", "demos/*/*/*_demo.hdf5"
WORDS = {
    "tasks list": "libero_object",
    "tasks show": TASK,
    "tasks new": "cup --scene kitchen --objects red_coffee_mug plate",
    "tasks preview": f"{TASK} --starts 1 --size 32 --out preview.png",
    "tasks lint": TASK,
    "tasks certify": f"{TASK} --states 1 --jobs 1 --out certified",
    "tasks init-states": "no_suite",
    "objects add": "cube.obj --size 0.05",
    "objects list": "",
    "objects show": "cube",
    "objects preview": "cube --out cube.png",
    "objects remove": "cube",
    "perturb list": "",
    "perturb show": f"{TASK} --perturb light=0.5 --size 32 --out light.png",
    "perturb certify": f"{TASK} --kinds light --severities 0.5 --starts 1 --redraws 0 --jobs 1 --out kinds",
    "demos generate": f"--task {TASK} --n 1 --size 32 --folder demos --workers 1",
    "demos download": "no_suite",
    "demos info": "demos",
    "demos check": "demos",
    "demos replay": f"{DEMOS}",
    "demos show": f"{DEMOS} --rerun shown.rrd",
    "demos rerender": f"{DEMOS} rerendered.hdf5 --size 32",
    "demos filter": f"{DEMOS} filtered.hdf5 --success",
    "demos export": f"{DEMOS} --as lerobot --out set",
    "teleop": "libero_object/99",
    "train": "preset=smoke algo=er benchmark=libero_object benchmark.tasks=1 device=cpu data.image_size=32 "
    "data.demos=1 data.folder=demos policy.encoder.width=8 train.epochs=1 train.steps_per_epoch=1 train.warmup_steps=0 "
    "eval.curve=none eval.select=last eval.horizon=1 eval.episodes=1 runs_dir=runs",
    "tune": "algo=er preset=smoke device=cpu algo.ratio=0.5,1 data.image_size=32 data.demos=1 data.folder=demos "
    "policy.encoder.width=8 train.warmup_steps=0 --seeds 1 --steps 1 --starts 1 "
    "--suite libero_object --stream 0,1 --out tuned",
    "sweep status": "runs",
    "report": SAVED,
    "eval": f"expert --suite {TASK} --episodes 1 --horizon 2 --out eval",
    "robustness": f"expert --suite {TASK} --episodes 1 --horizon 2 --kinds light --severities 0.5 --out robust",
    "compare": "one=judged/eval.json other=judged/eval.json",
    "board": "judged --out board.html",
    "power": "--base 0.5 --difference 0.1",
    "results export": f"{SAVED} --as csv --out table",
    "protocols list": "",
    "protocols show": "openpi",
    "protocols diff": "openpi libero",
    "serve": f"{RUN} --port 0",
    "relearn": f"{RUN} --steps 1 --every 1",
    "diagnose": RUN,
    "saliency": f"{SAVED} --task 0 --horizon 1 --moments 1",
    "view": TASK,
    "check": SAVED,
    "doctor": "--gl",
    "completion": "",
    "assets install": "robot --dest folder",
    "assets download": "--dest cube.obj",
    "assets info": "",
    "assets check": "",
}

# of a folder site-packages, as what an interpreter runs when it starts
HIDING = """\
import os, sys

class Hiding:
    names = set(os.environ["HIDDEN_PACKAGES"].split())

    def __init__(self, finder):
        self.finder = finder

    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in self.names:
            return self.finder.find_spec(name, path, target)

    def __getattr__(self, name):
        return getattr(self.finder, name)

sys.meta_path[:] = map(Hiding, sys.meta_path)
"""


def required(extras: list[str]) -> set[str]:
    """Names of the distributions that the package requires with some extras, and of those that they require."""
    wanted = [Requirement(line) for line in PROJECT["dependencies"]]
    wanted += [Requirement(line) for extra in extras for line in PROJECT["optional-dependencies"][extra]]
    known: set[tuple[str, str]] = set()
    while wanted:
        one = wanted.pop()
        for extra in ("", *one.extras):
            key = canonicalize_name(one.name), extra
            if key in known or (one.marker and not one.marker.evaluate({"extra": extra})):
                continue
            known.add(key)
            try:
                lines = distribution(one.name).requires or []
            except PackageNotFoundError:  # of another platform
                continue
            for found in map(Requirement, lines):
                if found.marker is None or found.marker.evaluate({"extra": extra}):
                    found.marker = None  # which holds, whatever extras the found one is asked for with
                    wanted.append(found)
    return {name for name, _ in known}


def hidden(extras: list[str]) -> set[str]:
    """Names of the installed packages that an installation with some extras does not have."""
    kept = required(extras) | {"libero-lifelong", "packaging", "pip", "setuptools"}
    owners = packages_distributions().items()
    owned = {name for name, found in owners if kept & {*map(canonicalize_name, found)}}
    return {name for name, _ in owners} - owned - sys.stdlib_module_names


def test_the_table_of_extras_names_what_they_install():
    optional = PROJECT["optional-dependencies"]
    for extra, packages in EXTRAS.items():
        names = required([extra])
        for package in packages:
            owners = packages_distributions().get(package, ())
            installed = not owners or {canonicalize_name(one) for one in owners} & names
            assert extra in optional and installed, package


def run_all(lines: list[str], extras: list[str], folder: Path) -> list[tuple[int, str, str]]:
    """Return how each command ends in an installation with some extras: status, output and errors."""
    (folder / "site-packages").mkdir()
    (folder / "site-packages" / "sitecustomize.py").write_text(HIDING)
    path = os.pathsep.join([str(folder / "site-packages"), str(ROOT)])
    environment = os.environ | {"HIDDEN_PACKAGES": " ".join(hidden(extras)), "PYTHONPATH": path}
    process = subprocess.run(
        [sys.executable, "-m", "tests.harness.commands"], input=json.dumps([line.split() for line in lines]),
        text=True, capture_output=True, env=environment, cwd=folder, timeout=1800, check=False,
    )  # fmt: skip
    ended = [json.loads(line) for line in process.stdout.splitlines()]
    assert len(ended) == len(lines), process.stderr[-3000:]
    return ended


OWN = "class Still:\n    def predict(self, observations):\n        return [[0.0] * 7] * len(observations['ee_pos'])\n"


@pytest.mark.sim
@pytest.mark.slow
def test_servers_and_policies_of_ones_own_are_judged_without_pytorch(tmp_path):
    assert {"torch", "omegaconf", "safetensors"} <= hidden(["eval"])
    (tmp_path / "own.py").write_text(OWN)
    words = f"--suite {TASK} --episodes 1 --horizon 2"
    with openpi(lambda obs: {"actions": np.zeros((10, 7))}, {"policy": "still"}) as address:
        lines = [
            f"eval {address} {words} --protocol openpi --name still --out served", f"eval own:Still {words} --out own",
            f"eval expert {words} --out expert --videos 1 --workers 2", "eval own/eval.json --out again",
            f"robustness own:Still {words} --kinds light --severities 0.5 --pairs --out robust",
            "compare expert own", "board expert own", "power --base 0.5", "protocols list",
            "protocols diff libero openpi", "results export expert --as lerobot",
        ]  # fmt: skip
        ended = dict(zip(lines, run_all(lines, ["eval"], tmp_path), strict=True))
    again = ended.pop("eval own/eval.json --out again")
    assert again[0] == 2 and "--allow own" in again[2]
    assert {line: err for line, (status, _, err) in ended.items() if status not in (0, 1)} == {}


@pytest.mark.sim
@pytest.mark.slow
@pytest.mark.parametrize("extras", [[], ["train"]], ids=lambda extras: "+".join(extras) or "none")
def test_every_command_works_or_names_an_extra(extras, tmp_path):
    assert WORDS.keys() == ALL.keys(), "every command is run"
    make_run(tmp_path / RUN, "algo=er")
    drawn_result(0.5, 1).write(tmp_path / "judged" / "eval.json")
    shutil.copytree(ROOT / "tests" / "lifelong" / "data" / "saved_runs" / "er", tmp_path / SAVED)
    write_box(tmp_path / "cube.obj", 0.5)
    ended = run_all([f"{name} {own}" for name, own in WORDS.items()], extras, tmp_path)
    for name, (status, _, err) in zip(WORDS, ended, strict=True):
        one_line = err.count("error: ") == err.count("\nerror: ") + err.startswith("error: ") == 1
        told = status in (0, 1) or (status == 2 and one_line and (name in REFUSED or NEEDS_EXTRA.search(err)))
        assert told and "Traceback" not in err, f"{name} ended with {status}: {err[-2000:]}"
    works = {name for name, (status, *_) in zip(WORDS, ended, strict=True) if status in (0, 1)}
    assert works >= {"tasks list", "demos generate", "doctor"}
    assert "train" not in extras or works >= {"train", "results export", "eval", "compare", "check"}
