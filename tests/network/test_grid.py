"""The sparse grid hierarchy: cells, weights, edges, parents."""

import itertools

import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hgn.network.cell_keys import COORDINATE_LIMIT, SCENE_LIMIT, find, pack, unpack
from hgn.network.grid import CORNER_83, DIRECTION_63, build_hierarchy

SIZE = 0.25  # a power of two: centres and halves are exact


def build(position, scene=None, origin=None, levels=2, size=SIZE):
    position = torch.as_tensor(position, dtype=torch.float64)
    scene = torch.zeros(len(position), dtype=torch.long) if scene is None else torch.as_tensor(scene)
    if origin is None:
        origin = torch.zeros(int(scene.max()) + 1 if len(scene) else 1, 3, dtype=torch.float64)
    return build_hierarchy(position, scene, origin, size, levels)


def cells(level):
    scene, coordinate = unpack(level.key_C)
    return [(s, *c) for s, c in zip(scene.tolist(), coordinate.tolist(), strict=True)]


def test_known_particle_in_a_corner_of_cells():
    """A particle at the corner where eight cells meet activates them with weight 1/8 each, joined by 24 edges."""
    grid = build([[0.5, 0.5, 0.5]])
    assert cells(grid.levels[0]) == [(0, *k) for k in itertools.product((1, 2), repeat=3)]
    assert torch.equal(grid.weight_N8, torch.full((1, 8), 0.125, dtype=torch.float64))
    assert len(grid.levels[0].sender_E) == 24
    assert cells(grid.levels[1]) == [(0, *k) for k in itertools.product((0, 1), repeat=3)]


def test_known_particle_on_a_centre():
    """A particle on a cell's centre activates that cell alone: the others' weights are exactly zero."""
    grid = build([[0.375, 0.125, 0.625]])
    assert cells(grid.levels[0]) == [(0, 1, 0, 2)]
    assert grid.weight_N8.sum() == 1 and grid.weight_N8.max() == 1
    assert len(grid.levels[0].sender_E) == 0
    assert cells(grid.levels[1]) == [(0, 0, 0, 1)]


def test_known_particle_between_two_centres():
    """A particle on a line of centres activates the two cells it lies between, joined in both directions."""
    grid = build([[0.25, 0.125, 0.125]])
    level = grid.levels[0]
    assert cells(level) == [(0, 0, 0, 0), (0, 1, 0, 0)]
    edges = set(zip(level.sender_E.tolist(), level.receiver_E.tolist(), strict=True))
    assert edges == {(0, 1), (1, 0)}
    for sender, receiver, direction in zip(
        level.sender_E.tolist(), level.receiver_E.tolist(), level.direction_E.tolist(), strict=True
    ):
        difference = torch.tensor(cells(level)[sender][1:]) - torch.tensor(cells(level)[receiver][1:])
        assert torch.equal(difference, DIRECTION_63[direction])


def test_negative_cells_have_floored_parents():
    """The parent of k is floor(k / 2), below zero too: cells -1 and -2 share parent -1."""
    grid = build([[-0.25, 0.125, 0.125]], levels=2)
    assert [c[1] for c in cells(grid.levels[0])] == [-2, -1]
    assert cells(grid.levels[1]) == [(0, -1, 0, 0)]


positions = st.lists(st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 3), min_size=1, max_size=20)


@settings(max_examples=60, deadline=None)
@given(positions, st.lists(st.integers(0, 2), min_size=20, max_size=20))
def test_hierarchy_is_what_the_definition_says(particles, scenes):
    """On random particles: weights sum to 1, active cells are those of non-zero weight, edges join face neighbours of
    one scene, a coarse cell is active iff a child is."""
    scene = torch.tensor(scenes[: len(particles)])
    origin = torch.tensor([[0.0, 0, 0], [-0.1, -0.2, -0.05], [-0.25, 0, -0.125]], dtype=torch.float64)
    grid = build(particles, scene, origin, levels=3)
    torch.testing.assert_close(grid.weight_N8.sum(1), torch.ones(len(particles), dtype=torch.float64))

    u = (torch.tensor(particles, dtype=torch.float64) - origin[scene]) / SIZE - 0.5
    expected = set()
    for particle in range(len(particles)):
        base = torch.floor(u[particle])
        for corner, weight in zip(CORNER_83.tolist(), grid.weight_N8[particle].tolist(), strict=True):
            if weight != 0:
                cell = [int(b) + c for b, c in zip(base.tolist(), corner, strict=True)]
                expected.add((int(scene[particle]), *cell))
    # A product of tiny fractions may underflow to a zero weight; such a cell may be active or not.
    active = set(cells(grid.levels[0]))
    assert expected <= active
    for extra in active - expected:
        mine = u[scene == extra[0]]
        assert bool(((mine - torch.tensor(extra[1:])).abs() < 1).all(1).any())

    for fine, coarse in itertools.pairwise(grid.levels):
        parents = [(c[0], *(k // 2 for k in c[1:])) for c in cells(fine)]
        assert sorted(set(parents)) == cells(coarse)
        assert [cells(coarse)[i] for i in fine.parent_C.tolist()] == parents
        octants = [tuple(k % 2 for k in c[1:]) for c in cells(fine)]
        assert [tuple(CORNER_83[i].tolist()) for i in fine.octant_C.tolist()] == octants
    for level in grid.levels:
        listed = cells(level)
        neighbours = {
            (a, b)
            for a, b in itertools.permutations(range(len(listed)), 2)
            if listed[a][0] == listed[b][0] and sum(abs(x - y) for x, y in zip(listed[a], listed[b], strict=True)) == 1
        }
        assert set(zip(level.sender_E.tolist(), level.receiver_E.tolist(), strict=True)) == neighbours


@given(st.integers(0, SCENE_LIMIT - 1), st.tuples(*[st.integers(-COORDINATE_LIMIT, COORDINATE_LIMIT - 1)] * 3))
def test_keys_round_trip(scene, cell):
    """Packing loses nothing over the whole range, and no key is negative."""
    key = pack(torch.tensor([scene]), torch.tensor([cell]))
    assert int(key[0]) >= 0
    found_scene, found_cell = unpack(key)
    assert int(found_scene[0]) == scene and tuple(found_cell[0].tolist()) == cell


def test_find_in_an_empty_list():
    """Nothing is found where nothing is."""
    index, found = find(torch.zeros(0, dtype=torch.long), torch.tensor([3, 4]))
    assert index.tolist() == [0, 0] and found.tolist() == [False, False]


def test_no_particles():
    """An empty scene has empty levels."""
    grid = build(torch.zeros(0, 3))
    assert [level.cell_count for level in grid.levels] == [0, 0]
