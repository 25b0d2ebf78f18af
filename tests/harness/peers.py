"""vla-eval, Rerun and LeRobot in environments of their own, from which this checkout can be imported too."""

import json
import os
import shutil
import subprocess
import sysconfig
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

import pytest

from tests.harness.counterparts import counterpart

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(__file__).parent / "peer_scripts"
INTEGRATIONS = ROOT / "integrations"
# Starts a script with the folders of a variable after those of its own environment
_START = (
    "import os, runpy, sys; sys.path += os.environ['PEER_PATH'].split(os.pathsep); "
    "sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)


@dataclass(frozen=True)
class Peer:
    """An environment with another package: its interpreter, and folders that are searched after its own."""

    python: Path
    path: tuple[str, ...]

    def run(self, script: str, *arguments: object, cwd: Path, timeout: float = 300, **variables: str) -> dict:
        """Run a script of `peer_scripts` and return the JSON object that it prints last; `variables` are its own."""
        known = {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "PEER_PATH": os.pathsep.join(self.path)}
        command = [str(self.python), "-c", _START, str(SCRIPTS / script), *map(str, arguments)]
        env = {**os.environ, **known, **variables}
        done = subprocess.run(command, cwd=cwd, env=env, capture_output=True, text=True, timeout=timeout)
        assert done.returncode == 0, f"{script}:\n{done.stdout[-3000:]}\n{done.stderr[-6000:]}"
        return json.loads(done.stdout.strip().splitlines()[-1])


def vla_eval() -> Peer:
    """Return vla-eval's environment; what this package needs comes from the environment of the tests."""
    same = [f"{name}=={version(name)}" for name in ("numpy", "pillow", "omegaconf")]
    python = counterpart("vla-eval==0.8.0", *same)
    return Peer(python, (str(ROOT), sysconfig.get_path("purelib")))


def rerun() -> Peer:
    """Return the environment of Rerun, 530 MB, beside that of the tests."""
    python = counterpart(no_deps=("rerun-sdk==0.41.0",))
    return Peer(python, (str(ROOT), sysconfig.get_path("purelib")))


def lerobot() -> Peer:
    """Return LeRobot's environment with the plug-in; 5.4 GB, so it is made only where LIBERO_BUILD_LEROBOT is set."""
    python = os.environ.get("LIBERO_PYTHON312") or shutil.which("python3.12")
    if python is None:
        pytest.skip("LeRobot 0.6 needs Python 3.12, and there is none; LIBERO_PYTHON312 names another")
    needed = ("numba", "lazy_loader", "h5py", "fast-simplification", "trimesh", "cloudpickle", "hatchling")
    found = counterpart(
        "lerobot[evaluation,dataset]==0.6.1",
        "torch==2.11.0",
        f"mujoco=={version('mujoco')}",
        *needed,
        no_deps=("robosuite==1.4.1",),
        python=python,
        build="LIBERO_BUILD_LEROBOT" in os.environ,
    )
    return Peer(found, (str(ROOT), _installed(found, "lerobot_env_libero_lifelong")))


@cache
def _installed(python: Path, name: str) -> str:
    """Return a folder with one of our distributions as pip installs it: its metadata are what others look for."""
    folder = python.parents[1] / "integrations"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--upgrade"]
    command = [*pip, "--target", str(folder), str(INTEGRATIONS / name)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return str(folder)
