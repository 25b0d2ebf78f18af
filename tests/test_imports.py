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
import libero_cli
import libero_env
import libero_eval
import lifelong
from experiments.benchmarks.start_up import LISTS, REFUSED
from libero_cli.main import ALL

ROOT = Path(__file__).parents[1]
NEEDS_EXTRA = "libero_env.warp."  # modules of the back end `warp`, whose package looks for GPUs
MODULES = {  # package -> its modules
    package.__name__: sorted(
        module.name
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not module.name.startswith(NEEDS_EXTRA)
    )
    for package in (libero_env, libero, libero_cli, libero_eval, lifelong)
}

# What other packages do when they are imported: matplotlib lists the fonts once per machine, gymnasium silences pygame.
THEIRS = re.compile(r"/matplotlib|/\.(config|cache)$")
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
claims = Claims(home)
assert claims.take("a") and not Claims(home).take("a")
claims.release("a")
with LiberoEnv("libero_object/0", cameras=()) as env:
    env.reset(seed=0)
    env.step([0.0] * 7)
"""


def import_in_fresh_process(home: Path, *groups: list[str]) -> list[dict]:
    """What importing each group of modules did in a process that knew nothing."""
    env = {"PATH": os.environ["PATH"], "HOME": str(home), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-B", "-W", "error", "-c", _PROBE, json.dumps(groups)]
    done = subprocess.run(command, env=env, cwd=home, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count("\n") == 1, f"importing printed: {done.stdout}"
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> dict[str, dict]:
    found = import_in_fresh_process(tmp_path_factory.mktemp("home"), *MODULES.values())
    return dict(zip(MODULES, found, strict=True))


@pytest.mark.parametrize("package", MODULES)
def test_importing_does_nothing(package, imported):
    done = imported[package]
    theirs = {f"set {name}" for name in THEIR_VARIABLES}
    ours = [deed for deed in done["deeds"] if deed not in theirs and not THEIRS.search(deed)]
    assert ours == []
    assert "robosuite" not in done["loaded"]


@pytest.mark.sim
def test_nothing_needs_what_windows_lacks(tmp_path):
    env = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    names = [name for package, found in MODULES.items() if package != "libero_cli" for name in found]
    command = [sys.executable, "-c", _WITHOUT_POSIX, json.dumps(names)]
    subprocess.run(command, env=env, cwd=tmp_path, timeout=300, check=True)


def test_the_environment_loads_nothing_of_learning(imported):
    loaded = imported["libero_env"]["loaded"]
    assert not {"lifelong", "warp", "torch", "hydra", "omegaconf", "robosuite", "matplotlib"} & set(loaded)


def test_the_environment_names_nothing_of_learning():
    """Nor in its texts and data: a name in a text is an import that no contract sees."""
    named = re.compile(r"(?<![\w-])(lifelong|libero_(eval|cli))\b")
    files = [f for f in (ROOT / "libero_env").rglob("*") if f.suffix in (".py", ".pyi", ".yaml")]
    lines = [f"{f.relative_to(ROOT)}: {line}" for f in files for line in f.read_text("utf-8").splitlines()]
    assert [line for line in lines if named.search(line.partition(": ")[2])] == []


# Runs command lines, each in a child of a process that has imported the command alone; tells status and modules.
_COMMANDS = """
import contextlib, io, json, os, sys
import libero_eval.words, typeguard  # what most of them load
from libero_cli import main
for words in json.loads(sys.argv[1]):
    read, write = os.pipe()
    if not os.fork():
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
            try:
                status = main.main(words.split())
            except SystemExit as ended:
                status = ended.code
        os.write(write, json.dumps([status, sorted(sys.modules)]).encode())
        os._exit(0)
    os.close(write)
    print(os.fdopen(read).read())
    os.wait()
"""
HEAVY = {
    *("gymnasium", "h5py", "hydra", "jinja2", "matplotlib", "mujoco", "numba", "PIL.Image", "scipy.special"),
    *("scipy.stats", "torch", "transformers", "trimesh"),
}
MAY = {
    "a key of the configuration": {"hydra"},
    "a value of the configuration": {"gymnasium", "h5py", "hydra", "mujoco", "PIL.Image"},
    "power": {"scipy.special"},
}


def test_commands_say_what_they_are_and_what_is_wrong_before_they_load_anything_heavy(tmp_path):
    lines = {f"{name} --help": (0, set()) for name in ALL}
    lines |= {line: (0, MAY.get(line, set())) for line in LISTS}
    lines |= {line: (2, MAY.get(kind, set())) for kind, refused in REFUSED.items() for line in refused}
    env = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", _COMMANDS, json.dumps([*lines])]
    done = subprocess.run(command, env=env, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    ended = dict(zip(lines, map(json.loads, done.stdout.splitlines()), strict=True))
    assert {line: ended[line][0] for line in lines} == {line: status for line, (status, _) in lines.items()}
    loaded = {line: HEAVY & {*names} - lines[line][1] for line, (_, names) in ended.items()}
    assert not {line: names for line, names in loaded.items() if names}
