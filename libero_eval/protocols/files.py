"""Files of protocol cards: those of the package, `cards/NAME.yaml`, and a user's own, which may extend another."""

import difflib
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, fields
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.storage import read_yaml_file
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.protocols.protocol import SECTIONS, Card
from lifelong.errors import EvaluationFileError, ProtocolError

_FOLDER = Path(str(resources.files("libero_eval"))) / "protocols" / "data"
_TOP = ("title", "extends", "sources")


def card_names() -> tuple[str, ...]:
    """Return the names of the package's cards, `libero` first."""
    return tuple(sorted((path.stem for path in _FOLDER.glob("*.yaml")), key=lambda n: (n != "libero", n)))


def load_card(protocol: str | Path) -> Card:
    """Return a card.

    Args:
        protocol: Name of one of the package's cards, or path of a YAML file, or of a result, `eval.json`.

    Raises:
        UnknownNameError: There is no such card.
        ProtocolError: The file is not a valid card; the message names the file and the keys.
    """
    path = _path(str(protocol), Path.cwd())
    return _packaged(path) if path.parent == _FOLDER else _load(path)


@lru_cache(maxsize=64)
def _packaged(path: Path) -> Card:
    return _load(path)


def _load(path: Path) -> Card:
    if path.suffix == ".json":
        return _of_result(path)
    return parse_card(_read(path, ()), path.stem, str(path))


def _of_result(path: Path) -> Card:
    """Return the card that a result was made with."""
    try:
        values = EvaluationResult.read(path).protocol
    except EvaluationFileError as error:
        raise ProtocolError(str(error)) from error
    return parse_card(values, str(values.get("name", path.parent.name)), str(path))


def parse_card(values: Mapping[str, Any], name: str, where: str) -> Card:
    """Return the card of plain data, as of a YAML file or of `Card.resolved`.

    Args:
        values: Section -> field -> value, with `title` and `sources`.
        name: Name of the card.
        where: File that messages name.

    Raises:
        ProtocolError: A field is missing or unknown, a value has the wrong type, or two contradict each other.
    """
    given = {k: v for k, v in values.items() if k not in ("name", "digest", "extends")}
    problems = list(_key_problems(given))
    if problems:
        raise ProtocolError(f"{where}: {'; '.join(problems)}")
    sections = {key: kind(**_tuples(given[key])) for key, kind in SECTIONS.items()}
    try:
        return Card(name=name, title=given["title"], sources=dict(given.get("sources") or {}), **sections)
    except ProtocolError as error:
        raise ProtocolError(f"{where}: {error}") from None


def _path(protocol: str, folder: Path) -> Path:
    """Return the file of a name or path; relative paths are relative to the folder."""
    packaged = _FOLDER / f"{protocol}.yaml"
    try:
        if "/" not in protocol and packaged.is_file():
            return packaged
        path = (folder / Path(protocol).expanduser()).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # too long, of an unknown user, with NUL
        raise ProtocolError(f"{protocol!r:.80} is no name of a protocol or file: {error!s:.80}") from None
    if path.is_dir() and (path / FILE_NAME).is_file():
        path = path / FILE_NAME
    if path.suffix in (".yaml", ".yml", ".json"):
        if path.is_file():
            return path
        raise ProtocolError(f"{path} does not exist; protocols of the package: {', '.join(card_names())}")
    raise UnknownNameError("protocol", protocol, [*card_names(), "a file.yaml"])


def _read(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    """Return the content of a file on top of that of the card which it extends."""
    if path in seen:
        raise ProtocolError(f"{path}: extends: the cards extend each other in a circle")
    try:
        own = read_yaml_file(path).data
    except InvalidInputError as error:
        raise ProtocolError(str(error)) from error
    if not isinstance(own, dict):
        raise ProtocolError(f"{path} is not a protocol: expected sections such as `world:` and `episode:`")
    if "extends" not in own:
        return own
    if not isinstance(own["extends"], str):
        raise ProtocolError(f"{path}: extends is {own['extends']!r}; expected the name or path of a card")
    try:
        extended = _path(own["extends"], path.parent)
    except UnknownNameError as error:
        raise ProtocolError(f"{path}: extends: {error}") from error
    if extended.parent != _FOLDER and not extended.is_relative_to(path.parent.resolve()):
        raise ProtocolError(
            f"{path}: extends: {own['extends']} is not in its folder; put a copy there, and give its name"
        )
    base = _read(extended, (*seen, path))
    sources = base.get("sources") or {}
    if isinstance(sources, dict):
        base["sources"] = {key: text for key, text in sources.items() if not _is_replaced(str(key), own)}
    merged = dict(base)
    for key, value in own.items():
        inner = base.get(key)
        merged[key] = {**inner, **value} if isinstance(inner, dict) and isinstance(value, dict) else value
    return merged


def _is_replaced(source: str, own: Mapping[str, Any]) -> bool:
    """Return whether a card has a value of its own for the field that a source is about."""
    section, _, field = source.partition(".")
    values = own.get(section)
    return bool(field) and isinstance(values, Mapping) and field in values


def _key_problems(values: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the keys of a card."""
    for key in values:
        if key not in SECTIONS and key not in _TOP:
            yield _unknown(str(key), (*SECTIONS, *_TOP))
    if not isinstance(values.get("title"), str):
        yield "title is missing: one line that says what the protocol is"
    for section, kind in SECTIONS.items():
        if section not in values:
            yield f"the section {section} is missing"
            continue
        if not isinstance(values[section], Mapping):
            yield f"{section} is {values[section]!r}; expected fields with values"
            continue
        names = [field.name for field in fields(kind)]
        yield from (_unknown(str(key), names, f"{section}.") for key in values[section] if key not in names)
        needed = [field.name for field in fields(kind) if field.default is MISSING]
        missing = [f"{section}.{name}" for name in needed if name not in values[section]]
        if missing:
            yield f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing (null: not stated)"
    yield from _source_problems(values.get("sources") or {})


def _source_problems(sources: Any) -> Iterator[str]:
    if not isinstance(sources, Mapping):
        yield f"sources is {sources!r}; expected a section or field -> where its values stand"
        return
    known = [*SECTIONS, *(f"{s}.{field.name}" for s, kind in SECTIONS.items() for field in fields(kind))]
    for key, text in sources.items():
        if key not in known:
            yield _unknown(str(key), known, "sources.")
        elif not isinstance(text, str):
            yield f"sources.{key} is {text!r}; expected text"


def _unknown(key: str, valid: Any, prefix: str = "") -> str:
    near = difflib.get_close_matches(key, list(valid), n=1)
    return f"{prefix}{key} is no key of a protocol" + (f"; did you mean {near[0]}?" if near else "")


def _tuples(section: Mapping[str, Any]) -> dict[str, Any]:
    return {k: _tuple(v) for k, v in section.items()}


def _tuple(value: Any) -> Any:
    return tuple(_tuple(v) for v in value) if isinstance(value, list | tuple) else value
