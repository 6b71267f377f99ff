"""Checkpoints that are written beside the training: the next updates run while the file is made."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from lightning.fabric.plugins import TorchCheckpointIO
from lightning_utilities.core.apply_func import apply_to_collection

from hgn.system.files import make_folder, temporary_file, write_atomically
from hgn.training.checkpoint import LAST_NAMES

TURN_S = 1e-4  # for which a checkpoint's writing keeps Python's lock from the training; Python's own are 5e-3


class CheckpointWriter(TorchCheckpointIO):
    """Copies a checkpoint when it is asked to save it, and writes the copy in a thread, whole or not at all.

    At most one write is under way: the next one waits for it. What a write failed with is raised by whatever waits for
    it: the next one, `wait`, or the end of the training, however it ends. Lightning's AsyncCheckpointIO lets any number
    of copies wait, and raises an error one write later or not before the end.
    """

    def __init__(self) -> None:
        self._thread = futures.ThreadPoolExecutor(1, "checkpoint")
        self._writing: futures.Future[None] | None = None

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | Path, storage_options: Any = None) -> None:
        """Returns once the checkpoint is copied. Raises: OSError where the write before failed."""
        self.wait()
        self._writing = self._thread.submit(_write, snapshot(checkpoint), Path(path))

    def wait(self) -> None:
        """Returns once the last checkpoint is on disk. Raises: OSError where it could not be written."""
        if self._writing is not None:
            # a second Ctrl-C leaves from here: `teardown` then waits, and tells of errors
            futures.wait([self._writing])
            writing, self._writing = self._writing, None
            writing.result()

    def teardown(self) -> None:
        """The end of the training, by an exception too."""
        try:
            self.wait()
        finally:
            self._thread.shutdown()


def snapshot(checkpoint: dict[str, Any]) -> dict[str, Any]:
    """A copy in the host's memory that later updates do not reach. Tensors that share memory share it there too."""
    copies: dict[tuple[torch.device, int], torch.UntypedStorage] = {}

    def copied(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        place = storage.device, storage.data_ptr()
        if place not in copies:
            # a GPU fills pinned memory fastest, and torch keeps it for the next time
            pinned = storage.device.type == "cuda"
            copies[place] = torch.empty(storage.nbytes(), dtype=torch.uint8, pin_memory=pinned).untyped_storage()
            copies[place].copy_(storage)
        view = torch.empty(0, dtype=tensor.dtype)
        return view.set_(copies[place], tensor.storage_offset(), tensor.size(), tensor.stride())

    result: dict[str, Any] = apply_to_collection(checkpoint, torch.Tensor, copied)
    return result


def _keep_earlier(folder: Path) -> None:
    """The names of earlier checkpoints move on by one; the last keeps its own until it is replaced."""
    for earlier, later in pairwise(reversed(LAST_NAMES)):
        if (folder / later).exists():
            with temporary_file(folder / earlier) as temporary:
                try:
                    temporary.hardlink_to(folder / later)
                except OSError:  # a file system without hard links
                    shutil.copyfile(folder / later, temporary)
                temporary.replace(folder / earlier)


def _write(checkpoint: dict[str, Any], path: Path) -> None:
    make_folder(path.parent)
    content = io.BytesIO()
    with _short_turns():
        torch.save(checkpoint, content)
    if path.name == LAST_NAMES[0]:
        _keep_earlier(path.parent)
    write_atomically(path, content.getvalue())


@contextmanager
def _short_turns() -> Iterator[None]:
    """Pickling holds Python's lock, which the training asks for again after each operation of torch: with Python's own
    turns the two are hardly faster beside each other than one after the other.
    """
    before = sys.getswitchinterval()
    sys.setswitchinterval(TURN_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
