"""Precision, deterministic kernels, compilation and memory allocation of network computations."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import cache

import torch
from torch.nn.attention import SDPBackend, sdpa_kernel

from lifelong.errors import ConfigError, TrainingError

_CUBLAS = "CUBLAS_WORKSPACE_CONFIG"
_PROBE = """
import torch
torch.set_num_threads(1)
layer, x = torch.nn.Linear(384, 64), torch.randn(64, 384)
with torch.autocast("cpu", torch.bfloat16):
    layer(x).sum().backward()
"""


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Return the autocast context of a precision.

    Args:
        precision: `bf16`, `fp32`, `fp32_strict`, or `auto`: bf16 where the processor supports it.
    """
    if precision == "auto":
        if device.type == "cuda":
            fast = torch.cuda.is_bf16_supported()
        else:
            fast = device.type == "cpu" and bf16_runs_on_cpu()
        precision = "bf16" if fast else "fp32"
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bf16")


@contextmanager
def float32_products(precision: str) -> Iterator[None]:
    """Keep a GPU from rounding factors of float32 products to TF32's ten bits within the context, if `fp32_strict`.

    By PyTorch's defaults cuDNN does so in convolutions and recurrent layers; matrix products are in float32.
    """
    before = torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32
    if precision == "fp32_strict":
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32, torch.backends.cuda.matmul.allow_tf32 = before


@cache
def bf16_runs_on_cpu() -> bool:
    """Return whether bfloat16 is fast on this CPU and a bfloat16 product does not crash.

    Some virtual machines report AMX and then kill the process at its first instruction, so a product is tried in
    another process, once, which takes a few seconds. Where it fails, setting the environment variable
    ONEDNN_MAX_CPU_ISA=AVX512_CORE_BF16 before Python starts makes bfloat16 usable nevertheless.
    """
    if not torch.ops.mkldnn._is_mkldnn_bf16_supported():
        return False
    try:
        probe = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return probe.returncode == 0


@contextmanager
def deterministic(on: bool) -> Iterator[None]:
    """Use deterministic kernels within the context, and restore the settings afterwards.

    CPU kernels are deterministic anyway. On a GPU it costs speed: sums without atomics, a fixed cuBLAS workspace
    (which cuBLAS reads at its first use, so enter the context before), attention as plain matrix products.

    Args:
        on: Whether to change anything.

    Raises:
        TrainingError: An operation has no deterministic kernel on this device; the message names it.
    """
    if not on:
        yield
        return
    before = torch.are_deterministic_algorithms_enabled()
    warns = torch.is_deterministic_algorithms_warn_only_enabled()
    benchmark, workspace = torch.backends.cudnn.benchmark, os.environ.get(_CUBLAS)
    os.environ.setdefault(_CUBLAS, ":4096:8")
    torch.backends.cudnn.benchmark = False
    torch.use_deterministic_algorithms(True)
    try:
        with sdpa_kernel(SDPBackend.MATH) if torch.cuda.is_available() else nullcontext():
            yield
    except RuntimeError as error:
        if "does not have a deterministic implementation" not in str(error):
            raise
        raise TrainingError(
            f"deterministic=true, but {str(error).splitlines()[0]} Use device=cpu or deterministic=false"
        ) from error
    finally:
        torch.use_deterministic_algorithms(before, warn_only=warns)
        torch.backends.cudnn.benchmark = benchmark
        if workspace is None:
            os.environ.pop(_CUBLAS, None)


def check_precision(policy: torch.nn.Module, device: torch.device, precisions: Mapping[str, str]) -> None:
    """Check that a policy's layers run in the given precisions.

    Args:
        precisions: Key of the configuration -> precision, see `autocast`.

    Raises:
        ConfigError: Recurrent layers have no bfloat16 kernel on this CPU.
    """
    asked = [key for key, precision in precisions.items() if precision == "bf16"]
    recurrent = any(isinstance(module, torch.nn.RNNBase) for module in policy.modules())
    if asked and recurrent and device.type == "cpu" and not bf16_runs_on_cpu():
        raise ConfigError(f"{asked[0]}=bf16: this CPU has no bfloat16 for recurrent layers; use auto or fp32")


def check_compiler(device: torch.device) -> None:
    """Compile a small function, so that a missing compiler is reported before a run starts.

    Args:
        device: Device to compile for.

    Raises:
        ConfigError: Compilation does not work on this machine.
    """
    try:
        torch.compile(lambda x: (x.sin() + 1).sum())(torch.ones(64, device=device))
    except (RuntimeError, ImportError, OSError) as error:
        needed = "Triton and a C compiler" if device.type == "cuda" else "a C++ compiler such as g++"
        reason = next((line for line in reversed(str(error).strip().splitlines()) if line.strip()), "")
        raise ConfigError(
            f"torch.compile does not work here; it needs {needed} ({type(error).__name__}: {reason.strip()}). "
            "Install that, or use train.compile=off"
        ) from error


def keep_freed_memory() -> bool:
    """Make glibc's allocator keep freed memory, for the whole process; with other allocators do nothing.

    By default it returns large blocks to the system, which zeroes every page again when the next step needs memory
    for its activations. With the paper's policy on two cores that took more than a quarter of a step
    (experiments/benchmarks). The settings are those of mallopt(3).

    Returns:
        Whether the allocator accepted the settings.
    """
    trim_threshold, top_pad, mmap_max = -1, -2, -4
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):  # not glibc
        return False
    return all(mallopt(*pair) for pair in ((mmap_max, 0), (trim_threshold, 2**31 - 1), (top_pad, 2**28)))
