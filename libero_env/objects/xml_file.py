"""XML files from outside: read within limits, with the line of each element, and written again for MuJoCo.

Entities and document types are refused: no MJCF file needs them, and a few lines of them expand to gigabytes.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree as ET
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from libero_env.errors import InvalidInputError
from libero_env.storage import read_bounded

MAX_BYTES = 64 << 20  # our own files hold the points of collision meshes as text
_MAX_DEPTH = 80  # MuJoCo's own parser ends at 100
_MAX_ELEMENTS = 100_000


class Node(ET.Element):
    """An element that knows where it is written.

    Attributes:
        at: `file:line`.
    """

    at: str = ""


def place_of(node: ET.Element) -> str:
    """Return `file:line` of an element; empty for one that was made."""
    return getattr(node, "at", "")


def parse_xml(path: Path) -> Node:
    """Return the root element of an XML file; comments and text between elements are left out.

    Raises:
        InvalidInputError: The file is missing, too large, nested too deeply, or not XML; the message names the line.
    """
    try:
        data = read_bounded(path, MAX_BYTES)
    except OSError as error:
        raise InvalidInputError(f"{path}: {error.strerror or error}") from error
    return parse_xml_text(data, str(path))


def parse_xml_text(data: bytes, source: str) -> Node:
    """Return the root element of an XML text; see `parse_xml`.

    Args:
        data: Content of the file.
        source: Name of the file, for messages.
    """
    parser = expat.ParserCreate()
    open_nodes: list[Node] = []
    roots: list[Node] = []
    count = 0

    def refuse(text: str) -> NoReturn:
        raise InvalidInputError(f"{source}:{parser.CurrentLineNumber}: {text}")

    def start(tag: str, attributes: Mapping[str, str]) -> None:
        nonlocal count
        count += 1
        if count > _MAX_ELEMENTS:
            refuse(f"more than {_MAX_ELEMENTS} elements")
        if len(open_nodes) >= _MAX_DEPTH:
            refuse(f"elements within elements, more than {_MAX_DEPTH} deep")
        node = Node(tag, dict(attributes))
        node.at = f"{source}:{parser.CurrentLineNumber}"
        (open_nodes[-1] if open_nodes else roots).append(node)
        open_nodes.append(node)

    def declare(*_: object) -> None:
        refuse("document types and entities (<!DOCTYPE ...>) are not read; write out what they stand for")

    parser.StartElementHandler, parser.EndElementHandler = start, lambda _: open_nodes.pop()
    parser.StartDoctypeDeclHandler = declare
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        what = expat.errors.messages.get(error.code, str(error))
        raise InvalidInputError(f"{source}:{error.lineno}: not valid XML: {what}") from None
    except (LookupError, UnicodeError, ValueError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{source}: not valid XML: {error}; save it as UTF-8") from None
    return roots[0]


def write_xml(root: ET.Element) -> tuple[str, tuple[str, ...]]:
    """Return the text of an element, a line for each element in it, and where each of these lines comes from."""
    lines: list[str] = []
    places: list[str] = []

    def write(node: ET.Element) -> None:
        attributes = "".join(f" {key}={quoteattr(value)}" for key, value in node.attrib.items())
        lines.append(f"<{node.tag}{attributes}{'>' if len(node) else '/>'}")
        places.append(place_of(node))
        for child in node:
            write(child)
        if len(node):
            lines[-1] += f"</{node.tag}>"

    write(root)
    return "\n".join(lines) + "\n", tuple(places)


def explain(error: Exception, path: Path, places: Sequence[str] = ()) -> str:
    """Return a message of MuJoCo in one line, which starts with the file and line that it is about.

    Args:
        error: MuJoCo's error.
        path: File that was read.
        places: Where each line of the text that MuJoCo got comes from; empty where that is not known.
    """
    text = " ".join(str(error).split())
    found = re.search(r",? line (\d+)", text)
    number = int(found[1]) - 1 if found else -1
    where = places[number] if 0 <= number < len(places) else ""
    plain = re.sub(r",? line \d+", "", text).removeprefix("Error: ")
    return f"{where or path}: {plain}"
