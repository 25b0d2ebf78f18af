"""A home folder for each process of the tests: nothing of the user's is read, and nothing is left in his.

What is costly to make again, and the same for everybody, is taken over from his caches.
"""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from libero_env.paths import cache_dir

# variables that name what only tests read, and programs of the machine; others of LIBERO_ are the user's settings
KEPT = (
    "LIBERO_SHARED", "LIBERO_FUZZ", "LIBERO_FUZZ_SEED", "LIBERO_WARP", "LIBERO_COUNTERPARTS", "LIBERO_PICTURES",
    "LIBERO_ORIGINAL_SOURCE", "LIBERO_ORIGINAL_PYTHON", "LIBERO_PYTHON", "LIBERO_NOTEBOOKS_OUT", "LIBERO_BUILD",
    "LIBERO_LEROBOT", "LIBERO_TFDS", "LIBERO_OPENPI"
)  # fmt: skip
OURS = ("robot", "meshes", "assets_checked", "assets")  # the robot and its meshes; the original's models
OTHERS = ("matplotlib", "numba", "huggingface")  # fonts, compiled code, models of language


def move_in() -> Path:
    """Give this process and those that it starts an empty home; return it. It is removed when the process ends."""
    ours, caches = cache_dir(), Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    settings = (Path.home() / name for name in (".config/pip/pip.conf", ".pip/pip.conf"))
    pip = next(filter(Path.is_file, settings), None)
    home = Path(tempfile.mkdtemp(prefix="libero-home-"))
    atexit.register(shutil.rmtree, home, ignore_errors=True)
    for name in [name for name in os.environ if name.startswith(("LIBERO_", "XDG_")) and name not in KEPT]:
        del os.environ[name]
    os.environ["HOME"] = str(home)
    if pip is not None:
        os.environ.setdefault("PIP_CONFIG_FILE", str(pip))  # where packages are fetched from
    shared = {"LIBERO_COUNTERPARTS": "libero-lifelong/counterparts", "PIP_CACHE_DIR": "pip"}  # and wheels
    for name, folder in (shared | {"MESA_SHADER_CACHE_DIR": "mesa_shader_cache"}).items():
        os.environ.setdefault(name, str(caches / folder))
    linked = {ours / name: home / ".cache" / "libero" / name for name in OURS}
    for source, target in (linked | {caches / name: home / ".cache" / name for name in OTHERS}).items():
        if source.is_dir():
            shutil.copytree(source, target, symlinks=True, copy_function=_link)
    return home


def _link(source: str, target: str) -> None:
    """Make a second name for a file, which nobody writes to, or a copy of it on another disk."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copy2(source, target)
