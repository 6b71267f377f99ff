"""GNS in CUDA graphs: one launch instead of some two hundred for everything behind the neighbour list.

The number of neighbours changes from frame to frame, so that a graph has room for a number of edges that is rounded
up, by an eighth at most, and rows without an edge are left out of every sum. The list itself is built outside: its size
decides which graph runs. Shape legend: N particles, E directed edges.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from typing import Any

import torch

from hgn.network.features import ParticleState
from hgn.network.gns import EDGES_AT_ONCE, GraphNetworkSimulator
from hgn.network.gns_edges import Edges
from hgn.network.neighbours import NeighbourList
from hgn.network.segments import Segments

CACHED_GRAPHS = 24  # sizes used last; they share their memory


def rounded_up(count: int) -> int:
    """The next multiple of an eighth of the power of two below `count`, and of 64: at most 12.5 % or 63 more."""
    step = max(64, (1 << (count - 1).bit_length()) >> 4)
    return max(-(-count // step), 1) * step


@dataclass(frozen=True, eq=False)
class Inputs:
    """What a graph reads: a state and its neighbour list, in buffers of its own."""

    state: ParticleState
    neighbours: NeighbourList

    def tensors(self) -> list[torch.Tensor]:
        state, list_ = self.state, self.neighbours
        tensors = [state.position_N3, state.velocity_NM3, state.material_N, state.scene_N, state.domain_S3]
        tensors += [list_.order_N, list_.sender_E, list_.receivers.offset_N1, list_.receivers.segment_E]
        if state.obstacles is not None:
            tensors += [state.obstacles.key_K, state.obstacles.normal_K3]
        return tensors


def padded(state: ParticleState, neighbours: NeighbourList, particles: int, edges: int) -> Inputs:
    """The same with more particles, which have no edges, and more rows of edges, which belong to none."""
    count = len(state.position_N3)
    more, last = particles - count, neighbours.receivers.offset_N1[-1:]
    order_N = torch.cat([neighbours.order_N, torch.arange(count, particles, device=last.device)])
    receivers = Segments(
        torch.cat([neighbours.receivers.offset_N1, last.expand(more)]), _longer(neighbours.receivers.segment_E, edges)
    )
    longer = replace(
        state,
        position_N3=_longer(state.position_N3, particles),
        velocity_NM3=_longer(state.velocity_NM3, particles),
        material_N=_longer(state.material_N, particles),
        scene_N=_longer(state.scene_N, particles),
    )
    return Inputs(longer, NeighbourList(order_N, _longer(neighbours.sender_E, edges), receivers))


class GnsGraphs:
    """Predicts accelerations as the network does, on a CUDA device, without gradients."""

    def __init__(self, network: GraphNetworkSimulator, edges: Edges | None = None) -> None:
        self.network, self.edges = network, edges
        self._graphs: OrderedDict[tuple[object, ...], _Graph] = OrderedDict()
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, state: ParticleState) -> torch.Tensor:
        """Accelerations [N, 3] in frame units.

        Raises: GridRangeError when a particle is not finite or too far from the origin.
        """
        moving = len(state.position_N3)
        state = self.network.with_static_particles(state)
        neighbours = self.network.neighbours(state)
        edges = rounded_up(neighbours.edge_count)
        if edges > EDGES_AT_ONCE:  # blocks of edges keep a GPU busy by themselves
            raw_N3 = self.network.propagate(state, neighbours, self.edges)
        else:
            # Moving particles alone keep their number; static ones come and go.
            particles = moving if len(state.position_N3) == moving else rounded_up(len(state.position_N3))
            raw_N3 = self._run(padded(state, neighbours, particles, edges))
        return self.network.normaliser.restore_acceleration(raw_N3[:moving])

    def _run(self, inputs: Inputs) -> torch.Tensor:
        key = tuple(tensor.shape for tensor in inputs.tensors())
        if key not in self._graphs:
            self._graphs[key] = _Graph(self.network, self.edges, inputs, self._pool)
            if len(self._graphs) > CACHED_GRAPHS:
                self._graphs.popitem(last=False)
        self._graphs.move_to_end(key)
        return self._graphs[key].run(inputs)


class _Graph:
    """The network captured for one set of shapes."""

    def __init__(self, network: GraphNetworkSimulator, edges: Edges | None, inputs: Inputs, pool: Any) -> None:
        self._inputs = inputs
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            network.propagate(
                inputs.state, inputs.neighbours, edges
            )  # libraries set themselves up outside of the graph
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=pool):
            self._output_N3 = network.propagate(inputs.state, inputs.neighbours, edges)

    def run(self, inputs: Inputs) -> torch.Tensor:
        torch._foreach_copy_(self._inputs.tensors(), inputs.tensors())
        self._graph.replay()
        return self._output_N3.clone()


def _longer(value: torch.Tensor, rows: int) -> torch.Tensor:
    """`value` with zeros behind it up to `rows` rows, always a copy."""
    result = value.new_zeros(rows, *value.shape[1:])
    result[: len(value)] = value
    return result
