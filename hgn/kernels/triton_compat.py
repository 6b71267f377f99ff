"""Contains all uses of Triton beyond its documented interface, and the versions with which they were tested.

tests/kernels/test_triton_compat.py fails if a new version of Triton has changed one of them.
"""

import functools
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
import triton
import triton.language as tl
from triton.backends.compiler import GPUTarget
from triton.language.extra.cuda import gdc_launch_dependents as gdc_launch_dependents
from triton.language.extra.cuda import gdc_wait as gdc_wait
from triton.runtime.cache import triton_key
from triton.runtime.jit import JITFunction

TESTED_VERSIONS = ("3.6", "3.7", "3.8", "3.9")  # the ceiling in pyproject.toml is the same

Launches = dict[str, tuple[Any, str]]  # a kernel and its specialisation, by a key of both
_patching = threading.Lock()  # locked while a function of Triton is replaced


def unsupported_reason(version: str = triton.__version__, hip: str | None = torch.version.hip) -> str | None:
    """Returns the reason for which this version of Triton cannot be used, or None.

    A compiler's fault shows only as wrong numbers. The code that the tested versions generate was inspected.
    """
    if hip is not None:
        return "its kernels have instructions of NVIDIA's GPUs alone"
    if ".".join(version.split(".")[:2]) not in TESTED_VERSIONS:
        return f"Triton must be {TESTED_VERSIONS[0]} to {TESTED_VERSIONS[-1]} for it, not {version}"
    return None


def interpreting() -> bool:
    """Returns whether kernels run in Triton's interpreter."""
    return bool(triton.knobs.runtime.interpret)


def capability() -> int:
    """Returns the compute capability that kernels are compiled for, 90 for an H100; 0 without an NVIDIA GPU."""
    target = triton.runtime.driver.active.get_current_target()
    return target.arch if target.backend == "cuda" else 0


def overlaps() -> bool:
    """Returns whether a kernel may start before the previous one has ended (programmatic dependent launch)."""
    return not interpreting() and capability() >= 90


@functools.cache
def hashing() -> threading.Thread:
    """Starts to hash Triton's own files, for the keys of its cache on disk. This takes 0.3 s without Python's lock."""
    thread = threading.Thread(target=triton_key, daemon=True)
    thread.start()
    return thread


def settle_keys(names: dict[str, Any]) -> None:
    """Computes the keys of a module's functions in the order of their definition. Call it at the module's end.

    A function's key contains the constants of a function that it calls only if that function had a key before. Without
    this call a kernel's key, and the hit in the disk cache, would depend on the order of launches in the process.
    """
    for value in names.values():
        if isinstance(value, JITFunction):
            value.cache_key  # noqa: B018 - stores the key


@contextmanager
def noted_launches() -> Iterator[Launches]:
    """Yields a dictionary of the kernels that launches in the block need and this process has not compiled.

    No launch of this thread is made, also not of a compiled kernel. Other threads are not affected.
    """
    launches: Launches = {}
    own = threading.get_ident()

    def note(*, fn: Any, compile: dict[str, Any], **_: Any) -> bool:
        if threading.get_ident() != own:
            return False
        data = compile["specialization_data"]
        launches.setdefault(data, (fn.jit_function, data))
        return True

    def prepare(self: Any, *arguments: Any, warmup: bool, **options: Any) -> Any:
        return run(self, *arguments, warmup=warmup or threading.get_ident() == own, **options)

    with _patching:
        run = JITFunction.run
        triton.knobs.runtime.jit_cache_hook = note
        try:
            with mock.patch.object(JITFunction, "run", prepare):
                yield launches
        finally:
            triton.knobs.runtime.jit_cache_hook = None


def compile_launches(launches: Iterable[tuple[Any, str]], threads: int = 1) -> list[Any]:
    """Compiles kernels for noted specialisations, and the C code that launches them. Returns the kernels.

    Kernels in the cache on disk are loaded.
    Triton's compiler releases Python's lock for 85 % of its time. Triton's own function mistakes a constant for a type
    if the constant is a type's name, as the precision "fp16" is.
    """
    driver = triton.runtime.driver.active
    hashing().join()  # otherwise each thread would hash them

    def compiled(function: Any, specialization: str) -> Any:
        kernel = function.preload(specialization)
        driver.launcher_cls(kernel.src, kernel.metadata)
        return kernel

    pool = ThreadPoolExecutor(threads, initializer=driver.set_current_device, initargs=(driver.get_current_device(),))
    with _patching, mock.patch.object(tl.dtype, "is_dtype", lambda name: False):
        try:
            futures = [pool.submit(compiled, *launch) for launch in launches]
            return [future.result() for future in futures]
        finally:
            pool.shutdown(cancel_futures=True)


def use_target(capability: int) -> None:
    """Lets Triton compile for a GPU without a CUDA context, which would take memory that the training ranks need."""
    driver = triton.runtime.driver.active
    driver.get_current_device = lambda: 0
    driver.set_current_device = lambda device: None
    driver.get_current_stream = lambda device: 0
    driver.get_current_target = lambda: GPUTarget("cuda", capability, 32)


class JitMisses:
    """Counts the kernels that this process compiles from now on, and the seconds of their compilation.
    Kernels compiled ahead (hgn.training.precompile) do not count."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        triton.knobs.compilation.listener = self._note

    def _note(self, *, times: Any, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            self.count += 1
            self.seconds += times.total / 1e6
