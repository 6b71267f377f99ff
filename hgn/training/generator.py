"""The generator that a training starts if its data set is missing or incomplete."""

import json
import sys
from pathlib import Path
from typing import Any

import yaml

from hgn.config import DatagenConfig
from hgn.schema import ConfigError, to_mapping
from hgn.system.processes import Program, last_message

STOP_PATIENCE_S = 60.0


class Generator:
    """Runs `python -m datagen` as a child process with its own log. The process ends with its parent."""

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
        self.present = 0  # episodes published before the start
        self.found = 0  # episodes that an earlier run staged, or another generator published
        self._running: dict[int, int] = {}  # frames of each worker's present launch
        command = (sys.executable, "-m", "datagen", "--config-path", str(folder.resolve()), "--config-name", "dataset")
        with self.log_path.open("wb") as log:
            self._program = Program(command, log)

    @property
    def running(self) -> bool:
        return self._program.exit_code is None

    def check(self) -> None:
        """Raises: ConfigError with the generator's message if it has failed."""
        code = self._program.exit_code
        if code not in (None, 0):
            with self.log_path.open("rb") as log:
                message = last_message(log)
            raise ConfigError(f"the generator ended with exit code {code}: {message} (log: {self.log_path})")

    @property
    def kept(self) -> int:
        """Number of episodes that are published or staged. Reads the log."""
        self.frames_done()
        return self.present + self.found + self._finished

    def frames_done(self) -> int:
        """Returns the frames simulated since the start, including those of running episodes. Reads the log."""
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
            self._frames_per_episode, self.present = record["frames"], record["done"]
        elif record["event"] == "frame":
            self._running[record["worker"]] = record["frame"] * record["scenes"]
        elif record["event"] == "episode":
            self._finished += 1
        elif record["event"] == "found":
            self.found += record["count"]

    def stop(self) -> None:
        """Ends the process as Ctrl-C does. Finished episodes are kept, and a later start continues."""
        self._program.stop(STOP_PATIENCE_S)
