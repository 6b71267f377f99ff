"""The generator that a training starts where its data set is missing or incomplete."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from hgn.config import DatagenConfig
from hgn.schema import ConfigError, to_mapping
from hgn.system.processes import die_with_parent

STOP_PATIENCE_S = 60.0


class Generator:
    """Runs `python -m datagen` as a child process with its own log; it ends with its parent."""

    def __init__(self, config: DatagenConfig, folder: Path) -> None:
        """Writes the resolved configuration to `folder`/dataset.yaml and starts the process."""
        folder.mkdir(parents=True, exist_ok=True)
        mapping = to_mapping(config) | {
            "name": folder.name,
            "scenes": config.dataset.training_scenes,
            "out": config.dataset.folder,
            "progress": "json",
        }
        (folder / "dataset.yaml").write_text(yaml.safe_dump(mapping, sort_keys=False), encoding="utf-8")
        self.log_path = folder / "datagen.log"
        self._read_to = self._finished = self._frames_per_episode = 0
        self._running: dict[int, int] = {}  # frames of the launch that each worker is in
        with self.log_path.open("wb") as log:
            command = [
                sys.executable,
                "-m",
                "datagen",
                "--config-path",
                str(folder.resolve()),
                "--config-name",
                "dataset",
            ]
            # A process group of its own: Ctrl-C reaches only the trainer, which then stops the generator.
            self._process = subprocess.Popen(
                command,
                stdout=log,
                stderr=log,
                stdin=subprocess.DEVNULL,
                preexec_fn=partial(die_with_parent, signal.SIGINT),
                process_group=0,
            )

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def check(self) -> None:
        """Raises: ConfigError with the generator's message when it has failed."""
        code = self._process.poll()
        if code not in (None, 0):
            raise ConfigError(f"the generator ended with exit code {code}: {self._last_error()} (log: {self.log_path})")

    def frames_done(self) -> int:
        """Returns the frames simulated since the start, including those of running episodes."""
        with self.log_path.open("rb") as log:
            log.seek(self._read_to)
            for line in log:
                if not line.endswith(b"\n"):
                    break  # still being written
                self._read_to += len(line)
                if line.startswith(b"{"):
                    self._note(json.loads(line))
        return self._finished * self._frames_per_episode + sum(self._running.values())

    def _note(self, record: dict[str, Any]) -> None:
        if record["event"] == "start":
            self._frames_per_episode = record["frames"]
        elif record["event"] == "frame":
            self._running[record["worker"]] = record["frame"] * record["scenes"]
        elif record["event"] == "episode":
            self._finished += 1

    def stop(self) -> None:
        """Ends the process as Ctrl-C does: finished episodes are kept, and a later start continues."""
        if self.running:
            os.killpg(self._process.pid, signal.SIGINT)
            try:
                self._process.wait(STOP_PATIENCE_S)
            except subprocess.TimeoutExpired:
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()

    def _last_error(self) -> str:
        with self.log_path.open("rb") as log:
            log.seek(0, os.SEEK_END)
            log.seek(max(log.tell() - 8192, 0))
            tail = log.read().decode("utf-8", "replace").splitlines()
        lines = [line for line in tail if line.strip() and not line.startswith("{")]
        return lines[-1] if lines else "no message"
