"""The check of HDF5 files, which may come from anyone: nothing in them is used before.

A file stands for itself. It has groups and datasets, each linked once by name; soft and external links, data in other
files, virtual datasets, named types and filters of plugins are refused. What a dataset needs in memory is known before
it is read. What the HDF5 library says about damage arrives as `BrokenDemoError`.
"""

import errno
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from h5py import h5a, h5d, h5g, h5l, h5o, h5t, h5z

from libero_env.errors import DemoError
from libero_env.text import show_bytes

MAX_LINKS = 300_000  # of a file; 20,000 demonstrations have them
MAX_DEPTH = 8
MAX_ATTRIBUTE_BYTES = 64 << 20
MAX_CHUNK_BYTES = 1 << 30
MAX_RATIO = 1100  # size of a dataset to what is stored of it; gzip reaches 1032
FREE_BYTES = 1 << 20  # size up to which the ratio does not matter
_LZF = 32000
_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32, h5z.FILTER_SZIP, _LZF}
_LINKS = {h5l.TYPE_SOFT: "a soft link", h5l.TYPE_EXTERNAL: "a link to another file"}
_TEXT = {h5t.STRING: "text", h5t.INTEGER: "integer", h5t.FLOAT: "float", h5t.ENUM: "enum"}
_HEAP = b"GCOL\x01\x00\x00\x00"  # signature of a global heap, where texts are stored
_SETTLED = 2.0  # [s] age from which a file's modification time tells whether it has changed
_NOT_DAMAGE = {errno.EACCES, errno.EPERM, errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.EIO, errno.ENOMEM}
_ERRORS = (OSError, RuntimeError, LookupError, ValueError, TypeError, OverflowError, NotImplementedError)

_checked: set[tuple[int, ...]] = set()  # files of this process that have passed


class BrokenDemoError(DemoError):
    """A file or group that is not a demonstration, or not a complete one."""


def open_demo_file(file: Path) -> h5py.File:
    """Open a demonstration file for reading, after a check of everything that it is made of.

    Raises:
        BrokenDemoError: The file is truncated or damaged, is not an HDF5 file, or refers to something outside of it.
        DemoError: It does not exist, or cannot be opened now.
    """
    if not file.is_file():
        wrong = "it is a folder, a pipe or a device" if file.exists() else "no such file"
        raise DemoError(f"{file}: {wrong}; record it with `libero demos generate`")
    try:
        handle = h5py.File(file, "r")
    except _ERRORS as error:
        if isinstance(error, OSError) and error.errno in _NOT_DAMAGE:
            raise DemoError(f"{file}: cannot be opened ({_reason(error)}); is it being written?") from error
        raise BrokenDemoError(
            f"{file}: not a complete HDF5 file ({_reason(error)}); it is truncated, or of another format"
        ) from error
    try:
        _check_once(handle, file)
    except BaseException:
        handle.close()
        raise
    return handle


@contextmanager
def damage_named(where: str) -> Iterator[None]:
    """Turn what h5py raises about damaged data into `BrokenDemoError`; `where` begins its message."""
    try:
        yield
    except DemoError:
        raise
    except MemoryError as error:
        raise DemoError(f"{where} needs more memory than there is") from error
    except _ERRORS as error:
        raise BrokenDemoError(f"{where} cannot be read ({_reason(error)}); the file is damaged") from error


def read_array(dataset: h5py.Dataset, where: str) -> np.ndarray:
    """Return a dataset that `check_dataset` has passed, in this machine's byte order."""
    with damage_named(where):
        values = dataset[()]
        return values.astype(values.dtype.newbyteorder("="), copy=False)


def check_dataset(dataset: h5py.Dataset, where: str) -> int:
    """Check how a dataset is stored, and return its number of bytes in memory.

    Raises:
        BrokenDemoError: It is much larger than what is stored of it, or stored in a way that not everyone can read.
    """
    with damage_named(where):
        plist, stored = dataset.id.get_create_plist(), dataset.id.get_storage_size()
        filters = {plist.get_filter(i)[0] for i in range(plist.get_nfilters())}
        item = dataset.id.get_type().get_size()
        size, chunk = item * math.prod(dataset.shape or (0,)), item * math.prod(dataset.chunks or (0,))
    if unknown := sorted(filters - _FILTERS):
        raise BrokenDemoError(
            f"{where} is compressed by filter {unknown[0]}, which HDF5 does not have itself; convert the file with "
            "h5repack -f GZIP=1"
        )
    if size > FREE_BYTES and size > MAX_RATIO * stored:
        raise BrokenDemoError(
            f"{where} has shape {dataset.shape}, {show_bytes(size)}, of which {show_bytes(stored)} are stored; "
            "it is not complete"
        )
    if chunk > MAX_CHUNK_BYTES:
        raise BrokenDemoError(
            f"{where} is stored in chunks of {show_bytes(chunk)}; at most {show_bytes(MAX_CHUNK_BYTES)} are read"
        )
    return size + chunk


def read_attributes(item: h5py.Group, where: str) -> dict[str, Any]:
    """Return the attributes of a group: texts, numbers, and arrays of them.

    Raises:
        BrokenDemoError: One of them is damaged, or of another type.
    """
    with damage_named(f"{where} attributes"):
        names = list(item.attrs)
    if unnamed := [name for name in names if not isinstance(name, str) or not name.isprintable()]:
        raise BrokenDemoError(
            f"{where} has the attribute {unnamed[0]!r}, which is not a name; the file is damaged"
        )
    return {name: read_attribute(item, name, where) for name in names}


def read_attribute(item: h5py.Group, name: str, where: str, default: Any = None) -> Any:
    """Return an attribute of a group, or `default` where there is none; see `read_attributes`."""
    where = f"{where} attribute {name!r}"
    with damage_named(where):
        if name not in item.attrs:
            return default
        attribute = h5a.open(item.id, name.encode())
        kind = attribute.get_type()
        size = kind.get_size() * attribute.get_space().get_simple_extent_npoints()
        if kind.get_class() not in _TEXT:
            raise BrokenDemoError(f"{where} is neither text nor numbers")
        if size > MAX_ATTRIBUTE_BYTES:
            raise BrokenDemoError(f"{where} has {show_bytes(size)}; expected a text or some numbers")
        value = item.attrs[name]
        if isinstance(value, h5py.Empty):
            return ""
        if isinstance(value, np.ndarray) and value.dtype.kind in "SO":
            return [_text(one) for one in value.ravel()]
        return _text(value)


def _text(value: Any) -> Any:
    """Return a text as str, and anything else as it is; UnicodeError, a ValueError, where it is not UTF-8."""
    if isinstance(value, bytes):
        return value.decode()
    return value.encode().decode() if isinstance(value, str) else value


def _check_once(handle: h5py.File, file: Path) -> None:
    stat = file.stat()
    key = (stat.st_dev, stat.st_ino, stat.st_size, stat.st_mtime_ns)
    if key in _checked:
        return
    with damage_named(f"{file}: it"):
        _check_heaps(file, _check_tree(handle, file), handle.userblock_size)
    if time.time() - stat.st_mtime > _SETTLED:
        _checked.add(key)


def _check_tree(handle: h5py.File, file: Path) -> list[tuple[int, int]]:
    """Check every link, group and dataset; return the beginnings and ends of the data in the file."""
    data: list[tuple[int, int]] = []
    pending, seen, left = [(handle.id, "", 0)], {h5o.get_info(handle.id).addr}, MAX_LINKS
    while pending:
        group, path, depth = pending.pop()
        for name, item in _members(group, path, file, left):
            left -= 1
            where = f"{file}: {name}"
            if isinstance(item, h5g.GroupID):
                address = h5o.get_info(item).addr
                if address in seen or depth == MAX_DEPTH:
                    raise BrokenDemoError(
                        f"{where} is a group within itself, or too deep; expected data/demo_0/obs"
                    )
                seen.add(address)
                pending.append((item, name, depth + 1))
            elif isinstance(item, h5d.DatasetID):
                data += _check_layout(item, where)
            else:
                raise BrokenDemoError(f"{where} is a named type; expected groups and datasets")
    return data


def _members(group: h5g.GroupID, path: str, file: Path, limit: int) -> Iterator[tuple[str, Any]]:
    """Yield the path and the object of each link of a group."""
    links: list[tuple[bytes, Any]] = []

    def add(name: bytes, info: Any) -> bool | None:
        links.append((name, info.type))
        return True if len(links) > limit else None

    group.links.iterate(add, info=True)
    if len(links) > limit:
        raise BrokenDemoError(
            f"{file}: more than {MAX_LINKS} groups and datasets; expected a file of one task"
        )
    for name, kind in links:
        text = name.decode("utf-8", "replace")
        where = f"{path}/{text}" if path else text
        if not text.isprintable() or "/" in text or text in (".", "..") or "\ufffd" in text:
            raise BrokenDemoError(f"{file}: {where!r} is not a name of a group or dataset")
        if kind != h5l.TYPE_HARD:
            raise BrokenDemoError(
                f"{file}: {where} is {_LINKS.get(kind, 'an unknown kind of link')}; expected the data itself, in this "
                "file. Copy it with h5repack or h5copy"
            )
        yield where, h5o.open(group, name)


def _check_layout(dataset: h5d.DatasetID, where: str) -> list[tuple[int, int]]:
    """Check that the values of a dataset are in this file; return where they begin and end, if that is known."""
    plist = dataset.get_create_plist()
    layout = plist.get_layout()
    if layout not in (h5d.COMPACT, h5d.CONTIGUOUS, h5d.CHUNKED) or plist.get_external_count():
        raise BrokenDemoError(
            f"{where} has its values in other files or datasets; expected them in this file. Copy it with h5repack"
        )
    if layout == h5d.CONTIGUOUS and (begin := dataset.get_offset()) is not None:
        return [(begin, begin + dataset.get_storage_size())]
    spans: list[tuple[int, int]] = []
    if layout == h5d.CHUNKED and hasattr(dataset, "chunk_iter"):  # builds of h5py with an old HDF5 lack it
        dataset.chunk_iter(lambda info: spans.append((info.byte_offset, info.byte_offset + info.size)))
    return spans


def _check_heaps(file: Path, data: list[tuple[int, int]], base: int) -> None:
    """Check the global heaps of a file: on a damaged one the HDF5 library (2.0 and before) runs for ever.

    Args:
        data: Beginnings and ends of what cannot be a heap.
        base: Position of address 0 in the file.
    """
    with open(file, "rb") as stream, mmap(stream.fileno(), 0, access=ACCESS_READ) as content:
        position, size = 0, len(content)
        for begin, end in [*sorted((base + a, base + b) for a, b in data), (size, size)]:
            start = position - 1
            while (start := content.find(_HEAP, start + 1, begin)) >= 0:
                if not _heap_ends(content, start):
                    raise BrokenDemoError(f"{file}: the texts at byte {start} are damaged")
            position = max(position, end)


def _heap_ends(content: mmap, start: int) -> bool:
    """Return whether the global heap at a position is a sequence of objects that comes to an end."""
    end = min(start + _number(content, start + 8), len(content))
    at = start + 16
    while at + 16 <= end:
        index, size = _number(content, at, 2), _number(content, at + 8)
        need = size if index == 0 else 16 + (size + 7) // 8 * 8
        if need < 16 or need >= 1 << 63:
            return False
        at += need
    return True


def _number(content: mmap, at: int, size: int = 8) -> int:
    return int.from_bytes(content[at : at + size], "little")


def _reason(error: Exception) -> str:
    return " ".join(str(error.args[-1] if error.args else error).split())
