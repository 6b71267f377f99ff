"""What of Triton is not as documented: keys of functions, and kernels compiled by what was noted of them.

Into a function's key go the constants of a function that it calls only if that one had a key before. A kernel's key,
and with it whether the cache on disk has it, would depend on which other kernels the process has launched first.
"""

from __future__ import annotations

from typing import Any
from unittest import mock

import triton.language as tl
from triton.runtime.jit import JITFunction


def settle_keys(names: dict[str, Any]) -> None:
    """Asks for the keys of a module's functions in the order of their definition; call it at the module's end."""
    for value in names.values():
        if isinstance(value, JITFunction):
            value.cache_key  # noqa: B018 - kept from now on


def preload(function: Any, specialization: str) -> Any:
    """Compiles a kernel for what `triton.knobs.runtime.jit_cache_hook` was given.

    Triton's own takes a constant that is called as a type, the precision fp16 say, for that type.
    """
    with mock.patch.object(tl.dtype, "is_dtype", lambda name: False):
        return function.preload(specialization)
