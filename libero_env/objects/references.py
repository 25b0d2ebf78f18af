"""Files that are named in files from outside: they lie in the same folder or below, and have a usual size."""

import struct
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from libero_env.errors import InvalidInputError

MAX_FILE_BYTES = 256 << 20  # of a mesh or texture
MAX_PIXELS = 8192 * 8192  # of a texture
MAX_FACES = 1_000_000  # of a mesh
_LONGEST_LINE = 4096  # characters; faces of very many corners take long to cut into triangles
_PNG = b"\x89PNG\r\n\x1a\n"
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of the colour types of PNG
_SMALL_PNG = 1 << 16  # [bytes] files that cannot unpack to more than 64 MiB
_BLOCK = 1 << 20  # [bytes] unpacked at a time


def file_inside(folder: Path, name: str, where: str, what: str = "file") -> Path:
    """Return the file that a name stands for, an absolute path.

    Args:
        folder: Folder that the name is relative to.
        name: Name as it is written in a file, with the folders below `folder`.
        where: `file:line` or the like of the name, with which messages start.
        what: Kind of the file, for messages.

    Raises:
        InvalidInputError: The name leads out of the folder, also by a link, or the file is missing or too large.
    """
    plain = name.replace("\\", "/")
    parts = PurePosixPath(plain).parts
    if "\0" in name or not parts:
        raise InvalidInputError(f"{where}: {name!r} is no name of a file")
    if PurePosixPath(plain).is_absolute() or PureWindowsPath(name).drive or ":" in parts[0] or ".." in parts:
        raise InvalidInputError(
            f"{where}: {what} {name!r} is outside of the folder {folder}; only files in it or below are read: copy "
            "it there, and write its name relative to the folder"
        )
    file = folder.absolute() / plain
    try:
        if not file.is_file():
            raise InvalidInputError(f"{where}: {what} {file} is missing; put it there, or fix the name")
        if not file.resolve().is_relative_to(folder.resolve()):
            raise InvalidInputError(
                f"{where}: {what} {file} is a link to {file.resolve()}, outside of the folder; copy the file itself"
            )
    except (OSError, RuntimeError, ValueError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{where}: {what} {name[:80]!r}: {error}") from error
    check_size(file, where)
    return file


def check_size(file: Path, where: str) -> None:
    """Check that a file is not empty and not larger than `MAX_FILE_BYTES`.

    Raises:
        InvalidInputError: It is.
    """
    size = file.stat().st_size
    if not size:
        raise InvalidInputError(f"{where}: {file} is empty")
    if size > MAX_FILE_BYTES:
        raise InvalidInputError(
            f"{where}: {file} has {size >> 20} MiB; up to {MAX_FILE_BYTES >> 20} MiB are read: simplify it"
        )


def texture_pixels(file: Path, where: str) -> int:
    """Return the number of pixels of a PNG file by its header; 0 for other formats, which are stored as they are.

    Raises:
        InvalidInputError: There are more than `MAX_PIXELS`, or its data unpack to more than that.
    """
    with file.open("rb") as stream:
        head = stream.read(33)
    if head[:8] != _PNG or len(head) < 33:
        return 0
    width, height, bits, kind = struct.unpack(">IIBB", head[16:26])
    check_pixels(width, height, f"{where}: {file}")
    if file.stat().st_size > _SMALL_PNG:
        expected = height * (1 + (width * bits * _CHANNELS.get(kind, 4) + 7) // 8) + 8 * (width + height)
        if _unpacked_size(file, expected) > expected:
            raise InvalidInputError(f"{where}: {file} unpacks to more than its {width} x {height} pixels")
    return width * height


def _unpacked_size(file: Path, limit: int) -> int:
    """Return the unpacked size of the data of a PNG file, up to a limit plus some bytes."""
    unpack, total = zlib.decompressobj(), 0
    with file.open("rb") as stream:
        stream.seek(8)
        while len(head := stream.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            data = stream.read(length)
            stream.seek(4, 1)
            while kind == b"IDAT" and data and total <= limit:
                try:
                    total += len(unpack.decompress(data, _BLOCK))
                except zlib.error:
                    return total  # MuJoCo says what is wrong
                data = unpack.unconsumed_tail
    return total


def check_pixels(width: int, height: int, where: str) -> None:
    """Check the size of a picture.

    Raises:
        InvalidInputError: It has no pixels, or more than `MAX_PIXELS`.
    """
    if not 0 < width * height <= MAX_PIXELS:
        raise InvalidInputError(
            f"{where} has {width} x {height} pixels; expected 1 to {MAX_PIXELS >> 20} million: make it smaller"
        )


def mesh_faces(file: Path, where: str) -> int:
    """Return the number of triangles of an OBJ, STL or MSH file, which MuJoCo reads, before it does.

    Raises:
        InvalidInputError: There are more than `MAX_FACES`, the format is another, or the content does not fit together.
    """
    reader = {".obj": _obj_faces, ".stl": _stl_faces, ".msh": _msh_faces}.get(file.suffix.lower())
    if reader is None:
        raise InvalidInputError(f"{where}: {file} has an unknown format; valid: .obj, .stl, .msh")
    data = file.read_bytes()
    try:
        faces = reader(data)
    except ValueError as error:
        raise InvalidInputError(f"{where}: {file}: {error}; export it again") from None
    check_faces(faces, f"{where}: {file}")
    return faces


def check_faces(faces: int, where: str) -> None:
    """Check the number of triangles of a mesh.

    Raises:
        InvalidInputError: There are more than `MAX_FACES`.
    """
    if faces > MAX_FACES:
        raise InvalidInputError(f"{where} has {faces} triangles; simplify it to {MAX_FACES} or fewer")


def _obj_faces(data: bytes) -> int:
    lines = data.split(b"\n")
    if max(map(len, lines)) > _LONGEST_LINE:
        raise ValueError(f"a line has more than {_LONGEST_LINE} characters")
    return sum(max(len(line.split()) - 3, 1) for line in lines if line[:2] in (b"f ", b"f\t"))


def _stl_faces(data: bytes) -> int:
    faces = struct.unpack_from("<I", data, 80)[0] if len(data) >= 84 else -1
    if faces * 50 + 84 != len(data):
        raise ValueError("it is no binary STL file of its size")
    triangles = np.frombuffer(data, [("numbers", "<f4", 12), ("rest", "<u2")], offset=84)["numbers"][:, 3:]
    _check_finite(triangles)
    return faces


def _msh_faces(data: bytes) -> int:
    counts = struct.unpack_from("<4i", data) if len(data) >= 16 else (-1,) * 4
    vertices, normals, texcoords, faces = counts
    floats = 3 * vertices + 3 * normals + 2 * texcoords
    if min(counts) < 0 or 16 + 4 * (floats + 3 * faces) != len(data):
        raise ValueError("it is no MSH file of its size")
    _check_finite(np.frombuffer(data, "<f4", floats, offset=16))
    corners = np.frombuffer(data, "<i4", 3 * faces, offset=16 + 4 * floats)
    if faces and not 0 <= corners.min() <= corners.max() < vertices:
        raise ValueError("a triangle names a vertex that it does not have")
    return faces


def _check_finite(numbers: np.ndarray) -> None:
    if not np.isfinite(numbers).all():
        raise ValueError("it has numbers that are not finite")
