"""What Triton needs of a machine with a GPU: besides its package a C compiler, which builds what launches kernels."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sysconfig
from pathlib import Path

import torch


def host_unsupported_reason() -> str | None:
    """What keeps this machine from launching Triton's kernels, in words; none if nothing does.

    Without a GPU they are interpreted, which needs the package alone.
    """
    if importlib.util.find_spec("triton") is None:
        return "it needs the package triton"
    if torch.cuda.is_available():
        from hgn.kernels.triton_compat import unsupported_reason  # loads Triton

        if reason := unsupported_reason():
            return reason
    if not torch.cuda.is_available() or any(_cache().glob("*/cuda_utils*")):  # built already, perhaps elsewhere
        return None
    if not (os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")):
        return "Triton needs a C compiler: gcc, clang or CC=…"
    folders = [_headers(), *os.environ.get("CPATH", "").split(":"), *os.environ.get("C_INCLUDE_PATH", "").split(":")]
    if not any((Path(folder) / "Python.h").is_file() for folder in folders if folder):
        return f"Triton needs Python's headers: {_headers()}/Python.h, on Debian and Ubuntu of the package python3-dev"
    return None


def kernel_precision(precision: str, device: torch.device) -> str:
    """What the kernels are given: without a GPU there is no TF32."""
    return "fp32" if device.type == "cpu" and precision == "tf32" else precision


def _cache() -> Path:
    named = os.environ.get("TRITON_CACHE_DIR")
    home = os.environ.get("TRITON_HOME") or os.path.expanduser("~")  # noqa: PTH111 - Path's raises where there is none
    return Path(named) if named else Path(home) / ".triton" / "cache"


def _headers() -> str:
    """Where Triton tells the compiler to look for them."""
    scheme = sysconfig.get_default_scheme()
    return sysconfig.get_paths("posix_prefix" if scheme == "posix_local" else scheme)["include"]
