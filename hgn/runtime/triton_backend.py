"""The backend triton: simulations in CUDA graphs, kept for the next; the edges of a GNS in fused kernels."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import torch

from hgn.kernels.gns.op import FusedEdges
from hgn.kernels.gns.update import GnsUpdates
from hgn.kernels.update.op import Updates
from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.gns_edges import Edges
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import GRADIENT_BOUND, OUTPUT_BOUND, relative_error, require_bound
from hgn.runtime.torch_backend import Backend, GnsBackend
from hgn.runtime.triton_rollout import CHECKED_PARTICLES, TritonRollout

IDLE_ROLLOUTS = 2  # kept for the next simulations, of different numbers of scenes
LEAST_FILLING = 0.5  # of the particles that one has room for: launches are as large as the room
CHECKED_GNS_PARTICLES = 10_000  # of the first scene; autograd needs memory


def updates_of(network: ParticleNetwork) -> type[Updates]:
    """What trains a network."""
    return GnsUpdates if isinstance(network, GraphNetworkSimulator) else Updates


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
            rollout = TritonRollout(self.network, state, self.precision, room=room)
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


class TritonGnsBackend(GnsBackend):
    """A GNS whose edges are worked on in fp16 by fused kernels, with gradients."""

    name = "triton"

    def _edges(self) -> Edges:
        return FusedEdges()

    def require_parity(self, state: ParticleState, gradients: bool = False, field: str = "precision") -> None:
        """Compares outputs and, if wanted, the gradients of a random weighting of them on a state's first scene.

        Both round; kernels that are wrong differ by far more. Raises: ConfigError.
        """
        first = torch.nonzero(state.scene_N == 0).flatten()[:CHECKED_GNS_PARTICLES]
        names = ("position_N3", "velocity_NM3", "material_N", "scene_N")
        state = replace(state, **{name: getattr(state, name)[first] for name in names})
        computed = self._output_and_gradients(state, self.edges, gradients)
        expected = self._output_and_gradients(state, None, gradients)
        bounds = (OUTPUT_BOUND, GRADIENT_BOUND)
        for name, bound, a, b in zip(("outputs", "gradients"), bounds, computed, expected, strict=False):
            require_bound(relative_error(a, b), bound, name, field, "tf32", "fp16")

    def _output_and_gradients(self, state: ParticleState, edges: Edges | None, gradients: bool) -> list[torch.Tensor]:
        with torch.set_grad_enabled(gradients):
            output_N3 = self.network.normalised_acceleration(state, edges=edges)
        if not gradients:
            return [output_N3]
        generator = torch.Generator().manual_seed(0)
        weight_N3 = torch.randn(output_N3.shape, generator=generator).to(output_N3) / len(output_N3)
        parameters = list(self.network.parameters())
        gradient = torch.autograd.grad((output_N3 * weight_N3).sum(), parameters, allow_unused=True)
        return [output_N3.detach(), torch.cat([part.flatten() for part in gradient if part is not None])]
