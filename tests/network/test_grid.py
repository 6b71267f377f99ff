"""The sparse grid hierarchy: cells, weights, edges, parents."""

import itertools

import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hgn.network.cell_keys import COORDINATE_LIMIT, SCENE_LIMIT, find, pack, unpack
from hgn.network.grid import CORNER_83, DIRECTION_63, build_hierarchy

SIZE = 0.25  # a power of two: centres and halves are exact


def build(position, scene=None, origin=None, levels=2, size=SIZE, bodies=False):
    position = torch.as_tensor(position, dtype=torch.float64)
    scene = torch.zeros(len(position), dtype=torch.long) if scene is None else torch.as_tensor(scene)
    if origin is None:
        origin = torch.zeros(int(scene.max()) + 1 if len(scene) else 1, 3, dtype=torch.float64)
    return build_hierarchy(position, scene, origin, size, levels, bodies)


def cells(level):
    scene, coordinate = unpack(level.key_C)
    return [(s, *c) for s, c in zip(scene.tolist(), coordinate.tolist(), strict=True)]


positions = st.lists(st.tuples(*[st.floats(-1, 1, allow_nan=False)] * 3), min_size=1, max_size=20)


@settings(max_examples=60, deadline=None)
@given(positions, st.lists(st.integers(0, 2), min_size=20, max_size=20))
@example([(0.5, 0.5, 0.5), (0.375, 0.125, 0.625), (0.25, 0.125, 0.125)], [0, 1, 2])  # corner, centre, between centres
@example([(-0.25, 0.125, 0.125)], [0])  # cells -2 and -1, of one parent
def test_hierarchy_is_what_the_definition_says(particles, scenes):
    """Weights sum to 1, active cells are those of non-zero weight, edges join face neighbours of one scene and know
    their direction, a coarse cell is active iff a child is."""
    scene = torch.tensor(scenes[: len(particles)])
    origin = torch.tensor([[0.0, 0, 0], [-0.1, -0.2, -0.05], [-0.25, 0, -0.125]], dtype=torch.float64)
    grid = build(particles, scene, origin, levels=3)
    torch.testing.assert_close(grid.groups.weight_N8.sum(1), torch.ones(len(particles), dtype=torch.float64))

    u = (torch.tensor(particles, dtype=torch.float64) - origin[scene]) / SIZE - 0.5
    expected = set()
    for particle in range(len(particles)):
        base = torch.floor(u[particle])
        for corner, weight in zip(CORNER_83.tolist(), grid.groups.weight_N8[particle].tolist(), strict=True):
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
        coordinate_C3 = unpack(level.key_C)[1]
        away_E3 = coordinate_C3[level.sender_E] - coordinate_C3[level.receiver_E]
        assert torch.equal(away_E3, DIRECTION_63[level.direction_E].to(away_E3))


@settings(max_examples=40, deadline=None)
@given(positions)
@example([(0.4, 0.1, 0.1), (0.6, 0.1, 0.1), (-0.6, 0.1, 0.1)])
@example([(0.1, 0.1, 0.1), (0.9, 0.1, 0.1), (0.9, 0.9, 0.1), (0.5, 0.1, 0.1), (0.1, 0.9, 0.1), (0.9, 0.5, 0.1)])
@example([(0.125 + 0.25 * i, 0.3, 0.3) for i in range(-4, 4)])  # on planes of centres: a particle reaches four cells
def test_cells_of_bodies(particles):
    """With `bodies` a hierarchy is the union of those of the bodies, each alone. Particles of a body share cells,
    directly or through others."""
    plain, divided = (build(particles, levels=3, bodies=bodies) for bodies in (False, True))
    reached = [set(plain.cells[i].tolist()) for i in range(len(particles))]
    bodies: list[set[int]] = []
    for i in range(len(particles)):
        joined = [body for body in bodies if any(reached[i] & reached[k] for k in body)]
        bodies = [body for body in bodies if body not in joined] + [{i}.union(*joined)]
    alone = [build([particles[i] for i in sorted(body)], levels=3) for body in bodies]

    def described(grid, depth, number):
        """Cells and edges; each cell is named by the body."""
        level, listed = grid.levels[depth], [(number, *cell[1:]) for cell in cells(grid.levels[depth])]
        return listed, {(listed[s], listed[r]) for s, r in zip(level.sender_E, level.receiver_E, strict=True)}

    body_of = {i: number for number, body in enumerate(bodies) for i in body}
    ancestor_N8, names = divided.cells, []
    for depth, level in enumerate(divided.levels):
        name: dict[int, tuple[int, ...]] = {}
        for i, row in enumerate(ancestor_N8.tolist()):
            for cell in row:
                assert name.setdefault(cell, (body_of[i], *cells(level)[cell][1:]))[0] == body_of[i]
        names.append([name[cell] for cell in range(level.cell_count)])
        expected = [described(grid, depth, number) for number, grid in enumerate(alone)]
        assert sorted(names[-1]) == sorted(itertools.chain(*(listed for listed, _ in expected)))
        edges = {(names[-1][s], names[-1][r]) for s, r in zip(level.sender_E, level.receiver_E, strict=True)}
        across = set().union(*(between for _, between in expected))
        # On coarser levels an edge needs finest cells on both sides of the face.
        assert edges == across if depth == 0 else edges <= across
        finest = names[0] if depth else []
        places = {tuple(c) for c in finest}
        for sender, receiver in across if depth else set():
            axis = next(k for k in (1, 2, 3) if sender[k] != receiver[k])
            step = sender[axis] - receiver[axis]
            near = [c for c in places if (c[0], *(k >> depth for k in c[1:])) == receiver]
            met = any((*c[:axis], c[axis] + step, *c[axis + 1 :]) in places
                      and (c[axis] + step) >> depth == sender[axis] for c in near)  # fmt: skip
            assert ((sender, receiver) in edges) == met
        if level.parent_C is not None:
            ancestor_N8 = level.parent_C[ancestor_N8]
    for depth, level in enumerate(divided.levels[:-1]):
        above = [(b, *(k >> 1 for k in c)) for b, *c in names[depth]]
        assert [names[depth + 1][i] for i in level.parent_C.tolist()] == above


@given(st.integers(0, SCENE_LIMIT - 1), st.tuples(*[st.integers(-COORDINATE_LIMIT, COORDINATE_LIMIT - 1)] * 3))
def test_keys_round_trip(scene, cell):
    """Packing loses nothing over the whole range, and no key is negative."""
    key = pack(torch.tensor([scene]), torch.tensor([cell]))
    assert int(key[0]) >= 0
    found_scene, found_cell = unpack(key)
    assert int(found_scene[0]) == scene and tuple(found_cell[0].tolist()) == cell


def test_nothing():
    """An empty scene has empty levels, and a search for cells in it returns none."""
    assert [level.cell_count for level in build(torch.zeros(0, 3)).levels] == [0, 0]
    index, found = find(torch.zeros(0, dtype=torch.long), torch.tensor([3, 4]))
    assert index.tolist() == [0, 0] and found.tolist() == [False, False]
