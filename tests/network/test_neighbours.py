"""Neighbour lists against all pairs."""

import pytest
import torch
from network.naive_gns import naive_edges

from hgn.network.grid import GridRangeError, build_hierarchy
from hgn.network.neighbours import neighbour_list
from hgn.schema import ConfigError

RADIUS = 0.1


def pairs_of(found):
    """(sender, receiver) in the particles' own order."""
    order = found.order_N.tolist()
    edges = zip(found.sender_E.tolist(), found.receivers.segment_E.tolist(), strict=True)
    return {(order[sender], order[receiver]) for sender, receiver in edges}


def points(count, spread, offset=0.0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(count)
    return (torch.rand(count, 3, generator=generator, dtype=torch.float64) * spread + offset).to(dtype)


@pytest.mark.parametrize(
    ("count", "scenes", "spread", "offset", "dtype"),
    [
        (0, 1, 1.0, 0.0, torch.float32),
        (1, 1, 1.0, 0.0, torch.float32),
        (300, 3, 0.6, -0.3, torch.float64),
        (250, 1, 0.05, 0.0, torch.float32),  # everything near everything
        (200, 2, 0.5, 3000.0, torch.float32),  # where float32 has few digits left
        (200, 2, 40.0, -20.0, torch.float32),  # mostly alone
    ],
)
def test_pairs_are_all_within_the_radius(count, scenes, spread, offset, dtype):
    """Exactly the pairs of one scene below the radius, each once, grouped by receiver; each particle with itself."""
    position = points(count, spread, offset, dtype)
    scene = torch.arange(count) % scenes
    found = neighbour_list(position, scene, RADIUS)
    assert len(pairs_of(found)) == len(found.sender_E)
    assert pairs_of(found) == naive_edges(position, scene, RADIUS)
    receiver, offsets = found.receivers.segment_E, found.receivers.offset_N1
    assert torch.equal(receiver, torch.repeat_interleave(torch.arange(count), offsets.diff()))


def test_particles_on_cell_borders():
    """Particles exactly on the borders of cells, and exactly one radius apart, obey the definition."""
    line = torch.arange(-6, 7, dtype=torch.float64) * 0.0505
    position = torch.cartesian_prod(line, line[:3], line[:3])
    position = torch.cat([position, torch.tensor([[0.0, 5.0, 0.0], [RADIUS, 5.0, 0.0]], dtype=torch.float64)])
    scene = torch.zeros(len(position), dtype=torch.long)
    found = pairs_of(neighbour_list(position, scene, RADIUS))
    assert found == naive_edges(position, scene, RADIUS)
    assert (len(position) - 2, len(position) - 1) not in found


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e6])
def test_positions_out_of_range(value):
    """Where a particle is not finite, or too far away for integer cells, lists and grids name the rule."""
    position, scene = points(5, 1.0), torch.zeros(5, dtype=torch.long)
    position[3, 1] = value
    with pytest.raises(GridRangeError, match="must be finite and within"):
        neighbour_list(position, scene, RADIUS)
    with pytest.raises(GridRangeError, match="must be finite and within"):
        build_hierarchy(position, scene, torch.zeros(1, 3, dtype=torch.float64), 0.25, 2)


@pytest.mark.parametrize(
    ("count", "spread", "radius"),
    [(4100, 1.0, 1e9), (4100, 1.0, 1e3), (4100, 0.01, RADIUS), (5000, 0.0, 1e-9), (40_000, 1.0, 0.5), (1100, 1.0, 9.0)],
)
def test_too_many_neighbours_are_refused(monkeypatch, count, spread, radius):
    """Memory and time are proportional to their number. Radius or density can be wrong, also by a unit of length. Of
    large bodies no pairs are listed."""
    if count > 4000:
        monkeypatch.setattr(torch, "repeat_interleave", lambda *_, **__: pytest.fail("listed"))
    rule = r"network\.cell_size must be below .*, for at most 1000 neighbours on average, got \d+; lower it, or use"
    with pytest.raises(ConfigError, match=rule):
        neighbour_list(points(count, spread), torch.zeros(count, dtype=torch.long), radius)


def test_dense_bodies_are_not_refused():
    """A body of this project's data has up to 400 neighbours a particle. All of a small scene may be neighbours."""
    side = torch.arange(24, dtype=torch.float64) / 128
    for position, radius in ((torch.cartesian_prod(side, side, side), 0.035), (points(1000, 1.0), 1e9)):
        found = neighbour_list(position, torch.zeros(len(position), dtype=torch.long), radius)
        assert len(found.sender_E) >= 250 * len(position)
