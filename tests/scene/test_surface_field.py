"""Tests the field of distances around obstacles, the input of networks with obstacle_distance."""

import weakref
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from scene.test_episode import make_episode
from scipy.spatial import Delaunay

from hgn.config import NetworkConfig
from hgn.network.obstacles import ObstacleCells
from hgn.runtime.simulator import InitialState
from hgn.scene.distance import closest_points
from hgn.scene.episode_obstacles import field_of_episode
from hgn.scene.obstacle_grid import ObstacleGrid, build_obstacle_grid
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle, all_corners
from hgn.scene.shapes import shape_obstacle
from hgn.scene.surface_field import REACH_CELLS, surface_field
from hgn.schema import ConfigError

CELL = 1 / 64
REACH = REACH_CELLS * CELL


def seen(obstacles, position_N3):
    """The normals times nearness, and the friction, at places [N, 4], computed in float64."""
    grid = build_obstacle_grid(obstacles, CELL, 0)
    cells = ObstacleCells.of([surface_field(grid, all_corners(obstacles))])
    place_N3 = torch.from_numpy(position_N3)
    return cells.rows_at(cells.surface_rows, place_N3, torch.zeros(len(place_N3), dtype=torch.int64)).numpy()


def exact_distance(obstacles, position_N3):
    triangle_F33 = all_corners(obstacles)
    pair_N33 = ((position_N3, np.broadcast_to(t, (len(position_N3), 3, 3))) for t in triangle_F33)
    return np.min([np.linalg.norm(x - closest_points(x, t), axis=1) for x, t in pair_N33], axis=0)


def irregular(size, position, matrix_33):
    """A square plate of triangles of all sizes and angles."""
    rng = np.random.default_rng(3)
    corners = np.array([(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])
    flat_V2 = np.concatenate([corners, rng.uniform(-0.5, 0.5, (60, 2)) ** 3 * 4])
    vertex_V3 = size * np.stack([flat_V2[:, 0], np.zeros(len(flat_V2)), flat_V2[:, 1]], axis=1) @ matrix_33.T + position
    return Obstacle("plate", vertex_V3, Delaunay(flat_V2).simplices.astype(np.int32), closed=False)


@pytest.mark.parametrize("made", [partial(shape_obstacle, "square"), irregular])
@pytest.mark.parametrize("height", [0.25, 0.2562, 0.2655])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (20.0, 0.0, -35.0)])
def test_a_plate(height, turn, made):
    """On both sides nearness falls from 1 at the plate to 0 at REACH, wherever the plate lies in its cells. The paper's
    cells of a level plate show it from 0 to 1 cell above it, depending on the height. Where triangles of all angles
    meet, the nearest one may be missed, which changes the nearness little."""
    matrix_33 = euler_rotation(turn)
    plate = made(0.4, (0.5, height, 0.5), matrix_33)
    normal_3, rng = matrix_33[:, 1], np.random.default_rng(0)
    distance_N = rng.uniform(-1.2 * REACH, 1.2 * REACH, 4_000)
    flat_N3 = rng.uniform(-0.15, 0.15, (4_000, 3)) * (1, 0, 1)
    place_N3 = flat_N3 @ matrix_33.T + (0.5, height, 0.5) + distance_N[:, None] * normal_3
    near_N = np.maximum(1 - np.abs(distance_N) / REACH, 0)
    expected_N3 = (np.sign(distance_N) * near_N)[:, None] * normal_3
    np.testing.assert_allclose(seen([plate], place_N3)[:, :3], expected_N3, atol=0.02 if made is irregular else 2e-5)


def test_the_distance_is_exact_but_for_edges():
    """Around shapes with faces, edges and curves the field's distance differs from the exact one by a tenth of a cell
    at most for nineteen of twenty places, and nothing within reach is unseen."""
    shapes = [("half_sphere", 0.3), ("cone", 0.3), ("half_box", 0.2), ("pyramid", 0.3)]
    obstacles = [shape_obstacle(name, size, (0.4 * i, 0.3, 0.3)) for i, (name, size) in enumerate(shapes)]
    place_N3 = np.random.default_rng(1).uniform((-0.2, 0.1, 0.1), (1.4, 0.5, 0.5), (20_000, 3))
    near_N, distance_N = np.linalg.norm(seen(obstacles, place_N3)[:, :3], axis=1), exact_distance(obstacles, place_N3)
    error_N = np.abs(near_N - np.maximum(1 - distance_N / REACH, 0)) * REACH_CELLS
    within_N = distance_N < REACH
    assert 2_000 < within_N.sum() < 18_000
    assert np.quantile(error_N[within_N], 0.95) < 0.1 and error_N.max() < 1.5
    assert (near_N[distance_N < 0.5 * REACH] > 0).mean() > 0.999 and (near_N[distance_N > 1.75 * REACH] == 0).all()


def test_beyond_an_edge_it_points_away_from_the_edge():
    """What is next to an edge is not above the plate: the direction leads away from the edge."""
    plate = shape_obstacle("square", 0.4, (0.3, 0.25, 0.5))
    (row,) = seen([plate], np.array([[0.5 + 0.018, 0.25 + 1e-3, 0.5]]))
    assert row[0] > 0.3 and row[0] > 2.5 * abs(row[1]) and abs(row[2]) < 0.05


def test_friction_is_that_of_the_nearest_surface():
    rough, smooth = (
        replace(shape_obstacle("square", 0.2, (x, 0.3, 0.5)), friction=f) for x, f in ((0.3, 0.7), (0.7, 0))
    )
    place_N3 = np.array([[0.3, 0.32, 0.5], [0.7, 0.32, 0.5], [0.3, 0.3 + 1.1 * REACH, 0.5]])
    np.testing.assert_allclose(seen([rough, smooth], place_N3)[:, 3], [0.7, 0.0, 0.0], rtol=1e-6)


def test_no_obstacle():
    grid = build_obstacle_grid([], CELL, 0)
    field = surface_field(grid, np.zeros((0, 3, 3)), (1.0, 1.0, 1.0))
    assert len(field.cell_K3) == len(field.normal_K3) == len(field.distance_K) == 0


def test_triangles_without_area_are_not_seen():
    """As in the paper's cells, a triangle that is a point or a line is no surface."""
    plate = shape_obstacle("square", 0.2, (0.5, 0.3, 0.5))
    corner_F33 = np.array([[[0.2, 0.8, 0.2]] * 3, [[0.1, 0.9, 0.5], [0.8, 0.9, 0.5], [0.3, 0.9, 0.5]]])
    grid = build_obstacle_grid([plate], CELL, 0)
    field, both = (surface_field(grid, np.concatenate([plate.corners, more])) for more in (corner_F33[:0], corner_F33))
    np.testing.assert_array_equal(both.cell_K3, field.cell_K3)
    assert len(surface_field(grid, corner_F33).cell_K3) == 0


def test_a_long_way_between_surfaces_takes_no_memory():
    """Two plates a hundred units apart, which a moving obstacle may have, have the cells of each of them."""
    near, far = (shape_obstacle("square", 0.1, (x, x, x)) for x in (0.5, 100.5))
    both = [near, far]
    first, second, field = (
        surface_field(build_obstacle_grid(own, CELL, 0), all_corners(own)) for own in ([near], [far], both)
    )
    np.testing.assert_array_equal(field.cell_K3, np.concatenate([first.cell_K3, second.cell_K3]))
    np.testing.assert_array_equal(first.cell_K3 + 6400, second.cell_K3)


def test_a_flat_set():
    """In a 2D set, whose meshes are not known, surfaces are across the normals of their cells."""
    normal_K3 = np.array([[0, 1, 0], [0, 1, 0], [0.6, 0.8, 0]], np.float32)
    grid = ObstacleGrid(0.1, np.array([[2, 3, 0], [3, 3, 0], [8, 3, 0]], np.int32), normal_K3)
    flat = {"dimensions": 2, "kind": "imported"}
    episode = replace(make_episode(cells=0, specification=flat), obstacle_grid=grid, domain_size=(1.0, 1.0, 0.1))
    place_N3 = torch.tensor([[0.3, 0.45, 0.05], [0.3, 0.25, 0.05], [0.85 + 0.06, 0.35 + 0.08, 0.05]])
    expected_N3 = [[0, 0.5, 0], [0, -0.5, 0], [0.3, 0.4, 0]]
    state = InitialState.of_episode(episode)
    for field in (field_of_episode(episode), state.field):
        seen_N3 = ObstacleCells.of([field]).normals(place_N3, torch.zeros(3, dtype=torch.int64))
        np.testing.assert_allclose(seen_N3, expected_N3, atol=1e-5)


def test_the_cached_fields_keep_no_episode():
    """Positions of an episode have up to hundreds of megabytes."""
    episode = make_episode(cells=3)
    field, gone = field_of_episode(episode), weakref.ref(episode)
    assert field_of_episode(replace(episode, key="other")) is field
    del episode
    assert gone() is None


def test_outside_the_domain_nothing_is_kept():
    """A plate ten units long has cells in the domain only, and a margin; they are those of the whole plate's field."""
    plate = shape_obstacle("square", 10.0, (0.5, 0.3, 0.5))
    grid = build_obstacle_grid([plate], CELL, 0, (0.5, 0.5, 0.5))
    field = surface_field(grid, plate.corners, (0.5, 0.5, 0.5))
    assert len(field.cell_K3) < 20_000 and (field.cell_K3[:, 1] > 12).all()
    inside_K = ((field.cell_K3 >= 0) & (field.cell_K3 < 32)).all(axis=1)
    assert inside_K.sum() == 32 * 32 * len(np.unique(field.cell_K3[inside_K, 1]))


@pytest.mark.parametrize("changes", [{"inputs": "absolute"}, {"inputs": "local", "obstacle_features": False}])
def test_it_needs_relative_inputs_and_normals(changes):
    with pytest.raises(ConfigError, match="obstacle_distance must be false with inputs=absolute or obstacle_features"):
        NetworkConfig(obstacle_distance=True, **changes)
