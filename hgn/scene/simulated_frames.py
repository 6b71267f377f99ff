"""Simulates frames, and keeps them until they are written, also after Ctrl-C or an error."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hgn.system.signals import interrupt, signals_delayed

if TYPE_CHECKING:
    import numpy as np

Simulation = Callable[[Callable[["np.ndarray"], None]], None]  # gives each frame to a function, float32 [present, 3]


class SimulatedFrames:
    """The frames of a simulation, in `position_TN3`."""

    def __init__(self, position_TN3: np.ndarray, delayed: ExitStack) -> None:
        self.count = 0
        self.place: Path | None = None  # the file with these frames, when it is written
        self.interruption: Exception | KeyboardInterrupt | None = None
        self._signals: list[int] = []  # those since the end of the simulation
        self._position_TN3, self._delayed = position_TN3, delayed

    def take(self, simulate: Simulation, each: Callable[[], None] = lambda: None) -> None:
        """Simulates, and calls `each` after each frame. An interruption before the second frame is raised."""

        def take(position_N3: np.ndarray) -> None:
            self._position_TN3[self.count, : len(position_N3)] = position_N3
            self.count += 1
            if self.count == len(self._position_TN3):
                self._delay()
            each()

        try:
            simulate(take)
        except (KeyboardInterrupt, Exception) as error:
            self._delay()
            if self.count < 2:  # frame 0 is the initial state
                raise
            self.interruption = error

    def end_if_interrupted(self) -> None:
        """Raises KeyboardInterrupt if there was a signal since the end of the simulation."""
        for number in self._signals:
            interrupt(number)

    def _delay(self) -> None:
        self._signals = self._delayed.enter_context(signals_delayed()).received


@contextmanager
def simulated(position_TN3: np.ndarray) -> Iterator[SimulatedFrames]:
    """Yields the frames, not yet simulated, to a block that simulates and writes them.

    Signals between the end of the simulation and the end of the block are delayed. After an interruption (a signal or
    an error) a line names the file with the frames, and the interruption is raised.
    """
    delayed = ExitStack()
    frames = SimulatedFrames(position_TN3, delayed)
    try:
        with delayed:
            yield frames
            if frames.interruption is not None:
                raise frames.interruption
    except BaseException:
        if frames.place is not None:
            print(f"{frames.count} of {len(position_TN3)} frames are in {frames.place}", file=sys.stderr)
        raise
