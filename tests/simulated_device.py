"""A simulated device for tests: all tensors stay on the CPU, but those "on the device" cannot be mixed with others.

Under `SimulatedDevice` tensors that were moved to `DEVICE` or created there, and all results computed from them,
report `DEVICE` as their device. Operations that fail on CUDA raise `MixedDevicesError`: those on tensors of both
devices (except CPU scalars), indices of the other device, `numpy()` of a tensor on the device, and random numbers
from a CPU generator.
"""

import threading
from contextlib import contextmanager

import numpy as np
import torch
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree

DEVICE = "cuda"
_MARK = "_on_simulated_device"
_MIXING_ALLOWED = (
    "_has_compatible_shallow_copy_type",
    "copy_",
    "set_",
    "save",
    "is_tensor",
    "result_type",
    "promote_types",
    "data_ptr",
)
"""functions that accept tensors of different devices"""
_FLOATS_ONLY = {
    "matmul",
    "mm",
    "bmm",
    "mv",
    "addmm",
    "addmv",
    "baddbmm",
    "einsum",
    "dot",
    "linear",
    "__matmul__",
    "__rmatmul__",
    "tensordot",
}
"""products that CUDA has no integer kernels for"""


class MixedDevicesError(RuntimeError):
    """An operation that fails on CUDA."""


def is_on_device(tensor: torch.Tensor) -> bool:
    """Return whether a tensor is on the simulated device."""
    return getattr(tensor, _MARK, False)


def _names_device(value: object) -> bool:
    return isinstance(value, str | torch.device) and str(value).startswith(DEVICE)


def _names_cpu(value: object) -> bool:
    return isinstance(value, str | torch.device) and str(value).startswith("cpu")


def _marked(result: object, on_device: bool) -> object:
    for tensor in _pytree.tree_leaves(result):
        if isinstance(tensor, torch.Tensor):
            setattr(tensor, _MARK, on_device)
    return result


class SimulatedDevice(TorchFunctionMode):
    """Tracks which tensors are on the device."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        """Run one function on the CPU if it would succeed on the device."""
        kwargs, owner = dict(kwargs or {}), getattr(func, "__self__", None)
        name = getattr(func, "__name__", str(func))
        if owner is torch.Tensor.device and name == "__get__":
            return torch.device(DEVICE, 0) if is_on_device(args[0]) else func(*args, **kwargs)
        if owner is torch.Tensor.is_cuda and name == "__get__":
            return is_on_device(args[0])
        if name == "__set__":
            result = func(*args, **kwargs)
            if owner is torch.Tensor.data:
                _marked(args[0], is_on_device(args[1]))
            return result
        if name in ("to", "cpu", "cuda", "type_as") and isinstance(args[0], torch.Tensor):
            return self._moved(func, name, args, kwargs)
        return self._run(func, name, args, kwargs)

    def _moved(self, func, name: str, args: tuple, kwargs: dict):
        source, rest = args[0], [*args[1:], *kwargs.values()]
        target = is_on_device(source)
        if name == "cuda" or any(map(_names_device, rest)):
            target = True
        elif name == "cpu" or any(map(_names_cpu, rest)):
            target = False
        for other in rest:
            target = is_on_device(other) if isinstance(other, torch.Tensor) else target
        args = tuple("cpu" if _names_device(value) else value for value in args)
        kwargs = {key: "cpu" if _names_device(value) else value for key, value in kwargs.items()}
        result = source.clone() if name == "cuda" else func(*args, **kwargs)
        if result is source and target != is_on_device(source):
            result = source.clone()
        return _marked(result, target)

    def _run(self, func, name: str, args: tuple, kwargs: dict):
        given = args[0] if name == "__deepcopy__" else (args, kwargs)  # its memo holds all copies
        tensors = [leaf for leaf in _pytree.tree_leaves(given) if isinstance(leaf, torch.Tensor)]
        on_device = any(map(is_on_device, tensors))
        if on_device and name in ("numpy", "__array__", "from_numpy"):
            raise MixedDevicesError(f"{name} of a tensor on {DEVICE}")
        others = [tensor for tensor in tensors if not is_on_device(tensor)]
        scalars = name not in ("__getitem__", "__setitem__", "index_put", "cat", "stack", "gather")
        others = [tensor for tensor in others if tensor.dim() or not scalars]
        if on_device and others and name not in _MIXING_ALLOWED:
            raise MixedDevicesError(f"{name} of tensors on {DEVICE} and cpu")
        if "device" in kwargs and kwargs["device"] is not None:
            on_device = _names_device(kwargs["device"])
            kwargs["device"] = "cpu" if on_device else kwargs["device"]
        if on_device and kwargs.get("generator") is not None:
            raise MixedDevicesError(f"{name} on {DEVICE} with a generator of the cpu")
        if on_device and name in _FLOATS_ONLY and not any(part.is_floating_point() for part in tensors):
            raise NotImplementedError(f"{name} of integers on {DEVICE}")
        result = func(*args, **kwargs)
        if name in ("copy_", "set_"):
            on_device = is_on_device(args[0])
        return _marked(result, on_device) if on_device or tensors or "device" in kwargs else result


@contextmanager
def simulated_device():
    """Simulate `DEVICE` within the block; parameters are on the device of their data."""
    new, as_array, run = torch.nn.Parameter.__new__, torch.Tensor.__array__, threading.Thread.run

    def new_parameter(cls, data=None, requires_grad=True):
        parameter = new(cls, data, requires_grad)
        setattr(parameter, _MARK, data is not None and is_on_device(data))
        return parameter

    def checked_array(tensor, *args, **kwargs) -> np.ndarray:
        if is_on_device(tensor):
            raise MixedDevicesError(f"an array of a tensor on {DEVICE}")
        return as_array(tensor, *args, **kwargs)

    def run_in_mode(thread: threading.Thread) -> None:
        with SimulatedDevice():  # function modes are per thread
            run(thread)

    torch.nn.Parameter.__new__, torch.Tensor.__array__, threading.Thread.run = (
        new_parameter,
        checked_array,
        run_in_mode,
    )
    try:
        with SimulatedDevice():
            yield
    finally:
        torch.nn.Parameter.__new__, torch.Tensor.__array__, threading.Thread.run = new, as_array, run
