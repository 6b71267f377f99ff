"""Tests of the description of a rank that ended, as the other ranks give it."""

import os
import signal
import threading
import time
from queue import Queue
from types import SimpleNamespace

import pytest

from hgn.training import watch

BEAT_S = 0.2
LOST = RuntimeError("gloo: connection closed by peer")


class Rank(watch.RankWatch):
    """One of two ranks in this process, which can be killed after any of its counts."""

    def __init__(self, run, rank):
        super().__init__(run)
        self.trainer = SimpleNamespace(world_size=2, global_rank=rank)
        self.beaten = threading.Semaphore(0)
        self.killed = False

    def _silent_ranks(self, count):
        if self.killed:
            return []
        silent = super()._silent_ranks(count)
        self.beaten.release()
        return silent

    def start(self, module):
        self.on_train_start(self.trainer, module)
        self.wake = self.wakes[-1]


@pytest.fixture
def ranks(monkeypatch, tmp_path):
    monkeypatch.setattr(watch, "BEAT_S", BEAT_S)
    monkeypatch.setattr(watch, "TrainingModule", object)
    wakes: list[int] = []
    monkeypatch.setattr(watch.signal, "set_wakeup_fd", lambda wake, **__: wakes.append(wake))
    monkeypatch.setattr(Rank, "wakes", wakes, raising=False)
    both = [Rank(tmp_path, rank) for rank in (0, 1)]
    yield both
    for rank in both:
        rank._ended.set()


@pytest.fixture(params=["folder stays", "folder is deleted"])
def deleted(request):
    """Deletes the folder of the counts while the ranks write them, or not."""
    return lambda run: request.param == "folder stays" or (run / ".ranks").rename(run / "elsewhere")


@pytest.mark.parametrize("counts", [0, 1, 3])
@pytest.mark.parametrize("delay", [0.0, 0.7])
def test_a_killed_rank_is_named(ranks, tmp_path, counts, delay):
    """At any time between two counts of the other rank, before its first count too, where an earlier run has failed."""
    module = SimpleNamespace(update=0)
    (tmp_path / ".ranks").mkdir()
    (tmp_path / ".ranks/1").write_text(watch.ENDED)
    for rank in ranks:
        rank.start(module)
    for _ in range(counts):
        ranks[1].beaten.acquire()
    ranks[1].killed = True  # it writes no further count and leaves its file
    time.sleep(delay * BEAT_S)
    ranks[0].on_exception(ranks[0].trainer, module, LOST)
    assert ranks[0].lost == "ranks [1] ended without a message"


@pytest.mark.parametrize("counts", [0, 1, 3])
def test_a_rank_that_reports_its_own_error_is_not_named(ranks, tmp_path, deleted, counts):
    """Even if the other rank has never read a count of it."""
    module = SimpleNamespace(update=0)
    for rank in ranks:
        rank.start(module)
    deleted(tmp_path)
    for _ in range(counts):
        ranks[1].beaten.acquire()
    ranks[1].on_exception(ranks[1].trainer, module, ValueError("its own error"))
    time.sleep(1.5 * BEAT_S)  # its thread writes nothing more
    ranks[0].on_exception(ranks[0].trainer, module, LOST)
    assert ranks[0].lost == "another rank ended, see its message"
    assert ranks[1].lost is None


def test_a_rank_that_runs_is_not_named(ranks, tmp_path, deleted):
    module = SimpleNamespace(update=0)
    for rank in ranks:
        rank.start(module)
    deleted(tmp_path)
    ranks[0].on_exception(ranks[0].trainer, module, LOST)
    assert ranks[0].lost == "another rank ended, see its message"


def test_no_file_remains_after_the_training(ranks, tmp_path):
    """Where all ranks reach the end, after an earlier training that failed too."""
    module = SimpleNamespace(update=0)
    (tmp_path / ".ranks").mkdir()
    (tmp_path / ".ranks/1").write_text(watch.ENDED)
    for rank in ranks:
        rank.start(module)
    for rank in ranks:
        rank.on_train_end(rank.trainer, module)
        rank.on_fit_end(rank.trainer, module)
    assert not list(tmp_path.iterdir())


def test_a_rank_stopped_after_the_last_update_is_named(monkeypatch, ranks, tmp_path, deleted):
    """While the others wait for it to write its part of the last checkpoint, which has no time limit after SIGTERM."""
    monkeypatch.setattr(watch, "SILENCE_S", 4 * BEAT_S)
    monkeypatch.setattr(watch, "GRACE_S", 0.0)
    ends = Queue()
    monkeypatch.setattr(Rank, "_end", lambda rank, text, code: (rank._ended.set(), ends.put((rank, text, code))))
    for rank in ranks:
        rank.start(SimpleNamespace(update=1))
        rank.on_train_end(rank.trainer, None)
    deleted(tmp_path)
    ranks[1].killed = True
    os.write(ranks[0].wake, bytes([signal.SIGTERM]))
    rank, text, code = ends.get(timeout=60)
    assert rank is ranks[0] and text.startswith("ranks [1] must answer within") and code == watch.EXIT_MACHINE


@pytest.mark.parametrize("stuck", [True, False])
def test_a_rank_that_waits_for_one_that_ended_ends(monkeypatch, ranks, tmp_path, stuck):
    """A rank ends if it waits for one that ended, although NCCL's collectives report no lost connection, and also if
    the count is read while it is written. A rank that still makes updates continues."""
    monkeypatch.setattr(watch, "GRACE_S", BEAT_S)
    ends = Queue()
    monkeypatch.setattr(Rank, "_end", lambda rank, text, code: (rank._ended.set(), ends.put((rank, text, code))))
    (tmp_path / ".ranks").mkdir()
    (tmp_path / ".ranks/1").write_text(watch.ENDED)  # of an earlier run

    class Module:
        update = property(lambda self: 1 if stuck else time.monotonic())

    for rank in ranks:
        rank.start(Module())
    for _ in range(4):
        ranks[0].beaten.acquire()
    assert ends.empty()
    read, torn = ranks[0]._read, iter([""])
    monkeypatch.setattr(
        ranks[0], "_read", lambda rank: text if (text := read(rank)) != watch.ENDED else next(torn, text)
    )
    ranks[1].on_exception(ranks[1].trainer, None, ValueError("its own error"))
    if stuck:
        assert ends.get(timeout=60) == (ranks[0], "ranks [1] ended, see their messages", watch.EXIT_MACHINE)
    for _ in range(4 * (not stuck)):
        ranks[0].beaten.acquire()
    assert ends.empty()


def test_ranks_that_were_all_stopped_continue(monkeypatch, ranks):
    """A scheduler may suspend a whole job for longer than a rank may be silent. A rank that stays stopped is named."""
    clock = SimpleNamespace(monotonic=lambda: 0.0)
    monkeypatch.setattr(watch, "time", clock)
    monkeypatch.setattr(watch.threading, "Thread", lambda **_: SimpleNamespace(start=lambda: None))
    ranks[0].start(None)
    for fraction, silent in ((0, []), (5, []), (5.4, []), (5.8, []), (6.2, [1])):
        clock.monotonic = lambda now=fraction * watch.SILENCE_S: now
        assert ranks[0]._silent_ranks("1") == silent
