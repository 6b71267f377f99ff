"""Mesh obstacles: contact nodes of sheets and bodies, odd meshes, and nothing leaks."""

import dataclasses

import numpy as np
import pytest
from mpm_scenes import BOX, CELL, QUAD, box_corners, particles, sheet, simulated

from datagen.mpm.collider import HIDDEN, SEEN, build_collider
from hgn.scene.distance import closest_points, contains
from hgn.scene.material import MATERIALS, SAND, WATER
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Obstacle
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError

NO_NODES = {
    "node_K3": np.zeros((0, 3), np.int32),
    "normal_K23": np.zeros((0, 2, 3), np.float32),
    "obstacle_K2": np.zeros((0, 2), np.int32),
    "least_K2": np.zeros((0, 2), np.float32),
    "distance_K2": np.zeros((0, 2), np.float32),
    "doubled_K": np.zeros(0, bool),
}


def wide_sheet(height):
    """Beyond the domain on all sides."""
    return sheet(height, -0.2, 1.2)


def box(low, high, flip=False):
    return Obstacle("box", box_corners(low, high), BOX[:, ::-1] if flip else BOX, True)


def scene_of(*obstacles, **scene):
    return particles([], obstacles=obstacles, **scene)


def dropped(material, y, speed, *obstacles):
    place_N3 = np.random.default_rng(0).uniform((0.4, y, 0.4), (0.6, y + 0.15, 0.6), (250, 3))
    return particles(place_N3, material, (0, -speed, 0), obstacles=obstacles)


def test_sheet_nodes():
    """All nodes that a particle beyond a sheet reaches have two fields. What does not see the node is stopped, with the
    normal toward the sheet; what sees it up to a quarter of a cell from the sheet, with the normal away from it; both
    from the mass on that a node has where material lies 0.75 cells from the sheet.
    """
    for offset in (0.0, 0.1, 0.3, 0.39, 0.41, 0.5, 0.9):
        y = 5 + offset
        collider = build_collider(scene_of(wide_sheet(y * CELL)), 0.5)
        height = collider.node_K3[:, 1] - y
        assert len(collider.node_K3) == 16 * 16 * len(set(height))
        assert set(collider.node_K3[:, 1]) == {n for n in range(16) if abs(n - y) <= 1.5}
        assert collider.doubled_K.all()
        side = np.where(height > 0, 1.0, -1.0)  # what lies on the sheet is on the side of its normal, below
        near = np.abs(height) <= 0.25
        for field, expected in ((SEEN, np.where(near, side, 0.0)), (HIDDEN, -side)):
            expected_K3 = np.stack([0 * height, expected, 0 * height], 1)
            assert np.allclose(collider.normal_K23[:, field], expected_K3, atol=1e-6)
        # a spline's share of what lies more than 0.75 cells from the sheet, by summing
        place = np.arange(-2, 2, 1e-3) + 5e-4
        weight = 1e-3 * np.where(np.abs(place) < 0.5, 0.75 - place**2, 0.5 * np.clip(1.5 - np.abs(place), 0, None) ** 2)
        for field, own in ((SEEN, np.abs(height)), (HIDDEN, -np.abs(height))):
            share = [weight[place > 0.75 - h].sum() if h <= 0.25 else 0.0 for h in own]
            assert np.allclose(collider.least_K2[:, field], share, atol=2e-3)


def test_nodes_around_a_rim():
    """Nodes beyond the rim of a sheet stop what they are hidden from across the sheet, not along it."""
    half = Obstacle("half", np.array([[0.1, 0.33, 0.1], [0.5, 0.33, 0.1], [0.5, 0.33, 0.9], [0.1, 0.33, 0.9]]), QUAD, False)  # fmt: skip # noqa: E501
    collider = build_collider(scene_of(half), 0.5)
    beyond = collider.node_K3[:, 0] * CELL > 0.5
    assert beyond.any()
    normal = collider.normal_K23[beyond, HIDDEN]
    side = np.sign(collider.node_K3[beyond, 1] * CELL - 0.33)
    stops = normal.any(axis=1)
    assert stops.any() and np.allclose(normal[stops, 1], -side[stops], atol=1e-6)


@pytest.mark.parametrize("flip", [False, True], ids=["outward", "inward"])
def test_body_nodes(flip):
    """A closed body claims its inside and a quarter of a cell around, normals outward, whichever way its faces turn."""
    low, high = 4.2 * CELL, 10.8 * CELL
    collider = build_collider(scene_of(box((low,) * 3, (high,) * 3, flip)), 1.5)
    node = collider.node_K3 * CELL
    reach = np.linalg.norm(np.clip(node, low, high) - node, axis=1)
    assert len(node) == 6**3 + 6 * 6**2 and reach.max() <= 0.25 * CELL
    centre = (low + high) / 2
    assert ((node - centre) * collider.normal_K23[:, SEEN]).sum(axis=1).min() > 0
    assert not collider.doubled_K.any() and not collider.normal_K23[:, HIDDEN].any()
    assert collider.count_inside(np.array([[0.5, 0.5, 0.5], [0.1, 0.5, 0.5]], np.float32)) == 1


def test_sheet_nodes_of_a_crumpled_mesh():
    """Of 120 random triangles of mixed size the normal of each node is that of the nearest, as a search over all finds
    it, and every node that one passes within a particle's reach has two fields.
    """
    aside = np.random.default_rng(1).uniform(-1, 1, (120, 3, 3)) * np.geomspace(0.005, 0.2, 120)[:, None, None]
    corner = np.random.default_rng(0).uniform(0, 1, (120, 1, 3)) + aside
    mesh = Obstacle("crumpled", corner.reshape(-1, 3), np.arange(360).reshape(-1, 3).astype(np.int32), False)
    collider = build_collider(scene_of(mesh, gravity=(0.0, 0.0, 0.0)), 1.5)
    node = np.stack(np.unravel_index(np.arange(16**3), (16,) * 3), axis=1)
    distance, reached = np.full(len(node), np.inf), np.zeros(len(node), bool)
    foot = np.zeros((len(node), 3))
    for triangle in corner:
        place = closest_points(node * CELL, np.broadcast_to(triangle, (len(node), 3, 3)))
        away = np.linalg.norm(node * CELL - place, axis=1)
        foot[away < distance] = place[away < distance]
        distance = np.minimum(distance, away)
        reached |= (np.abs(node * CELL - place) <= 1.5 * CELL).all(axis=1)
    index = np.ravel_multi_index(collider.node_K3.T, (16,) * 3)
    assert collider.doubled_K.all() and set(np.flatnonzero(reached)) <= set(index)
    normal = collider.normal_K23[:, HIDDEN]
    # those of a rim lie across the nearest triangle instead
    toward = (foot - node * CELL)[index]
    assert ((toward * normal).sum(axis=1) >= -1.01e-4 * CELL).all()  # nodes nearer than 1e-4 are on one side


def test_closest_obstacle_wins():
    """Between two sheets each node takes the nearer one."""
    both = build_collider(scene_of(wide_sheet(5.1 * CELL), wide_sheet(7.1 * CELL)), 0.5)
    at = {int(y): both.node_K3[:, 1] == y for y in (4, 6, 7, 8)}
    normal = {y: round(float(both.normal_K23[rows, HIDDEN][0, 1])) for y, rows in at.items()}
    # node 6 is 0.9 above the lower sheet and 1.1 below the upper one
    assert normal == {4: 1, 6: -1, 7: 1, 8: -1}
    assert [set(both.obstacle_K2[rows, HIDDEN]) for rows in at.values()] == [{0}, {0}, {1}, {1}]


def test_odd_meshes():
    """No triangles, no area, wholly outside the domain, or around it on all sides, since no way leads out of it: no
    contacts. Not finite, bad indices: refused."""
    point = Obstacle("point", np.full((3, 3), 0.5), np.array([[0, 1, 2]], np.int32), False)
    line = Obstacle("line", np.array([[0.2, 0.2, 0.2], [0.4, 0.4, 0.4], [0.6, 0.6, 0.6]]), np.array([[0, 1, 2]]), True)
    none = Obstacle("none", np.zeros((0, 3)), np.zeros((0, 3), np.int32), True)
    away, around = box((2, 2, 2), (3, 3, 3)), box((-3,) * 3, (4,) * 3)
    for obstacles, band_cells in (((point, line, none, away), 1.5), ((around,), 0.25)):
        collider = build_collider(scene_of(*obstacles), band_cells)
        assert len(collider.node_K3) == 0 and (obstacles != (around,) or len(collider.sweep.base_K3) == 0)
    with pytest.raises(ConfigError, match="vertex_V3 of obstacle 0"):
        build_collider(scene_of(Obstacle("nan", np.full((3, 3), np.nan), np.array([[0, 1, 2]]), False)), 1.5)
    with pytest.raises(ConfigError, match="triangle_F3 of obstacle 0"):
        build_collider(scene_of(Obstacle("index", np.eye(3), np.array([[0, 1, 3]]), False)), 1.5)


def test_one_huge_triangle_and_many_small_ones():
    """A triangle far larger than the domain, and its surface cut in 20,000, give the same contacts."""
    y, cells = 0.51, 100
    huge = Obstacle("huge", np.array([[-90.0, y, -90], [90, y, -90], [0, y, 180]]), np.array([[0, 1, 2]]), False)
    line = np.linspace(-0.5, 1.5, cells + 1)
    x, z = np.meshgrid(line, line, indexing="ij")
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    first = np.stack([corner, corner + 1, corner + cells + 1], axis=1)
    second = np.stack([corner + 1, corner + cells + 2, corner + cells + 1], axis=1)
    vertex = np.stack([x.ravel(), np.full(x.size, y), z.ravel()], axis=1)
    fine = Obstacle("fine", vertex, np.concatenate([first, second]).astype(np.int32), False)
    a, b = build_collider(scene_of(huge), 1.5), build_collider(scene_of(fine), 1.5)
    assert len(a.node_K3) > 0
    assert np.array_equal(a.node_K3, b.node_K3)
    assert np.allclose(a.normal_K23, b.normal_K23, atol=1e-5)


def test_sheets_do_not_leak():
    """Nothing passes an axis-aligned sheet at 3 and 10 m/s, wherever it lies between the nodes."""
    heights = [(5 + offset) * CELL for offset in (0.0, 0.3, 0.5)]
    cases = [(kind, y, 3.0 if n % 2 else 10.0) for kind in range(len(MATERIALS)) for n, y in enumerate(heights)]
    cases += [(SAND, heights[0], 3.0), (WATER, heights[1], 10.0)]
    scenes = [dropped(material, y + 2.5 * CELL, speed, wide_sheet(y)) for material, y, speed in cases]
    for case, outcome in zip(cases, simulated(scenes, frames=8), strict=True):
        assert outcome.position_TN3[:, :, 1].min() > case[1], case


def test_tilted_sheets_and_bowls_do_not_leak():
    """At 10 m/s no particle passes a tilted sheet from wall to wall, or the wall of a bowl."""
    turn, middle = euler_rotation((27.0, 0.0, 13.0)), np.array([0.5, 0.35, 0.5])
    tilted, bowl = (shape_obstacle(name, size, tuple(middle), of) for name, size, of in (
        ("square", 3.0, turn), ("half_sphere", 0.5, np.eye(3)),
    ))  # fmt: skip
    cases = [(kind, obstacle) for kind in range(3) for obstacle in (tilted, bowl)]
    outcomes = simulated([dropped(kind, 0.6, 10.0, obstacle) for kind, obstacle in cases], frames=6)
    rim = bowl.vertex_V3[:, 1].max()
    for (kind, obstacle), outcome in zip(cases, outcomes, strict=True):
        path = outcome.position_TN3.reshape(-1, 3)
        if obstacle is tilted:
            assert ((path - middle) @ turn[:, 1]).min() > 0, kind
        else:
            low = path[path[:, 1] < rim]
            assert len(low) and np.linalg.norm(low - (0.5, rim, 0.5), axis=1).max() < 0.25, kind


def test_bodies_keep_particles_out():
    """Nothing enters a closed box, thick or thinner than a cell, and the counters say so; particles that begin inside
    one are counted, and the simulation stays finite."""
    thick = box((0.3, 0.25, 0.3), (0.7, 0.5, 0.7))
    thin = box((0.1, 0.48, 0.1), (0.9, 0.5, 0.9))
    scenes = [dropped(material, 0.63, 4, body) for material in range(3) for body in (thick, thin)]
    inside = dropped(0, 0.4, 0, box((0.3, 0.3, 0.3), (0.7, 0.7, 0.7)))
    *outcomes, caught = simulated([*scenes, inside, dropped(0, 0.63, 4, wide_sheet(0.5))], frames=11)[:-1]
    for outcome in outcomes:
        assert outcome.counters["particles_inside_obstacles_at_start"] == 0
        assert outcome.counters["particles_inside_obstacles_at_end"] == 0
    assert caught.counters["particles_inside_obstacles_at_start"] == 250 and np.isfinite(caught.position_TN3).all()


def test_swept_test_alone_holds():
    """Without contact at the nodes the swept test lets no particle pass a sheet or a cone, and counts."""
    cone = shape_obstacle("cone", 0.5, (0.5, 0.4, 0.5))
    obstacles = (wide_sheet(5.3 * CELL), cone)
    scenes = [dropped(material, 0.68, 6, body) for material in range(len(MATERIALS)) for body in obstacles]
    colliders = []
    for scene in scenes:
        collider = build_collider(scene, 0.0)
        sweep = dataclasses.replace(collider.sweep, sheets_K=0 * collider.sweep.sheets_K)
        colliders.append(dataclasses.replace(collider, sweep=sweep, **NO_NODES))
    other = dropped(WATER, 0.68, 6, obstacles[0])  # has nodes; with it tests share a compiled kernel
    batch, colliders = [*scenes, other], [*colliders, build_collider(other, 0.0)]
    for scene, outcome in zip(scenes, simulated(batch, frames=13, colliders=colliders), strict=False):
        path = outcome.position_TN3.reshape(-1, 3)
        passed = contains(path, cone) if scene.obstacles[0].closed else path[:, 1] < 5.3 * CELL
        assert passed.sum() == 0 and outcome.counters["surface_projections"] > 0


@pytest.mark.parametrize("shape", ["square", "half_sphere"])
def test_bound_of_centres_changes_no_bit(shape, monkeypatch):
    """The pass over the centres of triangles saves work only: contacts are the same with it and without it."""
    scene = scene_of(shape_obstacle(shape, 0.6, (0.5, 0.47, 0.5)))
    colliders = []
    for radius in (0.0, np.inf):  # never, always
        monkeypatch.setattr("datagen.mpm.surface_samples.LARGE_RADIUS", radius)
        colliders.append(build_collider(scene, 1.0))
    for name in NO_NODES:
        assert np.array_equal(*(getattr(one, name) for one in colliders)), name
