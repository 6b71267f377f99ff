"""Runs the pool in a process of its own and keeps it alive. Meanwhile the service serves published episodes.

A pool that dies, stops reporting, or ends with an error (a full disk, ...) is started again after a pause, which grows
until another episode is finished. A pool that ends with a ConfigError is not started again. The service then continues
to serve, but ends if no pool has started its work. The service also ends if the supervisor fails, but not if the log
cannot be written.
"""

import signal
import threading
import time
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from typing import Any

from datagen.generate import generate, stop_signals
from datagen.pool.progress import Progress
from datagen.pool.worker import Backend, error_message
from hgn.config import DatagenConfig
from hgn.schema import ConfigError
from hgn.system.processes import ENDED, cause_of_exit, start_child

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
_STOP_PATIENCE_S = 60.0
_LOOK_S, _BEAT_S = 0.2, 1.0  # interval of the supervisor's checks; shortest interval of the pool's reports
_EVENTS = ("start", "frame", "episode", "found", "shard", "message", "close")


@dataclass(frozen=True)
class PoolState:
    """Holds the pool's last state. `status`: starting, running, complete, waiting (to restart), failed or stopped."""

    status: str = "starting"
    starts: int = 0
    done: int = 0  # number of episodes published or staged
    total: int = 0
    frames: int = 0  # number of frames of an episode
    running: dict[int, tuple[int, int]] = field(default_factory=dict)  # frame and number of scenes by worker
    error: str = ""  # the last error
    log_error: str = ""  # why the last line of the log could not be written


class Supervisor:
    """Runs the pool inside a `with` block."""

    def __init__(self, config: DatagenConfig, progress: Progress, backend: Backend | None = None) -> None:
        self._config, self._progress, self._backend = config, progress, backend
        self.state = PoolState()  # replaced as a whole, so that other threads can read it at any time
        self.unusable: str | None = None  # why the service must end
        self.on_unusable = lambda: None
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pool supervisor")

    def __enter__(self) -> "Supervisor":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Ends the pool as Ctrl-C does. Finished episodes are kept."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            self._supervise()
        except Exception as error:  # noqa: BLE001 - not swallowed: the service ends with it
            self._set(status="failed", error=repr(error), running={})
            self._give_up(f"the pool's supervisor failed: {error!r}")

    def _give_up(self, text: str) -> None:
        self.unusable = text
        self.on_unusable()

    def _supervise(self) -> None:
        pause = _FIRST_PAUSE_S
        while not self._stopping.is_set():
            before = self.state.done
            outcome, text = self._run_once()
            if outcome == "complete":
                self._set(status="complete", error="", running={})
                return
            if self._stopping.is_set():
                break
            self._set(status="waiting", error=text, running={})
            if outcome == "config_error":
                self._set(status="failed")
                self._say("message", f"error: {text}")
                if not self.state.total:
                    self._give_up(text)
                return
            pause = _FIRST_PAUSE_S if self.state.done != before else min(2 * pause, _LONGEST_PAUSE_S)
            self._say("message", f"the pool ended ({text}); it is started again in {pause:.0f} s")
            self._stopping.wait(pause)
        self._set(status="stopped", running={})

    def _run_once(self) -> tuple[str, str]:
        """Runs a pool to its end. Returns complete, stopped, config_error, os_error, error or died, and the reason."""
        # if the service is killed, the pool gets SIGTERM and ends as after Ctrl-C
        process, connection = start_child(
            _generate, self._config, self._backend, number=signal.SIGTERM, duplex=False, daemon=False
        )
        self._set(status="running", starts=self.state.starts + 1)
        outcome, text = "died", ""
        asked, patience, silent_s, silence = False, _STOP_PATIENCE_S, 0.0, self._config.dataset.worker_silence_s
        try:
            while True:
                if self._stopping.is_set() and not asked:
                    process.terminate()
                    asked = True
                if not connection.poll(_LOOK_S):
                    patience -= _LOOK_S * asked
                    silent_s += _LOOK_S  # a clock would also count the time in which this process is suspended
                    if patience < 0 or silent_s > silence:
                        process.kill()
                    continue
                kind, *values = connection.recv()
                silent_s = 0.0
                if kind in _EVENTS:
                    self._note(kind, *values)
                elif kind != "alive":
                    outcome, text = kind, " ".join(str(value) for value in values if value is not None)
        except ENDED:
            process.join()
        finally:
            connection.close()
        if outcome == "died":
            text = f"it sent nothing for {silence:.0f} s" if silent_s > silence else cause_of_exit(process)
        return outcome, text

    def _note(self, kind: str, *values: Any) -> None:
        state = self.state
        if kind == "start":
            self._set(done=values[0], total=values[1], frames=values[2], error="")
        elif kind == "frame":
            worker, frame, scenes = values
            running = {key: value for key, value in state.running.items() if key != worker}
            self._set(running=running | ({worker: (frame, scenes)} if scenes else {}))
        elif kind == "episode":
            self._set(done=state.done + 1)
        elif kind == "found":
            self._set(done=state.done + values[0])
        self._say(kind, *values)

    def _say(self, kind: str, *values: Any) -> None:
        try:
            getattr(self._progress, kind)(*values)
        except OSError as error:  # the log's reader has ended, or its disk is full
            self._set(log_error=str(error))
        else:
            if self.state.log_error:
                self._set(log_error="")

    def _set(self, **values: Any) -> None:
        self.state = replace(self.state, **values)


class _PipeProgress(Progress):
    """Sends every event to the service as (event, *values)."""

    def __init__(self, connection: Connection) -> None:
        for event in _EVENTS:
            setattr(self, event, lambda *values, event=event: connection.send((event, *values)))


def _generate(connection: Connection, config: DatagenConfig, backend: Backend | None) -> None:
    with stop_signals() as stop:
        try:
            spoke_at = -_BEAT_S

            def should_stop() -> bool:
                nonlocal spoke_at
                if time.monotonic() - spoke_at > _BEAT_S:  # the supervisor notices a suspended pool by missing reports
                    spoke_at = time.monotonic()
                    connection.send(("alive",))
                return stop.requested

            finished = generate(config, _PipeProgress(connection), should_stop, backend, early=True)
            connection.send(("complete",) if finished else ("stopped",))
        except (BrokenPipeError, ConnectionResetError):
            return  # the service has ended; finished episodes are kept
        except (ConfigError, OSError) as error:
            connection.send(error_message(error))
        except Exception as error:  # noqa: BLE001 - not swallowed: the service reports it
            connection.send(("error", str(error)))
