"""Permission for `torch.load` to read the arrays in the original's files."""

import codecs
import sys
from typing import Any

import numpy as np


def allow_arrays() -> None:
    """Let a bare `torch.load` read NumPy arrays, as initial states and results of the original are stored.

    Since PyTorch 2.6 it refuses them unless their classes are registered. Nothing is done before the client has
    imported torch. The registered names build arrays of numbers and execute nothing else.
    """
    torch: Any = sys.modules.get("torch")
    register = getattr(getattr(torch, "serialization", None), "add_safe_globals", None)
    if register is None:
        return
    rebuild = np.zeros(0).__reduce__()[0]
    numbers = [type(np.dtype(code)) for code in ("f8", "f4", "i8", "i4", "u1", "?")]
    scalar = np.float64(0).__reduce__()[0]
    named = [(rebuild, f"numpy.{core}.multiarray._reconstruct") for core in ("core", "_core")]
    named += [(scalar, f"numpy.{core}.multiarray.scalar") for core in ("core", "_core")]
    register([*named, np.ndarray, np.dtype, codecs.encode, *numbers])
