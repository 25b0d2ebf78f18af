"""Checkpoints: nested dictionaries of tensors and plain values, in one safetensors file with a checksum.

Tensors are stored under their path in the tree; everything else is JSON in the file's header, with a SHA-256 over all
of it. Equal trees give equal files. Nothing is executed on load, a file is either complete or does not exist, and one
that was damaged later is refused.

A file may refer to tensors of other checkpoints in its folder instead of holding them again: what an algorithm keeps of
earlier tasks is then stored once, not once for each later task. The checksum is over these tensors, too.
"""

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import safetensors.torch
import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor

from libero_env.storage import atomic_path
from libero_env.text import show_bytes
from lifelong.errors import CheckpointError, DamagedCheckpointError

FORMAT = "lifelong-checkpoint/1"
MAX_DEPTH = 64  # dictionaries within dictionaries
MAX_TREE = 64 << 20  # [bytes] of everything but the tensors

_REFERRED = 1024  # [bytes] of a tensor from which on a reference is smaller
_ENTRY = "lifelong"  # the only one in the header: the library writes several in random order
_DTYPES = (
    *(torch.float32, torch.float64, torch.float16, torch.bfloat16),
    *(torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool),
)


def save(
    path: Path, tree: dict[str, Any], *, previous: Path | None = None, beside: Path | None = None
) -> None:
    """Write a tree to a file, which replaces an older one in one step. It is on disk when this returns.

    Args:
        path: File to write; its folder is created.
        tree: Nested dictionaries (with keys of type str or int), lists and tuples. Leaves are tensors, str, int,
            float, bool or None.
        previous: Name that an older file is given, in the same folder; None for one that is replaced.
        beside: Checkpoint in the same folder, to whose tensors the file may refer.

    Raises:
        CheckpointError: A leaf is of another type, or the file cannot be written.
    """
    tensors: dict[str, Tensor] = {"": torch.zeros(0)}
    plain = _encode(tree, "", tensors, 0)
    text = json.dumps(plain, separators=(",", ":"))
    if len(text) > MAX_TREE:
        raise CheckpointError(f"cannot store {show_bytes(len(text))} besides tensors in {path}")
    head = {"format": FORMAT, "sha256": _digest(text, tensors), "tree": plain}
    if elsewhere := _stored_beside(beside, tensors):
        head["elsewhere"] = elsewhere
        tensors = {name: tensor for name, tensor in tensors.items() if name not in elsewhere}
    content = safetensors.torch.save(tensors, {_ENTRY: json.dumps(head, separators=(",", ":"))})
    try:
        with atomic_path(path, fsync=True) as temporary:
            temporary.write_bytes(content)
            if previous is not None and path.exists():
                os.replace(path, previous)
    except OSError as error:
        message = f"cannot write {path}: {error}. Free some space; an older file is intact"
        raise CheckpointError(message) from error


def load(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return the tree in a file.

    Args:
        device: Device of the tensors.

    Raises:
        DamagedCheckpointError: The file is damaged, or was not written by `save`.
        CheckpointError: The file is missing.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        _check_size(path)
        with safe_open(path, framework="pt", device="cpu") as file:
            head = _head(file.metadata() or {})
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        tensors |= _tensors_of(path.parent, head.get("elsewhere", {}))
        text = json.dumps(head["tree"], separators=(",", ":"))
        if _digest(text, tensors) != head["sha256"]:
            parts = ", or that of ".join(["its content", *sorted(set(head.get("elsewhere", {}).values()))])
            raise ValueError(f"{parts} does not have the checksum that it was written with")
        placed = {name: tensor.to(device) for name, tensor in tensors.items()}
        tree = _decode(head["tree"], placed)
        if not isinstance(tree, dict):
            raise ValueError("it holds no dictionary")
        return tree
    except (OSError, SafetensorError, ValueError, RecursionError) as error:
        raise DamagedCheckpointError(f"{path} is broken, or is no checkpoint ({error})") from error


@dataclass(frozen=True)
class Weights:
    """Form of tensors by the name of a weight of the policy, each of that weight's shape; see `check`.

    Attributes:
        complete: Whether every weight of the policy, buffers included, must be there.
    """

    complete: bool = False


def check(tree: Any, form: Any, source: Path | str, policy: torch.nn.Module | None = None) -> None:
    """Check that a tree from a file has the form that the code which uses it relies on.

    Args:
        tree: Tree, or a part of one.
        form: Type of the value; `{type: form}` for a dictionary of any keys of the type; `{name: form}` for one with
            exactly these keys; `[form]` for a list; a tuple of forms for alternatives, of which the last one is
            reported; None for None; `Weights` for weights of the policy. Numbers in tensors must be finite, except
            where the policy's own are not.
        source: Where it comes from, for error messages.
        policy: Policy that `Weights` refer to.

    Raises:
        CheckpointError: It has another form; the message names the first difference.
    """
    own = {} if policy is None else policy.state_dict()
    if (problem := _difference(tree, form, own)) is not None:
        raise CheckpointError(f"{source} does not fit this run: {problem}")


def load_weights(module: torch.nn.Module, state: dict[str, Tensor], source: Path | str) -> None:
    """Load weights into a module.

    Args:
        module: Module to load into.
        state: Weights by name.
        source: Where they come from, for error messages.

    Raises:
        CheckpointError: Names, shapes or kinds of numbers differ, or weights are not finite; the message names the
            first difference. The module is unchanged.
    """
    check(state, Weights(complete=True), source, module)
    module.load_state_dict(state)


def _encode(node: Any, path: str, tensors: dict[str, Tensor], depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise CheckpointError(f"cannot store what is nested deeper than {MAX_DEPTH}, at {path[:80]}")
    if isinstance(node, Tensor):
        if node.dtype not in _DTYPES or node.layout != torch.strided:
            raise CheckpointError(f"cannot store a tensor of {node.dtype}, {node.layout}, at {path}")
        while path in tensors:  # the keys 1 and "1"
            path += "'"
        tensors[path] = node.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": path}
    if isinstance(node, dict):
        if not all(isinstance(k, str | int) and not isinstance(k, bool) for k in node):
            raise CheckpointError(f"keys at {path or '/'} are not all str or int: {list(node)[:3]}")
        return {"dict": [[k, _encode(v, f"{path}/{k}", tensors, depth + 1)] for k, v in node.items()]}
    if isinstance(node, list | tuple):
        kind = "list" if isinstance(node, list) else "tuple"
        return {kind: [_encode(v, f"{path}/{i}", tensors, depth + 1) for i, v in enumerate(node)]}
    if node is None or isinstance(node, str | int | float | bool):
        return {"value": node}
    raise CheckpointError(f"cannot store a {type(node).__name__} at {path}")


def _decode(node: Any, tensors: Mapping[str, Tensor], depth: int = 0) -> Any:
    """Return the tree that `_encode` described; raise ValueError where the description is not one of its."""
    if depth > MAX_DEPTH:
        raise ValueError(f"its tree is nested deeper than {MAX_DEPTH}")
    try:
        ((kind, content),) = node.items()
        if kind == "tensor":
            return tensors[content]
        if kind == "dict":
            found = {key: _decode(value, tensors, depth + 1) for key, value in content}
            if len(found) == len(content) and {type(key) for key in found} <= {str, int}:
                return found
        elif kind in ("list", "tuple") and isinstance(content, list):
            values = [_decode(value, tensors, depth + 1) for value in content]
            return values if kind == "list" else tuple(values)
        elif kind == "value" and (content is None or isinstance(content, str | int | float)):
            return content
    except (AttributeError, KeyError, TypeError):
        pass
    raise ValueError("its tree is not valid")


def _head(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Return the entry of the header with the tree; raise ValueError where there is none."""
    if _ENTRY not in metadata:
        raise ValueError("a safetensors file of another program")
    head = json.loads(metadata[_ENTRY])
    if not isinstance(head, dict) or head.get("format") != FORMAT or not {"sha256", "tree"} <= head.keys():
        stated = head.get("format") if isinstance(head, dict) else None
        raise ValueError(f"the format is {stated!r}; this version reads {FORMAT!r}")
    return head


def _stored_beside(beside: Path | None, tensors: Mapping[str, Tensor]) -> dict[str, str]:
    """Return the names of the files that hold large tensors under their names, to the bit, as a checkpoint has them."""
    if beside is None or not beside.is_file():
        return {}
    large = {name: tensor for name, tensor in tensors.items() if tensor.nbytes >= _REFERRED}
    try:
        with safe_open(beside, framework="pt", device="cpu") as file:
            where = _head(file.metadata() or {}).get("elsewhere", {}) | dict.fromkeys(
                file.keys(), beside.name
            )
        where = {name: place for name, place in where.items() if name in large}
        there = _tensors_of(beside.parent, where)
    except (OSError, SafetensorError, ValueError):  # which is found out when it is loaded
        return {}
    return {name: where[name] for name, tensor in there.items() if _same_bits(tensor, large[name])}


def _same_bits(a: Tensor, b: Tensor) -> bool:
    if a.dtype != b.dtype or a.shape != b.shape:
        return False
    return torch.equal(a.reshape(-1).view(torch.uint8), b.reshape(-1).view(torch.uint8))


def _tensors_of(folder: Path, where: Any) -> dict[str, Tensor]:
    """Return tensors of files in a folder, given each one's file; raise ValueError where one is not there."""
    if not isinstance(where, dict) or not all(isinstance(name, str) for name in where.values()):
        raise ValueError("what it says of other files is not valid")
    found: dict[str, Tensor] = {}
    for name in sorted(set(where.values())):
        path = folder / name
        if Path(name).name != name or path.suffix != ".safetensors" or path.is_symlink():
            raise ValueError(f"it refers to {name!r}, which is not a checkpoint of its folder")
        if not path.is_file():
            raise ValueError(f"it needs {name} beside it, which is missing")
        _check_size(path)
        with safe_open(path, framework="pt", device="cpu") as file:
            found |= {key: file.get_tensor(key) for key, place in where.items() if place == name}
    return found


def _digest(text: str, tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of a tree: of its description, and of each tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(json.dumps([name, str(tensor.dtype), list(tensor.shape)]).encode())
        digest.update(memoryview(tensor.reshape(-1).view(torch.uint8).numpy()))
    return digest.hexdigest()


def _check_size(path: Path) -> None:
    """Raise ValueError where a header or a file is larger than anything that `save` writes here."""
    size = path.stat().st_size
    memory = psutil.virtual_memory().total
    if size > memory:
        raise ValueError(f"it has {show_bytes(size)}, and this machine a memory of {show_bytes(memory)}")
    with open(path, "rb") as file:
        header = int.from_bytes(file.read(8), "little")
    if not 2 <= header <= size - 8:
        raise ValueError("it is truncated, or of another kind")


def _difference(value: Any, form: Any, own: Mapping[str, Tensor], path: str = "") -> str | None:
    """Return the first difference between a tree and its form; None where there is none."""
    if isinstance(form, tuple):
        found = [_difference(value, one, own, path) for one in form]
        return None if None in found else found[-1]
    if isinstance(form, Weights):
        return _weights_difference(value, form, own, path)
    if isinstance(form, dict):
        return _dict_difference(value, form, own, path)
    if isinstance(form, list):
        return _dict_difference(
            dict(enumerate(value)) if isinstance(value, list) else value, {int: form[0]}, own, path
        )
    kind = type(None) if form is None else form
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        return f"{path or 'it'} is of type {type(value).__name__}; expected {kind.__name__}"
    if isinstance(value, Tensor) and not _is_finite(value):
        return f"{path} has values that are not finite"
    return None


def _dict_difference(value: Any, form: Any, own: Mapping[str, Tensor], path: str) -> str | None:
    if not isinstance(value, dict):
        return f"{path or 'it'} is of type {type(value).__name__}; expected dict"
    first = next(iter(form), None)
    if isinstance(first, type):
        parts = dict.fromkeys(value, form[first])
        if odd := [key for key in value if type(key) is not first]:
            return f"{path or 'it'} has the key {odd[0]!r}; expected {first.__name__}"
    else:
        parts = form
        if odd := sorted(map(repr, form.keys() ^ value.keys())):
            return f"{path or 'it'} has the keys {', '.join(map(str, value))}; missing or unknown: {odd[0]}"
    for key, part in parts.items():
        problem = _difference(value[key], part, own, f"{path}/{key}")
        if problem is not None:
            return problem
    return None


def _weights_difference(value: Any, form: Weights, own: Mapping[str, Tensor], path: str) -> str | None:
    if not isinstance(value, dict):
        return f"{path or 'it'} is of type {type(value).__name__}; expected dict"
    for name, tensor in value.items():
        if name not in own:
            return f"{path}/{name} is no weight of the policy"
        if not isinstance(tensor, Tensor):
            return f"{path}/{name} is no tensor"
        if tensor.shape != own[name].shape:
            return f"{path}/{name} has shape {tuple(tensor.shape)}; the policy's has {tuple(own[name].shape)}"
        if form.complete and tensor.is_floating_point() != own[name].is_floating_point():
            return f"{path}/{name} is of {tensor.dtype}; the policy's is of {own[name].dtype}"
        if not _is_finite(tensor) and _is_finite(own[name]):
            return f"{path}/{name} has values that are not finite: training had diverged"
    if form.complete and (missing := sorted(own.keys() - value.keys())):
        return f"{path or 'it'} lacks {missing[0]}: it is of another configuration of the policy"
    return None


def _is_finite(tensor: Tensor) -> bool:
    return not tensor.is_floating_point() or bool(torch.isfinite(tensor).all())
