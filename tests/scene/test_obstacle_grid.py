"""Obstacle cells: samples of surfaces, normals, and grids of any mesh."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hgn.config import OBSTACLE_SHAPES
from hgn.scene.distance import closest_points
from hgn.scene.obstacle_grid import build_obstacle_grid
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.shapes import shape_obstacle
from hgn.scene.surface import distinct_rows, sample_surface, split_long_edges
from hgn.schema import ConfigError

CELL = 1 / 64
TILT = euler_rotation((25.0, 40.0, 70.0))


def rng(seed=0):
    return np.random.Generator(np.random.PCG64(seed))


def sheet(*heights, flipped=False):
    """Horizontal unit squares at the given heights."""
    vertex = [(x, y, z) for y in heights for x, z in ((0, 0), (0, 1), (1, 1), (1, 0))]
    triangle = [(4 * i + a, 4 * i + b, 4 * i + c) for i in range(len(heights)) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    if flipped:
        triangle = [(a, c, b) for a, b, c in triangle]
    return Obstacle("sheet", np.array(vertex, float), np.array(triangle, np.int32), closed=False)


def quarter(obstacle):
    return Obstacle(obstacle.name, 0.25 * obstacle.vertex_V3 + 0.25, obstacle.triangle_F3, obstacle.closed)


def test_distinct_rows_are_those_of_numpy():
    """For rows with and without repetitions, for one row, and with -0."""
    for row_NK in (rng().integers(-2, 2, (300, 3)), rng().random((50, 3)).round(1), np.ones((1, 2)), -np.eye(3)):
        expected = np.unique(row_NK, axis=0, return_index=True, return_inverse=True)
        for found, value in zip(distinct_rows(row_NK), expected, strict=True):
            np.testing.assert_array_equal(found, value.reshape(found.shape))


@pytest.mark.parametrize("shape", OBSTACLE_SHAPES)
def test_samples_cover_the_surface(shape):
    """No two samples are closer than the spacing, each lies on its triangle, and every surface point has one within two
    spacings, so that no cell crossed substantially is missed."""
    obstacle = shape_obstacle(shape, 0.3, (0.5, 0.5, 0.5), TILT)
    point, owner = sample_surface(obstacle.corners, CELL / 4, rng())
    tree = cKDTree(point)
    assert tree.query(point, k=2)[0][:, 1].min() >= CELL / 4
    np.testing.assert_allclose(closest_points(point, obstacle.corners[owner]), point, atol=1e-9)
    pieces = split_long_edges(obstacle.corners, CELL / 2)
    assert tree.query(pieces.mean(axis=1))[0].max() < 2 * CELL / 4


def test_samples_are_searched_in_the_order_of_their_places(monkeypatch):
    """Large surfaces take most of their time to compare candidates with samples. Each sample enters one tree, and the
    places of candidates are close to one another: in any order the time is twice as long."""
    trees, steps = set(), []

    class Tree(cKDTree):
        def query(self, point, **options):
            trees.add(self)
            steps.append(np.linalg.norm(np.diff(point, axis=0), axis=1))
            return super().query(point, **options)

    monkeypatch.setattr("hgn.scene.surface.point_tree", Tree)
    point, _ = sample_surface(shape_obstacle("square", 0.3, (0.5, 0.5, 0.5), TILT).corners, CELL / 4, rng())
    assert sum(tree.n for tree in trees) < len(point) and np.concatenate(steps).mean() < 4 * CELL


def test_samples_and_pieces():
    """A strip far narrower than the spacing is sampled along its whole length. Pieces are short, their areas add up,
    and a box keeps only what touches it."""
    vertex = np.array([[0, 0, 0], [1, 0, 0], [1, 1e-7, 0], [0, 1e-7, 0]])
    point, _ = sample_surface(vertex[[[0, 1, 2], [0, 2, 3]]], CELL / 4, rng())
    assert np.diff(np.sort(point[:, 0])).max() < 3 * CELL / 4
    corner = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], float)
    pieces = split_long_edges(corner, 0.1)
    assert np.linalg.norm(np.roll(pieces, -1, axis=1) - pieces, axis=2).max() <= 0.1
    area = np.linalg.norm(np.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]), axis=1) / 2
    assert area.sum() == pytest.approx(0.5)
    assert 200 < len(split_long_edges(1e6 * corner, 0.1, (np.zeros(3), np.ones(3)))) < 2000


def test_grid_is_sorted_unique_unit_and_near_the_surface():
    """Cells are unique and sorted, normals have unit length, and the surface passes through each cell."""
    shapes = [shape_obstacle(name, 0.2, (i, 0.0, -1.0), TILT) for i, name in enumerate(OBSTACLE_SHAPES)]
    grid = build_obstacle_grid(shapes, CELL, 0)
    assert (grid.cell_K3.dtype, grid.normal_K3.dtype) == (np.int32, np.float32)
    np.testing.assert_array_equal(np.unique(grid.cell_K3, axis=0), grid.cell_K3)
    np.testing.assert_allclose(np.linalg.norm(grid.normal_K3.astype(float), axis=1), 1, atol=1e-6)
    centre = (grid.cell_K3 + 0.5) * CELL
    corner = all_corners(shapes)
    pairs = np.repeat(centre, len(corner), axis=0)
    closest = closest_points(pairs, np.tile(corner, (len(centre), 1, 1)))
    distance = np.linalg.norm(closest - pairs, axis=1).reshape(len(centre), -1).min(axis=1)
    assert distance.max() <= np.sqrt(3) / 2 * CELL + 1e-12


def test_sheet_normals_point_towards_the_cell_centres():
    """A sheet in the lower half of its cells gives +y, in the upper half -y, whichever way it is wound."""
    for fraction, expected in ((0.2, 1.0), (0.8, -1.0)):
        for flipped in (False, True):
            grid = build_obstacle_grid([quarter(sheet((fraction - 16) * CELL * 4, flipped=flipped))], CELL, 0)
            assert len(grid.cell_K3) >= 16 * 16
            np.testing.assert_allclose(grid.normal_K3[:, 1], expected)


def test_cancelled_cell_takes_the_normal_of_the_nearest_sample():
    """Two sheets on both sides of the cell centres leave a vertical normal; in one cell with two equal facing sheets
    the one nearer to the centre decides, from its own side."""
    facing = build_obstacle_grid([quarter(sheet((0.3 - 16) * CELL * 4, (0.75 - 16) * CELL * 4))], CELL, 0)
    assert len(facing.cell_K3) >= 16 * 16
    np.testing.assert_allclose(np.abs(facing.normal_K3[:, 1]), 1, atol=1e-6)
    lower, upper = sheet(0.0).vertex_V3, sheet(0.0).vertex_V3
    lower, upper = lower * CELL + [0, 0.2 * CELL, 0], upper * CELL + [0, 0.6 * CELL, 0]
    triangle = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    vertex = np.concatenate([lower, upper])
    both = Obstacle("both", vertex, np.concatenate([triangle, triangle + 4]), closed=False)
    outcomes = set()
    for seed in range(20):
        grid = build_obstacle_grid([both], CELL, seed)
        middle = grid.normal_K3[(grid.cell_K3 == 0).all(axis=1)]
        assert middle.shape == (1, 3)
        np.testing.assert_allclose(np.abs(middle[0]), [0, 1, 0], atol=1e-6)
        outcomes.add(float(np.sign(middle[0, 1])))
    assert -1.0 in outcomes


def test_surfaces_without_area():
    """No obstacles, and zero-area triangles, give empty arrays of the right types; among others they are skipped."""
    flat = Obstacle("flat", np.zeros((3, 3)), np.array([[0, 1, 2], [0, 0, 0]], np.int32), closed=False)
    grids = [build_obstacle_grid(obstacles, CELL, 0) for obstacles in ([], [flat])]
    for grid in (*grids, build_obstacle_grid([], CELL, 0, (1.0, 1.0, 1.0))):
        assert (grid.cell_K3.shape, grid.cell_K3.dtype) == ((0, 3), np.int32)
        assert (grid.normal_K3.shape, grid.normal_K3.dtype) == ((0, 3), np.float32)
    mixed = build_obstacle_grid([flat, shape_obstacle("cone", 0.1)], CELL, 0)
    assert len(mixed.cell_K3) > 50 and np.isfinite(mixed.normal_K3).all()


def test_a_mesh_far_larger_than_the_domain_is_cut_to_it():
    """A floor of 10^6 domain widths costs no more than the part inside, within a cell of the domain."""
    floor = sheet(0.5)
    huge = Obstacle("floor", (floor.vertex_V3 - 0.5) * 1e6 + [0.5, 0.3, 0.5], floor.triangle_F3, closed=False)
    grid = build_obstacle_grid([huge], CELL, 0, (1.0, 1.0, 1.0))
    assert grid.cell_K3.min() >= -1 and grid.cell_K3.max() <= 64
    assert ((grid.cell_K3 >= 0) & (grid.cell_K3 < 64)).all(axis=1).sum() == 64 * 64


def test_errors():
    """A bad cell size, cells beyond 32 bits, and a surface that needs millions of samples are refused by name."""
    for bad in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="cell_size must be a finite number > 0"):
            build_obstacle_grid([], bad, 0)
    tiny = shape_obstacle("square", 1e-2)
    far = Obstacle("far", tiny.vertex_V3 + 1e9, tiny.triangle_F3, closed=False)
    with pytest.raises(ConfigError, match=r"within 2\^31 cells"):
        build_obstacle_grid([far], 1e-2, 0)
    with pytest.raises(ConfigError, match="scale it down"):
        sample_surface(1e6 * tiny.corners, CELL / 4, rng())
    with pytest.raises(ConfigError, match=r"fewer than 3000000 samples at spacing .*, got 3.72e"):
        build_obstacle_grid([shape_obstacle("half_box", 8.7, (4.4, 4.4, 4.4))], 1 / 32, 0, (9.0, 9.0, 9.0))
