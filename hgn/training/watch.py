"""Ends a rank that waits for a stopped rank. Inside a collective, neither time-outs nor signals would end it.

Each rank writes a count to the run's folder every BEAT_S, and reads the counts of the others. A rank that ends with an
error of its own writes ENDED instead. Others that make no update within GRACE_S then end too. PyTorch's flight recorder
keeps the last collectives of each rank. A rank that ends because others do not answer writes them to
`hang_rank_<rank>` in the run's folder, and so does PyTorch when a collective takes longer than its time-out.
"""

import contextlib
import os
import select
import signal
import sys
import threading
import time
from pathlib import Path
from typing import NoReturn

import torch

from hgn.command import EXIT_MACHINE
from hgn.system.files import write_atomically
from hgn.training.lightning_compat import Callback, LightningModule, Trainer
from hgn.training.module import TrainingModule
from hgn.training.stop import BY_WEIGHT

BEAT_S = 5.0  # interval between counts
ENDED = "ended"
SILENCE_S = 300.0  # longest time without a new count of a rank; network file systems may delay files by a minute
TRACE = "hang_rank_"  # with the rank's number, the file with its last collectives
TRACE_S = 10.0  # longest time for writing it
# variables of PyTorch's flight recorder: the present name, and an earlier one with the same meaning
_BUFFER = ("TORCH_FR_BUFFER_SIZE", "TORCH_NCCL_TRACE_BUFFER_SIZE")
_FILE = ("TORCH_FR_DUMP_TEMP_FILE", "TORCH_NCCL_DEBUG_INFO_TEMP_FILE")
GRACE_S = 45.0  # longest time without an update after a signal, or after the end of a rank; schedulers grant more


def record_collectives(run: Path) -> None:
    """Sets the variables of PyTorch's flight recorder that the user has not set. Call it before ranks meet."""
    for names, value in (
        (_BUFFER, "2000"),
        (_FILE, str((run / TRACE).absolute())),
        (("TORCH_NCCL_DUMP_ON_TIMEOUT",), "1"),
    ):
        if not any(name in os.environ for name in names):
            os.environ[names[0]] = value


def _write_trace(rank: int) -> None:
    prefix = next((os.environ[name] for name in _FILE if name in os.environ), None)
    recorder = torch._C._distributed_c10d
    dump = getattr(recorder, "_dump_nccl_trace", None) or getattr(recorder, "_dump_fr_trace", None)
    if prefix is not None and dump is not None:
        write_atomically(Path(f"{prefix}{rank}"), dump())


class RankWatch(Callback):
    """Watches the other ranks in a thread, from the start to the end of a training on several ranks."""

    def __init__(self, run: Path) -> None:
        self._folder = run / ".ranks"
        self._ended = threading.Event()
        self._writing = threading.Lock()
        self._updates_ended = False  # then the last checkpoint is written, which may take longer than GRACE_S
        self.lost: str | None = None  # description of the ranks that closed their connections
        self._over: list[int] = []  # ranks that ended with an error of their own
        self._counts: dict[int, tuple[str, float]] = {}  # last count of each other rank, and the time of its change

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.world_size == 1:
            return
        assert isinstance(pl_module, TrainingModule)
        self._own = self._folder / str(trainer.global_rank)
        self._write("0")
        self._awake_s = now = time.monotonic()
        self._counts = {rank: ("", now) for rank in range(trainer.world_size) if rank != trainer.global_rank}
        self._woken, wake = os.pipe()
        os.set_blocking(wake, False)
        signal.set_wakeup_fd(wake, warn_on_full_buffer=False)  # Python writes to it even while the main thread waits
        threading.Thread(target=self._watch, args=(pl_module,), name="ranks", daemon=True).start()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self._updates_ended = True

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self._counts and not self._ended.is_set():
            self._stop()
            with contextlib.suppress(OSError):
                self._own.unlink()
                self._folder.rmdir()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        if not self._counts or self._ended.is_set():
            return
        if "gloo" in str(exception) or isinstance(exception, torch.distributed.DistError):
            lost = self._lost_ranks()
            self.lost = f"ranks {lost} ended without a message" if lost else "another rank ended, see its message"
        self._stop()
        with contextlib.suppress(OSError):
            self._write(ENDED)
        if torch.distributed.is_initialized() and torch.distributed.get_backend() == "nccl":
            # At the exit the group would wait for collectives that the other ranks never begin.
            torch.distributed.distributed_c10d._abort_process_group()

    def _stop(self) -> None:
        """Ends the writing of counts."""
        with self._writing:
            self._ended.set()
        signal.set_wakeup_fd(-1)

    def _lost_ranks(self) -> list[int]:
        """Returns the ranks that write no further count within three intervals, nor that they ended."""
        before = {rank: self._read(rank) for rank in self._counts}
        lost = [rank for rank, text in before.items() if text != ENDED]
        deadline = time.monotonic() + 3 * BEAT_S
        while lost and time.monotonic() < deadline:
            time.sleep(BEAT_S / 10)
            lost = [rank for rank in lost if self._read(rank) == before[rank]]
        return lost

    def _watch(self, module: TrainingModule) -> None:
        text, code, deadline, update, beats = "", 0, 0.0, 0, 0
        while not self._ended.is_set():
            if select.select([self._woken], [], [], BEAT_S)[0]:
                for sent in os.read(self._woken, 64):
                    if sent in BY_WEIGHT:
                        text, code = f"the other ranks must answer after {signal.Signals(sent).name}", 128 + sent
                        deadline, update = time.monotonic() + GRACE_S, module.update
            beats += 1
            silent = self._silent_ranks(str(beats))
            if silent and not self._ended.is_set():
                self._end(
                    f"ranks {silent} must answer within {SILENCE_S:.0f} s, got nothing; run the same command again",
                    EXIT_MACHINE,
                )
            if self._over and not text:
                text, code = f"ranks {self._over} ended, see their messages", EXIT_MACHINE
                deadline, update = time.monotonic() + GRACE_S, module.update
            if text and time.monotonic() > deadline and not self._ended.is_set() and not self._updates_ended:
                if module.update == update:
                    self._end(text, code)
                deadline, update = time.monotonic() + GRACE_S, module.update

    def _silent_ranks(self, count: str) -> list[int]:
        """Writes this rank's count, unless it has ended. Returns the ranks whose count did not change for SILENCE_S."""
        now = time.monotonic()
        slept, self._awake_s = now - self._awake_s > SILENCE_S / 2, now  # a scheduler suspended the job
        try:
            with self._writing:
                if not self._ended.is_set():
                    self._write(count)
            for rank, (before, _) in self._counts.items():
                if (text := self._read(rank)) not in ("", before):  # "": deleted, or being written
                    self._counts[rank] = text, now
                    if text == ENDED and before:  # without a count before, the file may be of an earlier run
                        self._over.append(rank)
        except OSError:  # the folder is unreachable
            slept = True
        if slept:  # the other ranks may be alive
            self._counts = {rank: (before, now) for rank, (before, _) in self._counts.items()}
        return [rank for rank, (_, changed) in self._counts.items() if now - changed > SILENCE_S]

    def _write(self, text: str) -> None:
        self._folder.mkdir(exist_ok=True)  # the user may have deleted it
        self._own.write_text(text)

    def _read(self, rank: int) -> str:
        try:
            return (self._folder / str(rank)).read_text()
        except FileNotFoundError:
            return ""

    def _end(self, text: str, code: int) -> NoReturn:
        if not self._over:
            # the recorder takes Python's lock, which the waiting thread may have
            writer = threading.Thread(target=_write_trace, args=(int(self._own.name),), daemon=True)
            writer.start()
            writer.join(TRACE_S)
        print(f"error: {text}", file=sys.stderr, flush=True)
        os._exit(code)
