"""A neighbour list in buffers of fixed capacity, made on the device without the host.

Shape legend: N particles, E directed edges.
"""

from __future__ import annotations

import torch
import triton

from hgn.kernels.neighbours import kernel
from hgn.network.neighbours import SLACK, NeighbourList
from hgn.network.segments import Segments

KEY_BLOCK = 128
RUN_BLOCK, WALK_BLOCK = 16, 8  # particles of a program
LEAST_STEPS = 16  # of a search: one variant for all up to 65,535 particles
SIDE = 32  # runs of a particle, rounded up
CANDIDATES = 32  # of a particle at once


class DeviceNeighbours:
    """The list of hgn.network.neighbours, all neighbours within the radius, with room for more edges than there are.

    Rows of `neighbours` beyond the last offset are no edges: their sender is N, one more than any. Particles beyond the
    count have none, not even themselves, and stand last in the order. needed_L int32 [1]: edges that there should be
    room for; status int32 [1]: sticky flags, see the kernels.
    """

    def __init__(self, particles: int, edges: int, radius: float, device: torch.device) -> None:
        self.particles, self.capacity, self.radius = particles, edges, radius

        def integers(count: int) -> torch.Tensor:
            return torch.zeros(count, dtype=torch.int64, device=device)

        self._key_N, self._sorted_N, self._counts_N = (integers(particles) for _ in range(3))
        self._run_end, self._run_shift = (
            torch.zeros(particles, SIDE, dtype=torch.int32, device=device) for _ in range(2)
        )
        self.position_N3 = torch.zeros(particles, 3, device=device)  # in the list's order
        self.neighbours = NeighbourList(
            integers(particles), integers(edges), Segments(integers(particles + 1), integers(edges))
        )
        self.status = torch.zeros(1, dtype=torch.int32, device=device)
        self.needed_L = torch.zeros(1, dtype=torch.int32, device=device)

    def build(
        self, position_N3: torch.Tensor, scene_N: torch.Tensor, origin_S3: torch.Tensor | None, count: torch.Tensor
    ) -> None:
        """Of the first `count` particles, int32 [1]. There is no grid for an origin to move."""
        list_, receivers, capacity = self.neighbours, self.neighbours.receivers, self.capacity
        kernel.pack_cells[(triton.cdiv(self.particles, KEY_BLOCK),)](
            position=position_N3, scene_of=scene_N, particle_count=count, key=self._key_N, status=self.status,
            size=0.5 * SLACK * self.radius, particles=self.particles, BLOCK=KEY_BLOCK,
        )  # fmt: skip
        torch.sort(self._key_N, stable=True, out=(self._sorted_N, list_.order_N))
        torch.index_select(position_N3, 0, list_.order_N, out=self.position_N3)
        kernel.find_runs[(triton.cdiv(self.particles, RUN_BLOCK),)](
            key=self._sorted_N, particle_count=count, run_end=self._run_end, run_shift=self._run_shift,
            particles=self.particles, SIDE=SIDE, STEPS=max(LEAST_STEPS, self.particles.bit_length()),
            BLOCK=RUN_BLOCK,
        )  # fmt: skip
        self._walk(fill=False)
        torch.cumsum(self._counts_N, 0, out=receivers.offset_N1[1:])
        kernel.check_room[(1,)](
            offset=receivers.offset_N1,
            particles=self.particles,
            capacity=capacity,
            needed=self.needed_L,
            status=self.status,
        )
        receivers.offset_N1.clamp_(max=capacity)
        list_.sender_E.fill_(self.particles)
        self._walk(fill=True)

    def _walk(self, fill: bool) -> None:
        list_, receivers = self.neighbours, self.neighbours.receivers
        kernel.walk_neighbours[(triton.cdiv(self.particles, WALK_BLOCK),)](
            position=self.position_N3, run_end=self._run_end, run_shift=self._run_shift, counts=self._counts_N,
            offset=receivers.offset_N1, sender_of=list_.sender_E, receiver_of=receivers.segment_E,
            particles=self.particles, capacity=self.capacity, square_radius=self.radius * self.radius,
            FILL=fill, SIDE=SIDE, BLOCK=WALK_BLOCK, CANDIDATES=CANDIDATES,
        )  # fmt: skip
