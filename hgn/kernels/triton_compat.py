"""All that is used of Triton beyond its documented interface, and the versions that it was read and tested with.

tests/kernels/test_triton_compat.py says which of it a new version of Triton has changed.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

import torch
import triton
import triton.language as tl
from triton.backends.compiler import GPUTarget
from triton.language.extra.cuda import gdc_launch_dependents as gdc_launch_dependents
from triton.language.extra.cuda import gdc_wait as gdc_wait
from triton.runtime.jit import JITFunction

TESTED_VERSIONS = ("3.6", "3.7", "3.8", "3.9")  # and the ceiling in pyproject.toml

Launches = dict[str, tuple[Any, str]]  # kernels with what they are specialised for, by a key of both


def unsupported_reason(version: str = triton.__version__, hip: str | None = torch.version.hip) -> str | None:
    """Returns why this version of Triton cannot be used, or None.

    Faults of a compiler show as wrong numbers; the code that these versions generate was inspected.
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


def settle_keys(names: dict[str, Any]) -> None:
    """Asks for the keys of a module's functions in the order of their definition; call it at the module's end.

    Into a function's key go the constants of a function that it calls only if that one had a key before. A kernel's
    key, and with it whether the cache on disk has it, would depend on which others the process has launched first.
    """
    for value in names.values():
        if isinstance(value, JITFunction):
            value.cache_key  # noqa: B018 - stored from now on


@contextmanager
def noted_launches() -> Iterator[Launches]:
    """Notes launches, which are neither compiled nor made."""
    launches: Launches = {}

    def note(*, fn: Any, compile: dict[str, Any], **_: Any) -> bool:
        data = compile["specialization_data"]
        launches.setdefault(data, (fn.jit_function, data))
        return True

    triton.knobs.runtime.jit_cache_hook = note
    try:
        yield launches
    finally:
        triton.knobs.runtime.jit_cache_hook = None


def preload(function: Any, specialization: str) -> Any:
    """Compiles a kernel for what was noted of it.

    Triton's own takes a constant that is called as a type, the precision fp16 say, for that type.
    """
    with mock.patch.object(tl.dtype, "is_dtype", lambda name: False):
        return function.preload(specialization)


def build_launcher(kernel: Any) -> None:
    """Compiles the C that launches a compiled kernel."""
    triton.runtime.driver.active.launcher_cls(kernel.src, kernel.metadata)


def use_target(capability: int) -> None:
    """Lets Triton compile for a GPU without a context on it, which would take memory from those who train."""
    driver = triton.runtime.driver.active
    driver.get_current_device = lambda: 0
    driver.get_current_stream = lambda device: 0
    driver.get_current_target = lambda: GPUTarget("cuda", capability, 32)


class JitMisses:
    """Counts the kernels that were compiled since then in this process, not ahead (hgn.runtime.precompile), and the
    seconds that took."""

    def __init__(self) -> None:
        self.count, self.seconds = 0, 0.0
        triton.knobs.compilation.listener = self._note

    def _note(self, *, times: Any, cache_hit: bool, **_: Any) -> None:
        if not cache_hit:
            self.count += 1
            self.seconds += times.total / 1e6
