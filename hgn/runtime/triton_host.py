"""Requirements of Triton: its package and, with a GPU, a C compiler, which builds the launchers of kernels."""

import importlib.util
import os
import shutil
import sysconfig
from pathlib import Path

import torch


def host_unsupported_reason() -> str | None:
    """Returns why this machine cannot launch Triton's kernels, or None.

    Without a GPU kernels are interpreted, which needs only the package.
    """
    if importlib.util.find_spec("triton") is None:
        return "it needs the package triton"
    if torch.cuda.is_available():
        from hgn.kernels.triton_compat import unsupported_reason  # this import loads Triton

        if reason := unsupported_reason():
            return reason
    if not torch.cuda.is_available() or any(_cache().glob("*/cuda_utils*")):  # an earlier build, perhaps elsewhere
        return None
    if not (os.environ.get("CC") or shutil.which("gcc") or shutil.which("clang")):
        return "Triton needs a C compiler: gcc, clang or CC=…"
    folders = [_headers(), *os.environ.get("CPATH", "").split(":"), *os.environ.get("C_INCLUDE_PATH", "").split(":")]
    if not any((Path(folder) / "Python.h").is_file() for folder in folders if folder):
        return f"Triton needs Python's headers: {_headers()}/Python.h, on Debian and Ubuntu of the package python3-dev"
    return None


def kernel_precision(precision: str, device: torch.device) -> str:
    """Returns the precision for the kernels. A CPU has no TF32."""
    return "fp32" if device.type == "cpu" and precision == "tf32" else precision


def _cache() -> Path:
    named = os.environ.get("TRITON_CACHE_DIR")
    home = os.environ.get("TRITON_HOME") or os.path.expanduser("~")  # noqa: PTH111 - Path's raises without a home folder
    return Path(named) if named else Path(home) / ".triton" / "cache"


def _headers() -> str:
    """Returns the folder where Triton's compiler looks for Python's headers."""
    scheme = sysconfig.get_default_scheme()
    return sysconfig.get_paths("posix_prefix" if scheme == "posix_local" else scheme)["include"]
