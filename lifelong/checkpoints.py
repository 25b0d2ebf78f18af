"""Checkpoints: nested dictionaries of tensors and plain values, in one safetensors file.

Tensors are stored under their path in the tree; everything else is JSON in the file's header. Nothing is executed on
load, and a file is either complete or does not exist.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from libero_env.storage import atomic_path
from lifelong.errors import CheckpointError

_FORMAT = "lifelong-1"


def save(path: Path, tree: dict[str, Any]) -> None:
    """Write a tree to a file, which replaces an older one in one step.

    Args:
        path: File to write; its folder is created.
        tree: Nested dictionaries (with keys of type str or int), lists and tuples. Leaves are tensors, str, int,
            float, bool or None.

    Raises:
        CheckpointError: A leaf is of another type, or the file cannot be written.
    """
    tensors: dict[str, Tensor] = {}
    plain = _encode(tree, "", tensors)
    tensors.setdefault("", torch.zeros(0))
    try:
        with atomic_path(path) as temporary:
            save_file(tensors, temporary, metadata={"format": _FORMAT, "tree": json.dumps(plain)})
    except (OSError, SafetensorError) as error:
        message = f"cannot write {path}: {error}. Free some space; an older file is intact"
        raise CheckpointError(message) from error


def load(path: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return the tree in a file.

    Args:
        path: File to read.
        device: Device of the tensors.

    Raises:
        CheckpointError: The file is missing, truncated, or was not written by `save`.
    """
    if not path.is_file():
        raise CheckpointError(f"no checkpoint at {path}")
    try:
        with safe_open(path, framework="pt", device=str(device)) as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != _FORMAT:
                raise CheckpointError(
                    f"{path} is a safetensors file of another program (format {metadata.get('format')!r}, "
                    f"expected {_FORMAT!r})"
                )
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        return _decode(json.loads(metadata["tree"]), tensors)
    except (OSError, SafetensorError, KeyError, json.JSONDecodeError) as error:
        raise CheckpointError(
            f"{path} is broken ({error}). Delete it: the run resumes from the checkpoint before it"
        ) from error


def load_weights(module: torch.nn.Module, state: dict[str, Tensor], source: Path | str) -> None:
    """Load weights into a module.

    Args:
        module: Module to load into.
        state: Weights by name.
        source: Where they come from, for error messages.

    Raises:
        CheckpointError: Names or shapes differ; the message names the first difference. The module is unchanged.
    """
    own = module.state_dict()
    for name, tensor in own.items():
        if name not in state:
            raise CheckpointError(f"{source} has no {name}: it was written with another policy configuration")
        if state[name].shape != tensor.shape:
            raise CheckpointError(
                f"{source}: {name} has shape {tuple(state[name].shape)}; the policy expects {tuple(tensor.shape)}"
            )
    extra = sorted(set(state) - set(own))
    if extra:
        raise CheckpointError(f"{source} has {extra[0]}, which the policy does not have")
    module.load_state_dict(state)


def _encode(node: Any, path: str, tensors: dict[str, Tensor]) -> Any:
    if isinstance(node, Tensor):
        tensors[path] = node.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": path}
    if isinstance(node, dict):
        items = [[k, _encode(v, f"{path}/{k}", tensors)] for k, v in node.items()]
        if not all(isinstance(k, str | int) for k, _ in items):
            raise CheckpointError(f"keys at {path or '/'} are not all str or int: {list(node)[:3]}")
        return {"dict": items}
    if isinstance(node, list | tuple):
        return {type(node).__name__: [_encode(v, f"{path}/{i}", tensors) for i, v in enumerate(node)]}
    if node is None or isinstance(node, str | int | float | bool):
        return {"value": node}
    raise CheckpointError(f"cannot store a {type(node).__name__} at {path}")


def _decode(node: dict[str, Any], tensors: dict[str, Tensor]) -> Any:
    ((kind, content),) = node.items()
    if kind == "tensor":
        return tensors[content]
    if kind == "dict":
        return {k: _decode(v, tensors) for k, v in content}
    if kind in ("list", "tuple"):
        values: Iterator[Any] = (_decode(v, tensors) for v in content)
        return list(values) if kind == "list" else tuple(values)
    return content
