"""Reports the progress of a generator to a person or a program."""

import json
import sys
import time
from typing import Any

from tqdm import tqdm

from hgn.schema import require
from hgn.system.progress import advance_to, bar


class Progress:
    """Reports nothing. The other classes inherit from it."""

    def start(self, done: int, total: int, frames: int) -> None:
        """Starts the report: `total` episodes of `frames` frames, of which `done` are finished."""

    def frame(self, worker: int, frame: int, scenes: int) -> None:
        """Notes that a worker reached `frame` in a launch of `scenes` scenes; with 0 scenes it has no launch."""

    def episode(self, key: str) -> None:
        """Notes that an episode was simulated and staged."""

    def found(self, count: int) -> None:
        """Notes `count` more episodes: another generator published them, or an earlier run staged them."""

    def shard(self, name: str, episodes: int, revision: int) -> None:
        """Notes that a shard was published."""

    def message(self, text: str) -> None:
        """Reports an event to a person: a quarantined scene, a worker that died."""

    def close(self) -> None:
        """Ends the report, also after an error."""


class BarProgress(Progress):
    """Shows a bar of simulated frames, which moves within a long episode. Without a terminal it prints a few lines."""

    def start(self, done: int, total: int, frames: int) -> None:
        self._done, self._total, self._frames = done, total, frames
        self._running: dict[int, int] = {}
        self._bar = bar(f"episodes {done}/{total}", total * frames, done * frames, "frame")

    def frame(self, worker: int, frame: int, scenes: int) -> None:
        self._running[worker] = frame * scenes
        self.found(0)

    def episode(self, key: str) -> None:
        self.found(1)

    def found(self, count: int) -> None:
        self._done += count
        frames = min(self._done * self._frames + sum(self._running.values()), self._total * self._frames)
        self._bar.set_description(f"episodes {self._done}/{self._total}", refresh=False)
        advance_to(self._bar, frames)  # fewer than before if a launch has failed

    def shard(self, name: str, episodes: int, revision: int) -> None:
        self.message(f"published {name} ({episodes} episode{'s' if episodes > 1 else ''})")

    def message(self, text: str) -> None:
        tqdm.write(text, file=sys.stderr)

    def close(self) -> None:
        self._bar.close()


class JsonProgress(Progress):
    """Writes one JSON object per line to standard output, each with an `event`."""

    def start(self, done: int, total: int, frames: int) -> None:
        self._done, self._total = done, total
        self._write("start", done=done, total=total, frames=frames)

    def frame(self, worker: int, frame: int, scenes: int) -> None:
        self._write("frame", worker=worker, frame=frame, scenes=scenes)

    def episode(self, key: str) -> None:
        self._done += 1
        self._write("episode", key=key, done=self._done, total=self._total)

    def found(self, count: int) -> None:
        self._done += count
        self._write("found", count=count, done=self._done, total=self._total)

    def shard(self, name: str, episodes: int, revision: int) -> None:
        self._write("shard", name=name, episodes=episodes, revision=revision)

    def message(self, text: str) -> None:
        self._write("message", text=text)

    def _write(self, event: str, **values: Any) -> None:
        print(json.dumps({"event": event, "time_s": round(time.time(), 3), **values}), flush=True)


def make_progress(kind: str) -> Progress:
    """Returns the reporter for `progress=bar|json|off`. Raises: ConfigError for another one."""
    kinds = {"bar": BarProgress, "json": JsonProgress, "off": Progress}
    require(kind in kinds, "progress", f"one of {', '.join(kinds)}", kind)
    return kinds[kind]()
