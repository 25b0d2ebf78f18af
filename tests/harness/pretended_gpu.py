"""A device `cuda` on a machine without one: values are computed on the CPU, under the rules of a GPU.

Import this module before torch, in a process of its own, and call `pretend`: it changes torch for good. Then

* an operation on tensors of both devices raises; numbers without axes, and indices, may be on the CPU;
* `.numpy()` of a tensor on the GPU raises;
* what is copied to the host asynchronously is there when the host waits next; until then the copy holds other values;
* `SEEN` counts the kernels that would be launched, and has the places where the host would wait for the GPU.

Autograd's thread of the device, autocast's lists and foreach kernels are PyTorch's own for CUDA. Speed, rounding,
compilation, CUDA graphs, cuDNN and NCCL are not covered. Asynchronous copies to the GPU count as no wait; of more than
64 KiB that are not page-locked they may be one (CUDA programming guide, "Asynchronous concurrent execution").

It needs g++ and the PyTorch of constraints.txt, on whose internals it relies.
"""

import ctypes
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

# The guard says which device and stream are current; the hooks, which torch makes when it first needs them, that there
# is a device.
_DEVICE = """
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
using namespace c10;
constexpr auto kind = DeviceType::CUDA;
struct Guard final : impl::NoOpDeviceGuardImpl<kind> {
  Device getDevice() const override { return {kind, 0}; }
  Device exchangeDevice(Device) const override { return {kind, 0}; }
  Stream getStream(Device) const noexcept override { return Stream(Stream::DEFAULT, {kind, 0}); }
  Stream exchangeStream(Stream) const noexcept override { return Stream(Stream::DEFAULT, {kind, 0}); }
};
struct Hooks final : at::CUDAHooksInterface {
  Hooks(at::CUDAHooksArgs) {}
  void init() const override {}
  bool hasCUDA() const override { return true; }
  bool isAvailable() const override { return true; }
  bool isBuilt() const override { return true; }
  bool hasPrimaryContext(DeviceIndex) const override { return true; }
  DeviceIndex deviceCount() const override { return 1; }
  DeviceIndex getCurrentDevice() const override { return 0; }
};
C10_REGISTER_GUARD_IMPL(CUDA, Guard)
namespace at { C10_REGISTER_CLASS(CUDAHooksRegistry, CUDAHooks, Hooks) }
"""


def _register_device() -> None:
    assert "torch" not in sys.modules, "import this module before torch"
    torch_folder = Path(find_spec("torch").origin).parent
    ctypes.CDLL(str(torch_folder / "lib/libtorch_cpu.so"), mode=ctypes.RTLD_GLOBAL)
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder, "device.so")
        flags = [
            "-shared", "-fPIC", "-std=c++20", f"-I{torch_folder}/include", "-x", "c++", "-", "-o", library
        ]  # fmt: skip
        subprocess.run(["g++", *flags], input=_DEVICE, text=True, check=True)
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


_register_device()

import torch  # noqa: E402
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing  # noqa: E402

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
aten = torch.ops.aten

_INDEXED = {aten.index, aten.index_put, aten.index_put_, aten._unsafe_index, aten._index_put_impl_}
_WAITING = {"_local_scalar_dense", "equal", "nonzero", "masked_select", "_unique2", "unique_dim", "bincount"}
_NO_KERNEL = {"empty", "empty_strided", "empty_like", "new_empty", "new_empty_strided", "_unsafe_view"}
_PATCHED = {  # functions of torch.cuda that ask the driver
    "is_available": True,
    "is_initialized": True,
    "_lazy_init": None,
    "is_bf16_supported": True,
    "current_device": 0,
    "device_count": 1,
    "get_device_name": "pretended GPU",
    "mem_get_info": (2**36, 2**36),
    "max_memory_allocated": 0,
    "reset_peak_memory_stats": None,
    "get_rng_state": torch.zeros(16, dtype=torch.uint8),
    "set_rng_state": None,
    "manual_seed_all": None,
    "_is_in_bad_fork": False,
    "is_current_stream_capturing": False,
}


@dataclass
class Seen:
    """What a GPU would have been asked to do.

    Attributes:
        launches: Number of kernels.
        waits: Operation and place of each wait of the host.
        uploads: Place of each operation on the GPU that reads a tensor of the host.
        unsafe: Place of each asynchronous copy to the host.
        late: Those of them that have not arrived, each with its values.
    """

    launches: int = 0
    waits: list[str] = field(default_factory=list)
    uploads: list[str] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    late: list[tuple[torch.Tensor, torch.Tensor]] = field(default_factory=list)

    def wait(self, operation: str) -> None:
        self.waits.append(f"{operation} at {place()}")
        for target, values in self.late:
            target.copy_(values)
        self.late.clear()


SEEN = Seen()


def place() -> str:
    """Return the innermost line of the project's packages that is being executed."""
    frame = sys._getframe(1)
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.startswith(("lifelong", "libero_e")):
            return f"{module}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"


class GpuTensor(torch.Tensor):
    """A tensor that says it is on the GPU; its values are in `host`, on the CPU."""

    host: torch.Tensor

    @staticmethod
    def __new__(cls, host: torch.Tensor) -> "GpuTensor":
        layout = {"strides": host.stride(), "storage_offset": host.storage_offset(), "dtype": host.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, host.size(), device=GPU, **layout)
        made.host = host
        return made

    def __tensor_flatten__(self) -> tuple[list[str], None]:  # so that Module.to exchanges whole tensors
        return ["host"], None

    @staticmethod
    def __tensor_unflatten__(inner: dict, *_: Any) -> "GpuTensor":
        return GpuTensor(inner["host"])

    def __repr__(self, **_: Any) -> str:
        return f"cuda({self.host!r})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    def tolist(self) -> Any:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _execute(func, args, kwargs or {})


class _PretendedMode(TorchDispatchMode):
    """Sees what has no argument on the GPU: new tensors, and copies from the CPU."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:  # nothing is compiled, and each operation would cost more
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        return _execute(func, args, kwargs or {})


def _execute(func: Any, args: tuple, kwargs: dict) -> Any:
    """Carry out an operation of any device on the CPU, and note what it would do to a GPU."""
    operation = func.overloadpacket
    tensors = list(_tensors((args, *kwargs.values())))
    on_gpu = any(isinstance(x, GpuTensor) for x in tensors)
    to = kwargs.get("device")
    to_gpu = on_gpu if to is None else torch.device(to).type == "cuda"
    pinned = kwargs.get("pin_memory") or operation is aten._pin_memory
    if not (on_gpu or to_gpu or pinned or operation is aten.is_pinned):
        return func(*args, **kwargs)
    if operation is aten.is_pinned:
        return False
    if operation is aten._pin_memory:
        return args[0].clone()
    if not all(isinstance(x, GpuTensor) for x in tensors):
        SEEN.uploads.append(place())
    _check(operation, tensors, (*args, *kwargs.values()))
    own = {name: x for name, x in kwargs.items() if name != "pin_memory"}
    own |= {"device": CPU} if "device" in own else {}
    out = func(*_each(_host, args), **{name: _each(_host, x) for name, x in own.items()})
    _note(func, args, kwargs, out, to_gpu)
    if operation is aten._to_copy and not to_gpu:
        return out
    if on_gpu and operation is aten.copy_:
        return args[0]
    wrapped = _each(lambda x: GpuTensor(x) if type(x) is torch.Tensor else x, out) if to_gpu else out
    return return_and_correct_aliasing(func, args, kwargs, wrapped) if on_gpu else wrapped


def _tensors(arguments: tuple | list) -> Iterator[torch.Tensor]:
    for x in arguments:
        if isinstance(x, torch.Tensor):
            yield x
        elif isinstance(x, tuple | list):
            yield from _tensors(x)


def _each(change: Callable[[Any], Any], x: Any) -> Any:
    """Change a value, or each in lists and tuples: those of operations hold no other containers."""
    return type(x)(_each(change, part) for part in x) if type(x) in (tuple, list) else change(x)


def _host(x: Any) -> Any:
    return x.host if isinstance(x, GpuTensor) else x


def _check(operation: Any, tensors: list[torch.Tensor], arguments: tuple) -> None:
    """Raise what CUDA raises."""
    if any(isinstance(x, torch.Generator) and x.device == CPU for x in arguments):
        raise RuntimeError(
            f"Expected a 'cuda' device type for generator but found 'cpu' ({operation}, {place()})"
        )
    mixed = any(not isinstance(x, GpuTensor) and x.dim() for x in tensors)
    if mixed and operation not in {aten._to_copy, aten.copy_, *_INDEXED}:
        devices = ", ".join(f"{tuple(x.shape)} on {x.device}" for x in tensors)
        raise RuntimeError(
            f"Expected all tensors to be on the same device: {operation} of {devices} at {place()}"
        )


def _note(func: Any, args: tuple, kwargs: dict, out: Any, to_gpu: bool) -> None:
    """Count the operation, and note whether the host waits for it."""
    operation = func.overloadpacket
    name = operation.__name__
    SEEN.launches += not (func.is_view or name in _NO_KERNEL or name == "_local_scalar_dense")
    if operation in (aten._to_copy, aten.copy_):
        target, source = (out, args[0]) if operation is aten._to_copy else args[:2]
        up = to_gpu if operation is aten._to_copy else isinstance(target, GpuTensor)
        asynchronous = kwargs.get("non_blocking") or (operation is aten.copy_ and True in args[2:])
        if up != isinstance(source, GpuTensor) and not asynchronous:
            SEEN.wait("copy to the " + ("GPU" if up else "host"))
        elif asynchronous and not up and isinstance(source, GpuTensor):
            SEEN.unsafe.append(place())
            SEEN.late.append((target, target.clone()))
            target.fill_(113)
    elif operation in _INDEXED:
        for index in args[1]:
            if isinstance(index, GpuTensor) and index.dtype in (torch.bool, torch.uint8):
                SEEN.wait("index by a mask")
            elif index is not None and not isinstance(index, GpuTensor) and index.dim():
                SEEN.wait("index on the CPU")
    elif name in _WAITING or func is aten.repeat_interleave.Tensor:
        SEEN.wait(name)


def pretend() -> None:
    """Make `cuda` a device, for the rest of the process."""
    for name, value in _PATCHED.items():
        setattr(torch.cuda, name, lambda *_, value=value, **__: value)
    lstm = torch._VF.lstm  # is cuDNN's; without it, step by step
    torch._VF.lstm = lambda x, *args: (
        torch._decomp.decompositions.lstm_impl if isinstance(x, GpuTensor) else lstm
    )(x, *args)
    torch.cuda.synchronize = lambda *_: SEEN.wait("synchronize")
    for module in (torch.utils._foreach_utils, sys.modules["torch.optim.optimizer"]):
        module._foreach_supported_types.append(GpuTensor)
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device="cuda") copies through the mode
    _PretendedMode().__enter__()
