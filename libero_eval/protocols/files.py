"""Files of protocols: the package's `data/NAME.yaml`, and a user's own, which may extend another."""

from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any

from libero_env.errors import InvalidInputError, UnknownNameError
from libero_env.storage import read_yaml_file
from libero_eval.evaluation_file import FILE_NAME, EvaluationResult
from libero_eval.protocols.protocol import CHANGED, SECTIONS, EvalProtocol
from lifelong.errors import EvaluationFileError, ProtocolError

_FOLDER = Path(str(resources.files("libero_eval"))) / "protocols" / "data"


def protocol_names() -> tuple[str, ...]:
    """Return the names of the package's protocols, `libero` first."""
    return tuple(sorted((path.stem for path in _FOLDER.glob("*.yaml")), key=lambda n: (n != "libero", n)))


def load_protocol(protocol: str | Path) -> EvalProtocol:
    """Return a protocol.

    Args:
        protocol: Name of one of the package's protocols, or path of a YAML file, or of a result, `eval.json`.

    Raises:
        UnknownNameError: There is no such protocol.
        ProtocolError: The file is not a valid protocol; the message names the file and the keys.
    """
    path = _path(str(protocol), Path.cwd())
    return _packaged(path) if path.parent == _FOLDER else _load(path)


def _load(path: Path) -> EvalProtocol:
    if path.suffix != ".json":
        return EvalProtocol.read({**_content(path, ()), "name": path.stem}, str(path))
    try:
        return EvalProtocol.read(EvaluationResult.read(path).protocol, str(path))
    except EvaluationFileError as error:
        raise ProtocolError(str(error)) from error


_packaged = lru_cache(maxsize=64)(_load)


def _path(protocol: str, folder: Path) -> Path:
    """Return the file of a name or path; relative paths are relative to the folder."""
    packaged = _FOLDER / f"{protocol}.yaml"
    try:
        if "/" not in protocol and packaged.is_file():
            return packaged
        path = (folder / Path(protocol).expanduser()).resolve()
    except (OSError, RuntimeError, ValueError) as error:  # too long, of an unknown user, with NUL
        raise ProtocolError(f"{protocol!r:.80} is not a name of a protocol or file: {error!s:.80}") from None
    if path.is_dir() and (path / FILE_NAME).is_file():
        path = path / FILE_NAME
    if path.suffix in (".yaml", ".yml", ".json"):
        if path.is_file():
            return path
        raise ProtocolError(f"{path} does not exist; protocols of the package: {', '.join(protocol_names())}")
    raise UnknownNameError("protocol", protocol, [*protocol_names(), "a file.yaml"])


def _content(path: Path, seen: tuple[Path, ...]) -> dict[str, Any]:
    """Return the content of a file on top of that of the protocol which it extends."""
    if path in seen:
        raise ProtocolError(f"{path}: extends: the protocols extend each other in a circle")
    try:
        content = read_yaml_file(path).data
    except InvalidInputError as error:
        raise ProtocolError(str(error)) from error
    if not isinstance(content, dict):
        raise ProtocolError(f"{path} is not a protocol: expected sections such as `world:` and `episode:`")
    if "changes" in content:
        raise ProtocolError(f"{path}: changes is a key of results; write the values into their sections")
    if "extends" not in content:
        return content
    base = _content(_extended(path, content["extends"]), (*seen, path))
    own = [
        f"{name}.{key}" for name in SECTIONS if isinstance(part := content.get(name), dict) for key in part
    ]
    if isinstance(sources := base.get("sources"), dict):  # not those of fields that have another value here
        here = told if isinstance(told := content.get("sources"), dict) else {}
        marks = {key: f"{path.name}'s own" for key in own if key.partition(".")[0] not in here}
        base["sources"] = {key: text for key, text in sources.items() if key not in own} | marks
    if own and "title" not in content and isinstance(base.get("title"), str):
        base["title"] = base["title"].removesuffix(CHANGED) + CHANGED
    merged = dict(base)
    for key, value in content.items():
        inherited = base.get(key)
        if isinstance(inherited, dict) and isinstance(value, dict):
            value = {**inherited, **value}
        merged[key] = value
    return merged


def _extended(path: Path, name: Any) -> Path:
    """Return the file that a file extends: one of the package, or one in its own folder."""
    if not isinstance(name, str):
        raise ProtocolError(f"{path}: extends is {name!r}; expected the name or path of a protocol")
    try:
        extended = _path(name, path.parent)
    except UnknownNameError as error:
        raise ProtocolError(f"{path}: extends: {error}") from error
    if extended.parent != _FOLDER and not extended.is_relative_to(path.parent.resolve()):
        raise ProtocolError(
            f"{path}: extends: {name} is not in its folder; put a copy there, and give its name"
        )
    return extended
