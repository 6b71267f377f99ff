"""A simulation in progress: the one loop of frames, for every backend and every caller.

A backend contributes a `Stepper`, which computes frames. This module handles divergence, particles that enter, and
other changes between frames. An output has a *row* per particle. Scenes that ended keep their rows, filled with NaN.
Shape legend: T frames, N particles of all scenes, A particles that enter, M velocities of a history, S scenes.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch

from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.grid import GridRangeError
from hgn.network.own_physics import joined_parameters
from hgn.runtime.divergence import DivergedError, describe_diverged, diverged

OF_PARTICLES = ("position_N3", "velocity_NM3", "material_N", "scene_N")


class Stepper(Protocol):
    """Computes the frames that follow a state, on the device of the state."""

    def blocks(self, frames: int) -> Iterator[tuple[torch.Tensor, bool]]:
        """Yields (block, diverged) for the next `frames` frames. A block contains positions [T, N, 3].

        A block whose last frame diverged is the last block. A block is valid until the next one is requested.
        """

    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns positions [N, 3] and velocity histories [N, M, 3] after the last block."""

    def keep(self, kept_N: torch.Tensor) -> None:
        """Removes the particles for which `kept_N`, bool [N], is false."""

    def take(self, state: ParticleState) -> bool:
        """Continues from another state. Returns False, and changes nothing, if the state does not fit the buffers."""


@dataclass(frozen=True, eq=False)
class Entry:
    """Particles that enter in a frame. They are appended to the existing particles."""

    frame: int
    state: ParticleState


class Simulation(AbstractContextManager["Simulation"]):
    """Scenes that are simulated together. Use it as a context manager, or close it."""

    def __init__(
        self,
        stepper_of: Callable[[ParticleState], AbstractContextManager[Stepper]],
        state: ParticleState,
        isolate: bool = False,
        entries: Sequence[Entry] = (),
    ) -> None:
        """`stepper_of` (Backend.stepper) allocates buffers and frees them on exit. `entries` are sorted by frame.

        With `isolate` a scene that diverges ends and is recorded in `ended`; the others continue. Without it the first
        divergence raises DivergedError. A scene beyond the range of the grid ends all scenes.
        """
        self.isolate, self.frame, self.entries = isolate, 0, list(entries)
        self.ended: dict[int, DivergedError] = {}
        self._stepper_of, self._buffers = stepper_of, ExitStack()
        self.stepper: Stepper | None = None
        self.continue_from(state)

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Returns the buffers to the backend."""
        self.stepper = None
        self._buffers.close()

    @property
    def state(self) -> ParticleState:
        """Returns the state after the last frame, without ended scenes; read-only."""
        moving = self._state.moving and self._state.moving.later(self._passed)
        state = replace(self._state, moving=moving, frame_S=self.scene_frames)
        if self.stepper is None:
            return state
        position_N3, velocity_NM3 = self.stepper.motion()
        return replace(state, position_N3=position_N3, velocity_NM3=velocity_NM3)

    @property
    def scene_frames(self) -> torch.Tensor:
        """Returns the numbers of frames that the scenes have computed, int64 [S]."""
        return self._state.frame_S + self._passed

    @property
    def particle_count(self) -> int:
        return len(self._state.material_N)

    def continue_from(self, state: ParticleState) -> None:
        """Replaces the state and clears `ended`."""
        self.ended.clear()
        self._row_count = len(state.position_N3)
        self._row_N: torch.Tensor | None = None  # output row of each remaining particle; None: all rows in order
        self._begin(state)

    def add(self, new: ParticleState) -> None:
        """Appends particles. In a scene that has ended, new particles are not simulated: their rows are NaN."""
        old, rows_N = self.state, self._rows()
        running_S = torch.tensor([i not in self.ended for i in range(old.scene_count)], device=old.scene_N.device)
        running_A = running_S[new.scene_N]
        entering = new.selected(running_A)
        if self.ended:
            self._row_N = torch.cat([rows_N, self._row_count + torch.nonzero(running_A).flatten()])
        self._row_count += len(new.position_N3)
        self._begin(replace(old, **joined(old, entering)))

    def run(
        self, frames: int, on_frame: Callable[[int], Any] | None = None, stop: Callable[[], bool] = lambda: False
    ) -> np.ndarray:
        """Returns positions of the next `frames` frames, float32 [T, N, 3]; calls `on_frame(number)` after each.

        After `stop` returns True, it computes no further block of frames. Positions are NaN before a particle enters,
        and in ended scenes except in the frame in which a particle enters.
        Raises: DivergedError without `isolate`.
        """
        first, done = self.frame, 0
        entering = [len(entry.state.position_N3) for entry in self.entries if entry.frame <= first + frames]
        position_TN3 = np.full((frames, self._row_count + sum(entering), 3), np.nan, np.float32)
        for block_TN3 in self.blocks(frames):
            position_TN3[done : done + len(block_TN3), : block_TN3.shape[1]] = on_host(block_TN3)
            for _ in range(len(block_TN3)):
                done += 1
                if on_frame is not None:
                    on_frame(first + done)
            if stop():
                break
        return position_TN3[:done]

    def blocks(self, frames: int) -> Iterator[torch.Tensor]:
        """Yields positions [T, N, 3] of the next `frames` frames in blocks on the device.

        Positions are NaN in ended scenes, as in `run`. Particles that enter later have no rows yet. A block is valid
        until the next one is requested. Raises as `run`.
        """
        end = self.frame + frames
        while self.entries and self.entries[0].frame <= end:
            frame = self.entries[0].frame
            yield from self._blocks(frame - 1)
            entering = [entry.state for entry in self.entries if entry.frame == frame]
            for block_TN3 in self._blocks(frame):  # in their first frame they have their initial positions
                new = [state.position_N3.expand(len(block_TN3), -1, -1) for state in entering]
                yield _finished(torch.cat([block_TN3, *new], dim=1))
            del self.entries[: len(entering)]
            for state in entering:
                self.add(state)
        yield from self._blocks(end)

    def _blocks(self, end: int) -> Iterator[torch.Tensor]:
        while self.frame < end:
            if self.stepper is None:  # no particles yet, or all scenes have ended
                self._count(1)
                yield self._whole(self._state.position_N3[None])
            else:
                yield from self._stepped(self.stepper, end - self.frame)

    def _stepped(self, stepper: Stepper, frames: int) -> Iterator[torch.Tensor]:
        try:
            for block_TN3, lost in stepper.blocks(frames):
                self._count(len(block_TN3))
                if not lost:
                    yield self._whole(block_TN3)
                elif self.isolate:
                    yield self._without_diverged(block_TN3, stepper)
                else:
                    yield block_TN3[:-1]
                    count = int(self._diverged(block_TN3[-1]).sum())
                    raise DivergedError(self.frame, describe_diverged(count, block_TN3.shape[1]))
        except GridRangeError as error:
            self._count(1)
            raise DivergedError(self.frame, str(error)) from None

    def _count(self, frames: int) -> None:
        self.frame += frames
        self._passed += frames

    def _begin(self, state: ParticleState) -> None:
        self._state, self._passed = state, 0  # _passed: number of frames since `state`
        if not len(state.position_N3):
            self.close()
        elif self.stepper is None or not self.stepper.take(state):
            self.close()
            self.stepper = self._buffers.enter_context(self._stepper_of(state))

    def _diverged(self, position_N3: torch.Tensor) -> torch.Tensor:
        return diverged(position_N3, self._state.domain_S3[self._state.scene_N.long()])

    def _without_diverged(self, block_TN3: torch.Tensor, stepper: Stepper) -> torch.Tensor:
        """Ends scenes with diverged particles. Returns the block with NaN for these scenes in its last frame."""
        state, scenes = self._state, self._state.scene_count
        lost_N = self._diverged(block_TN3[-1])
        lost_S = torch.bincount(state.scene_N[lost_N], minlength=scenes)
        for scene, (lost, count) in enumerate(
            zip(lost_S.tolist(), torch.bincount(state.scene_N).tolist(), strict=False)
        ):
            if lost:
                self.ended[scene] = DivergedError(self.frame, describe_diverged(lost, count))
        kept_N = (lost_S == 0)[state.scene_N.long()]
        block_TN3 = block_TN3.clone()
        block_TN3[-1, ~kept_N] = torch.nan
        whole_TN3 = self._whole(block_TN3)
        self._row_N = self._rows()[kept_N]
        self._state = state.selected(kept_N)
        if bool(kept_N.any()):
            stepper.keep(kept_N)
        else:
            self.close()
        return whole_TN3

    def _rows(self) -> torch.Tensor:
        return torch.arange(self._row_count, device=self._state.scene_N.device) if self._row_N is None else self._row_N

    def _whole(self, block_TN3: torch.Tensor) -> torch.Tensor:
        """Returns a block with a row for each particle; rows of ended scenes are NaN."""
        if self._row_N is None:
            return block_TN3
        whole_TN3 = block_TN3.new_full((len(block_TN3), self._row_count, 3), torch.nan)
        whole_TN3[:, self._row_N] = block_TN3
        return _finished(whole_TN3)


def joined(first: ParticleState, second: ParticleState) -> dict[str, Any]:
    """Returns the fields of a state with the particles of both states. Parameters that one of them lacks are 0."""
    both: dict[str, Any]
    both = {name: torch.cat([getattr(first, name), getattr(second, name)]) for name in OF_PARTICLES}
    parameters = (first.parameter_NP, second.parameter_NP)
    if any(own_NP is not None for own_NP in parameters):
        both["parameter_NP"] = joined_parameters(parameters, [first.position_N3, second.position_N3])
    rest = RestShape.joined([first.rest, second.rest], [len(first.scene_N), len(second.scene_N)])
    return both if rest is None else both | {"rest": rest}


def _finished(block_TN3: torch.Tensor) -> torch.Tensor:
    """Waits until a block is computed, because `on_host` copies on another stream."""
    if block_TN3.device.type == "cuda":
        torch.cuda.current_stream().synchronize()
    return block_TN3


def on_host(block_TN3: torch.Tensor) -> np.ndarray:
    """Copies a finished block to the host while the device continues."""
    if block_TN3.device.type != "cuda":
        return block_TN3.numpy(force=True).copy()
    with torch.cuda.stream(_copy_stream(block_TN3.device.index)):
        host_TN3 = torch.empty(block_TN3.shape, pin_memory=True).copy_(block_TN3, non_blocking=True)
        torch.cuda.current_stream().synchronize()
    return host_TN3.numpy()


@functools.cache
def _copy_stream(device: int) -> torch.cuda.Stream:
    return torch.cuda.Stream(device)
