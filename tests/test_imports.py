"""Importing does nothing, and imports point one way."""

import json
import os
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

import libero
import libero_env
import libero_eval
import lifelong

ROOT = Path(__file__).parents[1]
NEEDS_EXTRA = "libero_env.sim.mjwarp."  # modules of the back end `warp`, whose package looks for GPUs
ENV_SIDE = sorted(
    module.name
    for module in pkgutil.walk_packages(libero_env.__path__, "libero_env.")
    if not module.name.startswith(NEEDS_EXTRA)
)
FACADE = sorted(module.name for module in pkgutil.walk_packages(libero.__path__, "libero."))
LEARNING_SIDE = sorted(module.name for module in pkgutil.walk_packages(lifelong.__path__, "lifelong."))
JUDGING_SIDE = sorted(module.name for module in pkgutil.walk_packages(libero_eval.__path__, "libero_eval."))

# What other packages do when they are imported: numba tries whether its cache can be written, matplotlib lists the
# fonts once per machine, gymnasium silences pygame.
THEIRS = re.compile(r"/__pycache__|/matplotlib|/\.(config|cache)$")
THEIR_VARIABLES = ("PYGAME_HIDE_SUPPORT_PROMPT",)

# Imports groups of modules and tells what each changed; each time as if nothing of ours were there yet. The audit hook
# sees every file opened for writing and every socket, whoever asks for it.
_PROBE = """
import importlib, json, os, random, sys
groups, found = json.loads(sys.argv[1]), []
deeds = []

def watch(event, args):
    if event == "open" and isinstance(args[0], str) and args[0] != os.devnull:
        flags = args[2] if isinstance(args[2], int) else 0
        if set(str(args[1] or "")) & set("wax+") or flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            deeds.append(f"wrote {args[0]}")
    elif event in ("os.mkdir", "os.remove", "os.rename", "os.rmdir", "os.symlink", "os.truncate"):
        deeds.append(f"{event} {args[0]}")
    elif event in ("socket.connect", "builtins.input"):
        deeds.append(f"{event} {args[:1]}")

sys.addaudithook(watch)
import numpy
for names in groups:
    for module in [one for one in sys.modules if one.startswith(("libero", "lifelong"))]:
        del sys.modules[module]
    before, deeds[:] = dict(os.environ), []
    state = (numpy.random.get_state()[1].tolist(), random.getstate())
    for name in names:
        importlib.import_module(name)
    deeds += [f"set {name}" for name in os.environ.keys() | before if os.environ.get(name) != before.get(name)]
    if state != (numpy.random.get_state()[1].tolist(), random.getstate()):
        deeds.append("touched the global random state")
    found.append({"deeds": [*deeds], "loaded": sorted(sys.modules)})
print(json.dumps(found))
"""

# Windows as far as it can be pretended: other packages may import what they like, as they ask `sys.platform`.
_WITHOUT_POSIX = """
import builtins, json, os, signal, sys
from pathlib import Path
names = json.loads(sys.argv[1])
for name in ("fork", "geteuid", "getuid", "killpg", "preadv", "sched_getaffinity", "setsid"):
    delattr(os, name)
for name in ("SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1"):
    delattr(signal, name)
real = builtins.__import__

def without_posix(name, globals=None, *args, **more):
    importer = (globals or {}).get("__name__", "").partition(".")[0]
    if name in ("fcntl", "grp", "pwd", "resource", "termios", "tty") and importer.startswith(("libero", "lifelong")):
        raise ImportError(f"no module {name}, which {importer} imports")
    return real(name, globals, *args, **more)

builtins.__import__ = without_posix
for name in names:
    __import__(name)
from libero_env import LiberoEnv, limited, memory, parallel
from libero_env.storage import check_trusted, write_json
from libero_eval.work.claims import Claims
assert min(*memory.host_memory(), memory.memory_limit(), parallel.cpu_count()) > 0
limited._limit_memory()
home = Path.home()
check_trusted(home)
write_json(home / "content.json", {}, fsync=True)
claim = Claims(home).take("a")
assert Claims(home).take("a") is None
Claims(home).release(claim)
with LiberoEnv("libero_object/0", cameras=()) as env:
    env.reset(seed=0)
    env.step([0.0] * 7)
"""


def import_in_fresh_process(home: Path, *groups: list[str]) -> list[dict]:
    """What importing each group of modules did in a process that knew nothing."""
    env = {
        "PATH": os.environ["PATH"], "HOME": str(home), "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"
    }  # fmt: skip
    command = [sys.executable, "-W", "error", "-c", _PROBE, json.dumps(groups)]
    done = subprocess.run(
        command, env=env, cwd=home, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.count("\n") == 1, f"importing printed: {done.stdout}"
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> dict[str, dict]:
    groups = {
        "libero_env": ENV_SIDE,
        "libero": FACADE,
        "libero_eval": JUDGING_SIDE,
        "lifelong": LEARNING_SIDE,
    }
    found = import_in_fresh_process(tmp_path_factory.mktemp("home"), *groups.values())
    return dict(zip(groups, found, strict=True))


@pytest.mark.parametrize("package", ["libero_env", "libero", "lifelong", "libero_eval"])
def test_importing_does_nothing(package, imported):
    done = imported[package]
    theirs = {f"set {name}" for name in THEIR_VARIABLES}
    ours = [deed for deed in done["deeds"] if deed not in theirs and not THEIRS.search(deed)]
    assert ours == []
    assert "robosuite" not in done["loaded"]


@pytest.mark.sim
def test_nothing_needs_what_windows_lacks(tmp_path):
    env = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    names = json.dumps(ENV_SIDE + FACADE + LEARNING_SIDE + JUDGING_SIDE)
    command = [sys.executable, "-c", _WITHOUT_POSIX, names]
    subprocess.run(command, env=env, cwd=tmp_path, timeout=300, check=True)


def test_the_environment_loads_nothing_of_learning(imported):
    loaded = imported["libero_env"]["loaded"]
    assert not {"lifelong", "warp", "torch", "hydra", "omegaconf", "robosuite", "matplotlib"} & set(loaded)


def test_the_command_line_starts_light(tmp_path):
    """`libero --help` must not wait for PyTorch or MuJoCo."""
    ((_, loaded),) = (done.values() for done in import_in_fresh_process(tmp_path, ["libero_env.cli.main"]))
    assert not {"torch", "mujoco", "hydra", "transformers", "matplotlib", "numba"} & set(loaded)
