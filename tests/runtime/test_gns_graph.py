"""GNS with room to spare, as its CUDA graphs run it."""

import pytest
import torch
from network.states import gns_of, on_device, random_state
from network.test_gns import with_surface

from hgn.runtime.gns_graph import GnsGraphs, padded, rounded_up


@pytest.mark.parametrize("count", [0, 1, 64, 65, 1000, 417_312, 1 << 20])
def test_sizes_hold_what_they_must(count):
    """A rounded size holds the count and is at most an eighth or 64 rows too large."""
    size = rounded_up(count)
    assert count <= size <= max(1.125 * count, count + 64) and size % 64 == 0 and rounded_up(size) == size


@pytest.mark.parametrize("kind", ["gns", "gns_particles"])
def test_room_to_spare_changes_nothing(kind):
    """More rows of edges, and more particles without edges, leave the output of the others as it is."""
    network = gns_of(kind=kind)
    state = random_state((30, 12), spread=0.15, obstacles=kind == "gns")
    if kind == "gns_particles":
        state = network.with_static_particles(with_surface(state, 20, 0.15))
    neighbours = network.neighbours(state)
    count = len(state.position_N3)
    with torch.no_grad():
        expected = network.propagate(state, neighbours)
        inputs = padded(state, neighbours, count + 7, neighbours.edge_count + 33)
        found = network.propagate(inputs.state, inputs.neighbours)
    torch.testing.assert_close(found[:count], expected, rtol=1e-12, atol=1e-12)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("kind", ["gns", "gns_particles"])
def test_graphs_equal_the_network(kind):
    """Captured and replayed on changing states, accelerations equal the reference network's."""
    network = gns_of(torch.float32, kind=kind, width=128).cuda()
    graphs = GnsGraphs(network)
    with torch.inference_mode():
        for seed in range(6):
            state = random_state((300, 100), seed, torch.float32, kind == "gns", spread=0.15 + 0.02 * (seed % 3))
            if kind == "gns_particles":
                state = with_surface(state, 200, 0.15)
            state = on_device(state, torch.device("cuda"))
            torch.testing.assert_close(graphs(state), network(state), rtol=1e-4, atol=1e-6)
