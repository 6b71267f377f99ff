"""`python -m datagen +experiment=obstacles scenes=800 out=data/obstacles`: makes a data set, or completes one."""

from __future__ import annotations

import signal
from types import FrameType
from typing import Any

from datagen.pool import Pool, Stopped, available_cpus, plan_workers, visible_gpus
from datagen.progress import PROGRESS_KINDS, make_progress
from datagen.worker import Backend
from datagen.writer import DatasetWriter
from hgn.command import run_command, section
from hgn.config import DatagenConfig
from hgn.schema import from_mapping, require

# an experiment file serves this command and hgn.train: what only that one needs is left out
KEYS = {
    "scene": "scene",
    "mpm": "mpm",
    "dataset": "dataset",
    "scenes": "dataset.training_scenes",
    "out": "dataset.folder",
    "name": None,
    "network": None,
    "training": None,
    "progress": None,
}


class StopRequest:
    """Ctrl-C or SIGTERM while it is entered: noted, so that what is being written is finished. A second one acts
    at once.
    """

    def __init__(self) -> None:
        self.signal: int | None = None

    def __enter__(self) -> StopRequest:
        self._previous = {number: signal.signal(number, self._note) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *error: object) -> None:
        self._restore()

    def requested(self) -> bool:
        return self.signal is not None

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.signal = number
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)


def main(mapping: dict[str, Any], backend: Backend | None = None) -> int:
    """Runs the generator on a composed config; the exit code is 0, or 128 + the signal that stopped it."""
    kind = mapping.get("progress", "bar")
    require(kind in PROGRESS_KINDS, "progress", f"one of {', '.join(PROGRESS_KINDS)}", kind)
    config = from_mapping(DatagenConfig, section(mapping, KEYS))
    progress = make_progress(kind)
    with StopRequest() as stop, DatasetWriter(config, progress.message) as writer:
        if not writer.complete:
            plan = plan_workers(config, visible_gpus(), available_cpus())
            try:
                Pool(config, writer, progress, plan, backend, stop.requested).run()
            except Stopped:
                progress.message(
                    f"stopped; {writer.done} of {writer.total} episodes are kept in {writer.folder}: run the same "
                    "command to go on"
                )
                return 128 + (stop.signal or 0)
        progress.message(f"{writer.folder} is complete: {_counts(writer)}")
    return 0


def _counts(writer: DatasetWriter) -> str:
    return ", ".join(f"{writer.manifest.published(split)} {split}" for split in writer.requested) + " episodes"


if __name__ == "__main__":
    run_command(main, "datagen")
