"""The barrier of a scene's obstacles: which triangles its cells list."""

import numpy as np
import pytest
from network.barrier_scenes import CELL, CLEARANCE, DOMAIN, square

from hgn.network.barriers import Barriers
from hgn.scene.barrier import CELLS, barrier_of_pieces, barrier_pieces, build_barrier
from hgn.schema import ConfigError


def triangles(count, largest):
    """So many around the domain's middle, of 0.001 to `largest` in size, corners [F, 3, 3]."""
    generator = np.random.default_rng(count)
    size_F11 = 10 ** generator.uniform(-3, np.log10(largest), (count, 1, 1))
    return generator.uniform(0.1, 0.9, (count, 1, 3)) + size_F11 * generator.normal(size=(count, 3, 3))


def all_cells():
    """Every cell that is not far from the domain, in lexicographical order, [C, 3]."""
    along = np.arange(-10, int(1 / (CELLS * CELL)) + 10)  # pieces are up to 8 cells long
    return np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)


def near(cell_C3, row_24, cell_size, clearance):
    """Whether the planes and the box of a triangle come to within half a cell, and a thousandth of that, of each."""
    middle_C3, half = (cell_C3 + 0.5) * cell_size, 0.5 * cell_size * (2 + 1e-3)
    reach = half - 0.5 * cell_size
    low_3, high_3 = (np.floor((row_24[i : i + 3] + s * reach) / cell_size) for i, s in ((16, -1), (20, 1)))
    near_C = ((cell_C3 >= low_3) & (cell_C3 <= high_3)).all(axis=1)
    for plane in range(4):
        distance_C = middle_C3 @ row_24[4 * plane : 4 * plane + 3] - row_24[4 * plane + 3]
        spread = half * np.abs(row_24[4 * plane : 4 * plane + 3]).sum()
        near_C &= np.abs(distance_C) <= spread + clearance if plane == 0 else distance_C <= spread
    return near_C


@pytest.mark.parametrize("clearance", [CLEARANCE, CELL])
@pytest.mark.parametrize(("count", "largest"), [(60, 0.01), (20, 0.3), (1, 0.3), (0, 0.3)])
def test_cells_list_the_triangles_that_are_near(count, largest, clearance):
    """Those that every triangle asked against every cell has, in order: small ones, some in pieces, one, and none."""
    piece_F33 = barrier_pieces(triangles(count, largest), CELL, DOMAIN)
    barrier = barrier_of_pieces(piece_F33, CELL, clearance)
    assert len(barrier.row_F24) == len(piece_F33) >= count
    cell_C3 = all_cells()
    rows = barrier.row_F24.astype(np.float64)
    near_CF = np.zeros((len(cell_C3), len(rows)), bool)
    for triangle, row_24 in enumerate(rows):
        near_CF[:, triangle] = near(cell_C3, row_24, barrier.cell_size, clearance)
    filled_C = near_CF.any(axis=1)
    np.testing.assert_array_equal(barrier.cell_Q3, cell_C3[filled_C])
    np.testing.assert_array_equal(barrier.start_Q, np.append(0, near_CF[filled_C].sum(axis=1).cumsum()))
    np.testing.assert_array_equal(barrier.triangle_E, np.nonzero(near_CF)[1])


def test_scenes_of_a_batch_have_one_cell_size():
    """It is refused by name where those with obstacles differ; the cells of a scene without any do not matter."""
    corner_F33 = square((0.5,) * 3, 1)
    fine, coarse = (build_barrier(corner_F33, size, CLEARANCE, DOMAIN) for size in (CELL, 2 * CELL))
    empty = build_barrier(corner_F33[:0], 2 * CELL, CLEARANCE, DOMAIN)
    rule = (
        r"cell_size must be one for all scenes of a batch with obstacle_clearance, got \(0.015625, 0.03125\); simulate"
    )
    with pytest.raises(ConfigError, match=rule):
        Barriers.of([coarse, fine])
    assert Barriers.of([empty, fine]).cell_size == fine.cell_size
