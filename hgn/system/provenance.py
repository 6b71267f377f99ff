"""Describes the origin of a file or a figure: versions, commit, date, machine."""

from __future__ import annotations

import datetime
import functools
import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hgn.schema import printable

if TYPE_CHECKING:
    import torch

PACKAGES = ("torch", "triton", "lightning", "taichi", "numpy")
# This matches /a/b/c, but not the path of a URL.
_ABSOLUTE_PATH = re.compile(r"(?<![\w.:/~-])/(?:[^/\s,='\"\[\](){}]+/)*([^/\s,='\"\[\](){}]+)/?")


def commit() -> str:
    """Returns $HGN_COMMIT (for copies without history), or else the checkout's commit.
    The commit has the suffix `+changes` if files differ from it. Without a commit the result is `unknown`."""
    folder = Path(__file__).resolve().parents[2]
    if given := os.environ.get("HGN_COMMIT"):
        return given
    if not (folder / ".git").exists():
        return "unknown"
    try:
        revision = _git(folder, "rev-parse", "--short=12", "HEAD")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return revision + ("+changes" if changed else "")


def device_name(device: torch.device | str) -> str:
    """Returns the GPU's name, or the processor's type and the number of threads."""
    import torch

    if torch.device(device).type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU {platform.machine()}, {torch.get_num_threads()} threads"


def provenance(device: torch.device | str = "cpu") -> dict[str, Any]:
    """Returns {"device", "versions", "commit", "date", "command"}, ready for JSON."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {
        "device": device_name(device),
        "versions": versions,
        "commit": commit(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": command_line(),
    }


def command_line() -> str:
    """Returns the command line of this process, without passwords and without folders of this machine."""
    return printable(shlex.join(without_folders(sys.orig_argv)))


def without_folders(value: Any) -> Any:
    """Reduces each absolute path in the strings of plain containers to its last part."""
    return with_texts(value, functools.partial(_ABSOLUTE_PATH.sub, r"\1"))


def with_texts(value: Any, change: Callable[[str], str]) -> Any:
    """Applies a function, `printable` for example, to the strings of plain containers."""
    if isinstance(value, str):
        return change(value)
    if isinstance(value, dict):
        return {key: with_texts(item, change) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [with_texts(item, change) for item in value]
    return value


def _git(folder: Path, *arguments: str) -> str:
    result = subprocess.run(["git", "-C", str(folder), *arguments], capture_output=True, text=True, check=True)
    return result.stdout.strip()
