"""The backend triton: simulations in CUDA graphs, kept for the next."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.torch_backend import Backend
from hgn.runtime.triton_rollout import CHECKED_PARTICLES, TritonRollout

IDLE_ROLLOUTS = 2  # kept for the next simulations, of different numbers of scenes
LEAST_FILLING = 0.5  # of the particles that one has room for: launches are as large as the room


class TritonBackend(Backend):
    """A hierarchical graph network; a single frame (`predict`) is PyTorch's."""

    name = "triton"
    stepped = False
    network: HierarchicalGraphNetwork

    def __init__(self, network: HierarchicalGraphNetwork, precision: str = "tf32", note: str = "") -> None:
        super().__init__(network, precision, note)
        self.idle: dict[int, TritonRollout] = {}  # by number of scenes

    @contextmanager
    def rollout(self, state: ParticleState, room: int = 0) -> Iterator[TritonRollout]:
        """A simulation that begins with a state, and is kept for others once it is over."""
        rollout = self._reused(state, room)
        if rollout is None:
            rollout = TritonRollout(self.network, state, self.precision, room=room, step=self.step)
            if len(state.position_N3) <= CHECKED_PARTICLES:
                rollout.require_parity(self.network, state)
        before = rollout.growths
        try:
            yield rollout
        finally:
            self.growths += rollout.growths - before
            self.idle.pop(state.scene_count, None)
            if len(self.idle) == IDLE_ROLLOUTS:
                del self.idle[next(iter(self.idle))]
            self.idle[state.scene_count] = rollout

    def _reused(self, state: ParticleState, room: int) -> TritonRollout | None:
        """An idle simulation of the same network begun anew, its launches captured already; none that fits.

        Nobody else has it while it runs, and one that does not fit goes before another is allocated.
        """
        rollout, wanted = self.idle.pop(state.scene_count, None), max(room, len(state.position_N3))
        if rollout is None or not rollout.fits(state) or not wanted <= rollout.particles <= wanted / LEAST_FILLING:
            return None
        rollout.use_values(rollout.packed.gather(list(self.network.parameters())))
        rollout.begin(state, new_obstacles=True)
        return rollout

    def release(self) -> None:
        self.idle.clear()
