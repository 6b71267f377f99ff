"""Writes checkpoints in a thread during the next updates."""

import io
import shutil
import sys
from collections.abc import Iterator
from concurrent import futures
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from lightning_utilities.core.apply_func import apply_to_collection

from hgn.schema import ConfigError
from hgn.system.files import make_folder, sync_written, temporary_file, write_atomically
from hgn.system.locks import make_again
from hgn.system.patience import outlived
from hgn.training.checkpoint import LAST_NAMES, SAVED, DamagedError, Progress, read_checkpoint
from hgn.training.lightning_compat import TorchCheckpointIO

TURN_S = 1e-4  # Python's switch interval during pickling of a checkpoint; the default is 5e-3


class CheckpointWriter(TorchCheckpointIO):
    """Copies a checkpoint, and writes the copy atomically in a thread.

    A failed write is retried for the standard patience. At most one write is in progress; the next one waits for it.
    The next write, `wait`, or the end of the training raises the error of a write. (Lightning's AsyncCheckpointIO
    queues any number of copies.)
    """

    def __init__(self) -> None:
        self._thread = futures.ThreadPoolExecutor(1, "checkpoint")
        self._writing: futures.Future[None] | None = None
        self._earlier = set[tuple[int, int]]()  # identities of checkpoints that may be replaced

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Returns when the checkpoint is copied. Raises: OSError if the previous write failed."""
        self.wait()
        self._writing = self._thread.submit(_write, snapshot(checkpoint), Path(path), self._earlier)

    def load_checkpoint(self, path: Any, *given: Any, **options: Any) -> Any:
        return outlived(
            lambda: super(CheckpointWriter, self).load_checkpoint(path, *given, **options), path, start=True
        )

    def wait(self) -> None:
        """Returns when the last checkpoint is on disk. Raises: OSError if it could not be written."""
        if self._writing is not None:
            # a second Ctrl-C interrupts this wait; then `teardown` waits and raises errors
            futures.wait([self._writing])
            writing, self._writing = self._writing, None
            writing.result()

    def teardown(self) -> None:
        """Waits at the end of the training, even after an exception."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()


def snapshot(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """Returns a copy in host memory. Tensors that share memory also share it in the copy."""
    copies: dict[tuple[torch.device, int], torch.UntypedStorage] = {}

    def copied(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        place = storage.device, storage.data_ptr()
        if place not in copies:
            # copies to pinned memory are fastest, and torch caches it
            pinned = storage.device.type == "cuda"
            copies[place] = torch.empty(storage.nbytes(), dtype=torch.uint8, pin_memory=pinned).untyped_storage()
            copies[place].copy_(storage)
        view = torch.empty(0, dtype=tensor.dtype)
        return view.set_(copies[place], tensor.storage_offset(), tensor.size(), tensor.stride())

    result: dict[str, Any] = apply_to_collection(checkpoint, torch.Tensor, copied)
    return result


@contextmanager
def _copied(source: Path, path: Path) -> Iterator[Path]:
    """Yields a second, temporary name of a file, or a copy, in the folder of `path`."""
    with temporary_file(path) as temporary:
        try:
            temporary.hardlink_to(source)
        except OSError:  # a file system without hard links
            shutil.copyfile(source, temporary)
            sync_written(temporary)
        yield temporary


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def _require_none_later(checkpoint: dict[str, Any], folder: Path, earlier: set[tuple[int, int]]) -> None:
    """Raises ConfigError if the folder has a checkpoint of a later update, which was away when this run started.

    It adds the identities of the others to `earlier`, and reads none of these again.
    """
    for path in (folder / name for name in LAST_NAMES):
        with suppress(FileNotFoundError, DamagedError):
            if (identity := _identity(path)) not in earlier:
                own, theirs = (Progress.of(one).updates for one in (checkpoint, read_checkpoint(path)))
                if theirs > own:
                    raise ConfigError(
                        f"run must be a folder without checkpoints after update {own}, got {path} of update {theirs}; "
                        "start again to resume from it, or choose another run=FOLDER"
                    )
                earlier.add(identity)


def _write(checkpoint: dict[str, Any], path: Path, earlier: set[tuple[int, int]]) -> None:
    """Writes a checkpoint. Each replaced one gets the next older name, and a write that fails leaves three others."""
    replaced: dict[Path, Path] | None = None  # copies by their names; made once, before the first is replaced

    def copy() -> None:
        nonlocal replaced
        if replaced is None:
            names = pairwise(path.parent / name for name in LAST_NAMES) if path.name == LAST_NAMES[0] else ()
            replaced = {old: copies.enter_context(_copied(new, old)) for new, old in names if new.exists()}

    def attempt() -> None:
        make_again(path.parent.parent)
        make_folder(path.parent)
        _require_none_later(checkpoint, path.parent, earlier)
        content = io.BytesIO()
        with _short_turns():
            torch.save(checkpoint, content)
        write_atomically(path, content.getvalue(), copy)
        for name, temporary in (replaced or {}).items():
            with suppress(FileNotFoundError):  # renamed by an earlier attempt
                temporary.replace(name)
        if path.name == LAST_NAMES[0]:
            earlier.add(_identity(path))
            (path.parent.parent / SAVED).touch()

    with ExitStack() as copies:
        outlived(attempt, path)
        outlived(copies.close, path)  # a repeated call has fewer to remove


@contextmanager
def _short_turns() -> Iterator[None]:
    """Shortens Python's switch interval. Pickling holds the interpreter lock, which the training needs after each
    operation of torch. With the default interval the two would run almost sequentially."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(TURN_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
