"""GNS: the literal definition, batches, translation, obstacles as features and as particles."""

from dataclasses import replace

import pytest
import torch
from network.comparison import assert_same_function
from network.naive_gns import naive_gns_acceleration
from network.states import chosen, gns_of, random_state, scene_of

from hgn.config import NetworkConfig
from hgn.network.build import build_network
from hgn.network.gns_edges import PlainEdges
from hgn.network.obstacles import SurfaceParticles


def with_surface(state, count, spread=0.3):
    """Points of an obstacle in each scene instead of normals."""
    generator = torch.Generator().manual_seed(1)
    points = [(torch.rand(count, 3, generator=generator) * spread + 0.02).numpy() for _ in range(state.scene_count)]
    return replace(state, obstacles=None, surface=SurfaceParticles.of(points))


def state_for(network, counts, spread=0.15):
    dtype = network.decode.first.weight.dtype
    state = random_state(counts, obstacles=network.config.obstacle_features, spread=spread, dtype=dtype)
    return with_surface(state, 12, spread) if network.config.obstacle_particles else state


def test_parameter_count():
    """The structure that the paper compares with has 1.49 million parameters at width 128 and 10 steps."""
    network = build_network(NetworkConfig(kind="gns", levels=1, message_passing_steps=10))
    per_step = (3 * 128 + 1) * 128 + (2 * 128 + 1) * 128 + 2 * (128 * 129 + 256)
    ends = (40 + 1) * 128 + (4 + 1) * 128 + 2 * (128 * 129 + 256) + 129 * 128 + 129 * 3 + 3 * 16
    assert network.parameter_count == 10 * per_step + ends


@pytest.mark.parametrize("edges", [None, PlainEdges()], ids=["autograd", "own gradients"])
@pytest.mark.parametrize("kind", ["gns", "gns_particles"])
@pytest.mark.parametrize("counts", [(17, 6), (1,)])
def test_gns_equals_the_literal_definition(kind, counts, edges, monkeypatch):
    """Outputs and all parameter gradients equal the naive network's, in float64, by autograd and by gradients of the
    edges' own in many blocks; without gradients too."""
    monkeypatch.setattr("hgn.network.gns_edges.CPU_ROWS", 30)
    network = gns_of(kind=kind)
    state = state_for(network, counts)
    expected = naive_gns_acceleration(network, state)
    found = network.normalised_acceleration(state, edges=edges)
    assert_same_function(network, found, expected)
    with torch.no_grad():
        found = network.normalised_acceleration(state, edges=edges)
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("kind", ["gns", "gns_particles"])
def test_batch_equals_single_scenes(kind):
    """Each scene of a batch gets what it gets alone."""
    network = gns_of(torch.float32, kind=kind)
    state = state_for(network, (40, 1, 25))
    with torch.no_grad():
        together = network.normalised_acceleration(state)
        for scene in range(3):
            grid = state.obstacles and random_state((40, 1, 25), spread=0.15).obstacles
            if grid is not None:
                mine = grid.key_K >> 51 == scene
                grid = replace(grid, key_K=grid.key_K[mine] - (scene << 51), normal_K3=grid.normal_K3[mine])
            alone = scene_of(state, scene, grid)
            if state.surface is not None:
                mine = state.surface.scene_P == scene
                points = state.surface.position_P3[mine]
                alone = replace(alone, surface=SurfaceParticles(points, torch.zeros(len(points), dtype=torch.long)))
            found = network.normalised_acceleration(alone)
            torch.testing.assert_close(found, together[state.scene_N == scene], rtol=1e-5, atol=1e-5)


def test_blocks_of_edges_give_the_same(monkeypatch):
    """Edges in many blocks give what they give at once."""
    network = gns_of()
    state = state_for(network, (60, 20))
    with torch.no_grad():
        expected = network.normalised_acceleration(state)
        monkeypatch.setattr("hgn.network.gns.EDGES_AT_ONCE", 50)
        torch.testing.assert_close(network.normalised_acceleration(state), expected, rtol=1e-12, atol=1e-12)


def test_order_of_particles_is_irrelevant():
    """Particles in another order move alike."""
    network = gns_of()
    state = state_for(network, (50,))
    order = torch.randperm(50, generator=torch.Generator().manual_seed(2))
    expected = network.normalised_acceleration(state)[order]
    found = network.normalised_acceleration(chosen(state, order))
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_static_particles_are_felt_and_only_in_reach():
    """Surface particles change the motion; those that no message can come from are left out, with the same result."""
    network = gns_of(kind="gns_particles", message_passing_steps=2)
    state = with_surface(random_state((30,), obstacles=False, spread=0.1), 300, spread=0.4)
    kept = network.with_static_particles(state)
    count = len(kept.position_N3) - 30
    assert 0 < count < 250
    assert kept.material_N[30:].eq(3).all() and not kept.velocity_NM3[30:].any()
    found = network.normalised_acceleration(state)
    torch.testing.assert_close(found, naive_gns_acceleration(network, state), rtol=1e-10, atol=1e-10)
    without = network.normalised_acceleration(replace(state, surface=None))
    assert (found - without).abs().max() > 1e-3


def test_reach_misses_nothing():
    """All surface particles within the reach of a particle of their scene are kept, and none beyond 1.2 times it."""
    state = with_surface(random_state((8, 5), obstacles=False, spread=0.5), 2000, spread=0.9)
    surface = state.surface
    assert surface is not None
    kept = surface.within(0.1, state.position_N3, state.scene_N)
    distance = torch.cdist(surface.position_P3.double(), state.position_N3)
    distance[surface.scene_P[:, None] != state.scene_N[None]] = torch.inf
    wanted, allowed = distance.amin(-1) <= 0.1, distance.amin(-1) <= 0.12
    found = torch.zeros_like(wanted)
    rows = {tuple(row): i for i, row in enumerate(surface.position_P3.tolist())}
    found[[rows[tuple(row)] for row in kept.position_P3.tolist()]] = True
    assert not (wanted & ~found).any() and not (found & ~allowed).any()
