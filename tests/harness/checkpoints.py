"""Checkpoints that were not written by the package."""

import json
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor

from lifelong import checkpoints


def write_forged(path: Path, tensors: dict[str, Tensor], tree: Any) -> None:
    """Write a checkpoint of any tree, with the checksum that `load` expects."""
    digest = checkpoints._digest(json.dumps(tree, separators=(",", ":")), tensors)
    head = {"format": checkpoints.FORMAT, "sha256": digest, "tree": tree}
    save_file(tensors, path, {"lifelong": json.dumps(head)})
