"""Neighbour lists made on the device, in Triton's interpreter on a CPU, natively on a GPU."""

import pytest
import torch
from kernels.engines import device

from hgn.kernels.neighbours.kernel import OUT_OF_WINDOW, OVERFLOW
from hgn.kernels.neighbours.op import DeviceNeighbours
from hgn.network.neighbours import neighbour_list

RADIUS = 0.1


def points(count, spread, scenes):
    generator = torch.Generator().manual_seed(count)
    position_N3 = torch.rand(count, 3, generator=generator) * spread - 0.3
    return position_N3, torch.arange(count, dtype=torch.int32) * scenes // count


def built(position_N3, scene_N, room, edges):
    """With `room` rows more than there are particles, which hold what is left of others."""
    count = len(position_N3)
    more = torch.cat([position_N3, torch.full((room, 3), -0.25)]).to(device())
    scenes = torch.cat([scene_N, torch.zeros(room, dtype=torch.int32)]).to(device())
    tables = DeviceNeighbours(count + room, edges, RADIUS, device())
    tables.build(more, scenes, None, torch.tensor([count], dtype=torch.int32, device=device()))
    return tables


@pytest.mark.parametrize(("count", "scenes", "spread"), [(1, 1, 1.0), (60, 3, 0.4), (70, 1, 0.05), (40, 2, 20.0)])
def test_lists_are_those_of_the_plain_network(count, scenes, spread):
    """The same order, senders, receivers and offsets; spare particles have no edges, spare edges belong to none."""
    position_N3, scene_N = points(count, spread, scenes)
    expected = neighbour_list(position_N3, scene_N.long(), RADIUS)
    edges = expected.edge_count
    tables = built(position_N3, scene_N, 5, edges + 7)
    found = tables.neighbours
    assert int(tables.status) == 0 and int(tables.needed_L) == edges
    assert torch.equal(found.order_N[:count].cpu(), expected.order_N)
    assert sorted(found.order_N[count:].tolist()) == list(range(count, count + 5))
    assert torch.equal(tables.position_N3[:count].cpu(), position_N3[expected.order_N])
    assert torch.equal(found.sender_E[:edges].cpu(), expected.sender_E)
    assert torch.equal(found.receivers.segment_E[:edges].cpu(), expected.receivers.segment_E)
    assert torch.equal(found.receivers.offset_N1[: count + 1].cpu(), expected.receivers.offset_N1)
    assert found.receivers.offset_N1[count:].unique().tolist() == [edges]
    assert (found.sender_E[edges:] == count + 5).all()


def test_too_many_edges_are_told_and_stay_inside():
    """What has no room is left out, every offset stays within the room, and the number that is needed is known."""
    position_N3, scene_N = points(40, 0.1, 1)
    wanted = neighbour_list(position_N3, scene_N.long(), RADIUS).edge_count
    tables = built(position_N3, scene_N, 0, wanted - 11)
    assert int(tables.status) == OVERFLOW.value and int(tables.needed_L) == wanted
    offset_N1 = tables.neighbours.receivers.offset_N1
    assert int(offset_N1[-1]) == wanted - 11 and (offset_N1.diff() >= 0).all()


@pytest.mark.filterwarnings("ignore:invalid value encountered")  # of the interpreter
@pytest.mark.parametrize("wild", [float("nan"), float("inf"), 1e6])
def test_wild_particles_are_told(wild):
    """A particle that is not finite or too far away sets the flag, and its key is within bounds all the same."""
    position_N3, scene_N = points(9, 0.2, 1)
    position_N3[4, 1] = wild
    assert int(built(position_N3, scene_N, 2, 200).status) == OUT_OF_WINDOW.value
