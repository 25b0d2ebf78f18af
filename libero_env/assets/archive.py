"""Unpacking of zip archives from others: all names and sizes are checked before the first file is written."""

import stat
import struct
import zipfile
import zlib
from pathlib import Path

from libero_env.assets.hub import DownloadError, check_free_space, check_names
from libero_env.storage import atomic_path

_MAX_FILES = 20_000
_MAX_RATIO = 100  # of all unpacked bytes to those of the archive; pictures pack to a tenth at best
_SMALL = 64 << 20  # [bytes] unpacked, up to which any ratio is fine
_HEADER = 30  # [bytes] before the name of each file
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_BLOCK = 1 << 20  # [bytes] unpacked at a time


def unpack(archive: Path, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Unpack a zip archive into a folder.

    Args:
        archive: File to read.
        folder: Folder to write to.
        overwrite: Whether to replace files that exist; otherwise they are kept.

    Returns:
        The files that were kept.

    Raises:
        DownloadError: The archive is damaged, encrypted, or has links, names that lead out of the folder, one name
            twice, or much more content than bytes; then nothing is written, or only complete files.
    """
    kept: list[Path] = []
    try:
        with zipfile.ZipFile(archive) as source:
            entries = [entry for entry in source.infolist() if not entry.is_dir()]
            _check(archive, source)
            check_free_space(folder, sum(entry.file_size for entry in entries))
            for entry in entries:
                target = folder / entry.filename
                if target.exists() and not overwrite:
                    kept.append(target)
                else:
                    _write(source, entry, target)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        struct.error,
        NotImplementedError,
        UnicodeError,
    ) as error:
        raise DownloadError(f"{archive}: the archive is damaged ({error})") from error
    except OSError as error:
        raise DownloadError(f"{archive}: it cannot be unpacked: {error}") from error
    return kept


def _write(source: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    with atomic_path(target) as temporary, source.open(entry) as packed, temporary.open("wb") as file:
        while block := packed.read(_BLOCK):
            file.write(block)


def _check(archive: Path, source: zipfile.ZipFile) -> None:
    """Check all entries of an archive by its directory."""
    everything = source.infolist()
    if len(everything) > _MAX_FILES:
        raise DownloadError(f"{archive}: more than {_MAX_FILES} files: do not trust it")
    for entry in everything:
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise DownloadError(f"{archive}: {entry.filename!r} is a link or a device: do not trust it")
        if entry.flag_bits & 1:
            raise DownloadError(f"{archive}: {entry.filename!r} is encrypted")
        if entry.compress_type not in _METHODS:
            raise DownloadError(
                f"{archive}: {entry.filename!r} is packed in an unknown way; expected deflate"
            )
    check_names(
        [entry.orig_filename.removesuffix("/") for entry in everything if not entry.is_dir()], str(archive)
    )
    check_names([entry.orig_filename.removesuffix("/") for entry in everything], str(archive))
    unpacked, packed = sum(entry.file_size for entry in everything), archive.stat().st_size
    if unpacked > max(_SMALL, _MAX_RATIO * packed):
        raise DownloadError(
            f"{archive}: {packed >> 10} KiB would unpack to {unpacked >> 20} MiB, more than {_MAX_RATIO} times as "
            "much: do not trust it"
        )
    end = 0
    for entry in sorted(everything, key=lambda entry: entry.header_offset):
        if entry.header_offset < end:
            raise DownloadError(f"{archive}: {entry.filename!r} overlaps another file: do not trust it")
        end = entry.header_offset + _HEADER + len(entry.orig_filename) + entry.compress_size
