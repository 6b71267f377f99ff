"""Source trees by name: folders, and commits of the repository in the current folder."""

from __future__ import annotations

import io
import subprocess
import tarfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hgn.schema import ConfigError, require
from hgn.system.provenance import commit_of, without_folders

TAKEN = ("hgn", "tools", "conf", "datagen", "pyproject.toml")  # of a commit
LEFT_OUT = ":(exclude)hgn/weights/*.safetensors"
NEEDED = (
    "hgn/kernels/precompile.py",
    "tools/bench/fast.py",
)  # by which a folder is known, and which the server imports


@dataclass(frozen=True)
class Tree:
    """A source tree that is timed."""

    number: int
    name: str  # as it is shown
    folder: Path
    commit: str


def find_trees(names: Sequence[str], room: Path) -> list[Tree]:
    """The trees of these names. A name that is no folder is a commit's, which is taken out into `room`.

    Raises: ConfigError for a name that is neither, or a tree without what is timed.
    """
    trees: list[Tree] = []
    for i, name in enumerate(names):
        field = f"trees[{i}]"
        if Path(name).is_dir():
            folder = Path(name).resolve()
            commit = commit_of(folder)
        else:
            commit, folder = _taken_out(name, room / f"tree_{i}", field)
        missing = [file for file in NEEDED if not (folder / file).is_file()]
        require(not missing, field, f"a tree with {' and '.join(NEEDED)}", name, "name the folder above hgn and tools")
        shown = without_folders(name)
        remedy = "give one of them by a relative path"
        require(shown not in [tree.name for tree in trees], field, "of another name than the others", shown, remedy)
        trees.append(Tree(i, shown, folder, commit))
    return trees


def _taken_out(name: str, folder: Path, field: str) -> tuple[str, Path]:
    try:
        top = _git("rev-parse", "--show-toplevel").decode().strip()
        commit = _git("rev-parse", "--verify", "--end-of-options", f"{name}^{{commit}}").decode().strip()
        held = _git("-C", top, "ls-tree", "--name-only", commit).decode().split()
        archive = _git("-C", top, "archive", commit, *(path for path in TAKEN if path in held), LEFT_OUT)
    except (OSError, subprocess.CalledProcessError) as error:
        said = getattr(error, "stderr", b"") or str(error).encode()
        raise ConfigError(
            f"{field} must be a folder, or a commit or branch of the repository in the current folder, got {name!r}; "
            f"git says: {said.decode(errors='replace').strip()}"
        ) from None
    with tarfile.open(fileobj=io.BytesIO(archive)) as file:
        safely: dict[str, Any] = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # Python 3.11.4 on
        file.extractall(folder, **safely)
    return commit[:12], folder


def _git(*arguments: str) -> bytes:
    return subprocess.run(["git", *arguments], capture_output=True, check=True).stdout
