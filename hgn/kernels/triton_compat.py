"""Triton's keys of functions, made the same in every process.

Into a function's key go the constants of a function that it calls only if that one had a key before. A kernel's key,
and with it whether the cache on disk has it, would depend on which other kernels the process has launched first.
"""

from __future__ import annotations

from typing import Any

from triton.runtime.jit import JITFunction


def settle_keys(names: dict[str, Any]) -> None:
    """Asks for the keys of a module's functions in the order of their definition; call it at the module's end."""
    for value in names.values():
        if isinstance(value, JITFunction):
            value.cache_key  # noqa: B018 - kept from now on
