"""A memory checker for kernels in Triton's interpreter: what compute-sanitizer is on a GPU.

Inside `checked_memory` every access of a kernel, through an argument or a raw address in a table, must lie in the
storage of a tensor that is alive when the kernel is launched.
"""

import gc
import weakref
from contextlib import contextmanager

import numpy as np
import pytest
import torch
import triton
from triton.runtime import interpreter


class IllegalAccessError(AssertionError):
    """A kernel has read or written what is no tensor's memory."""


def living_tensors():
    """All tensors with memory of their own; what another test traced leaves subclasses behind that have none."""
    return [thing for thing in gc.get_objects() if type(thing) in (torch.Tensor, torch.nn.Parameter)]


class Alive:
    """The memory of all tensors that are alive now."""

    def __init__(self, tensors=None):
        found = {}
        for tensor in living_tensors() if tensors is None else tensors:
            if tensor.device.type == "cpu":
                found[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
        spans = np.array(sorted((at, at + size) for at, size in found.items() if at and size), np.uint64)
        self._start, self._end = spans[:, 0].copy(), spans[:, 1].copy()

    def holds(self, address, size):
        """Of each address whether so many bytes from it on belong to one tensor."""
        at = np.asarray(address, np.uint64)
        index = np.searchsorted(self._start, at, side="right").astype(np.int64) - 1
        return (index >= 0) & (at + np.uint64(size) <= self._end[np.maximum(index, 0)])


class Checked:
    """The interpreter's memory operations, each address looked up first."""

    def __init__(self, module):
        self._module = module
        self._launch = ""
        # what is there at the start is looked for once, and leaves the collector's lists: they are long
        self._old = [weakref.ref(tensor) for tensor in living_tensors()]
        gc.freeze()
        self._alive = self._now()
        self.launches: list[tuple[str, tuple[int, ...]]] = []  # each with the addresses of its tensors

    def _now(self):
        old = [tensor for tensor in (reference() for reference in self._old) if tensor is not None]
        return Alive(old + living_tensors())

    def begin(self, launch, arguments):
        pointers = tuple(a.data_ptr() for a in arguments.values() if isinstance(a, torch.Tensor))
        self.launches.append((launch, pointers))
        self._launch, self._alive = launch, self._now()

    def _check(self, what, address, mask, size):
        at = np.asarray(address).reshape(-1).astype(np.uint64)
        if mask is not None:
            at = at[np.broadcast_to(np.asarray(mask), np.asarray(address).shape).reshape(-1).astype(bool)]
        wrong = int((~self._alive.holds(at, size)).sum())
        if wrong:
            raise IllegalAccessError(f"{self._launch}: {what} at {wrong} addresses that are no tensor's")

    def load(self, address, mask, other, dtype):
        self._check("load", address, mask, np.dtype(dtype).itemsize)
        return self._module.load(address, mask, other, dtype)

    def store(self, address, value, mask):
        self._check("store", address, mask, np.asarray(value).dtype.itemsize)
        return self._module.store(address, value, mask)

    def atomic_rmw(self, operation, address, value, mask, order):
        self._check("atomic", address, mask, np.asarray(value).dtype.itemsize)
        return self._module.atomic_rmw(operation, address, value, mask, order)

    def __getattr__(self, name):
        return getattr(self._module, name)


@contextmanager
def checked_memory():
    """Raises IllegalAccessError (inside Triton's InterpreterError) in a launch that leaves the memory of tensors.

    On a GPU it sees nothing; there run the test under compute-sanitizer with PYTORCH_NO_CUDA_MEMORY_CACHING=1.
    """
    checked = Checked(interpreter._interpreter)
    if not triton.knobs.runtime.interpret:
        gc.unfreeze()
        yield checked
        return
    run = interpreter.GridExecutor.__call__

    def launch(self, **arguments):
        checked.begin(self.fn.__name__, arguments)
        run(self, **arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpreter, "_interpreter", checked)
        patch.setattr(interpreter.GridExecutor, "__call__", launch)
        try:
            yield checked
        finally:
            gc.unfreeze()
