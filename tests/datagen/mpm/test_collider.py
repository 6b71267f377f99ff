"""Mesh obstacles: contact nodes of sheets and bodies, odd meshes, and nothing leaks."""

import dataclasses

import numpy as np
import pytest

from datagen.mpm.collider import BOTH_SIDES, build_collider
from datagen.mpm.solver import Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.distance import closest_points, contains
from hgn.scene.material import MATERIALS
from hgn.scene.scene import Obstacle, Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError

CELL = 1 / 16
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
CONFIG = MpmConfig(device="cpu")

NO_NODES = {
    "node_K3": np.zeros((0, 3), np.int32),
    "normal_K3": np.zeros((0, 3), np.float32),
    "kind_K": np.zeros(0, np.uint8),
}


def sheet(y: float, low: float = -0.2, high: float = 1.2) -> Obstacle:
    return Obstacle("sheet", np.array([[low, y, low], [high, y, low], [high, y, high], [low, y, high]]), QUAD, False)


def box(low: tuple, high: tuple, flip: bool = False) -> Obstacle:
    """A closed box of twelve triangles; corner number is 4 x + 2 y + z."""
    vertex = np.array([[(low, high)[x][0], (low, high)[y][1], (low, high)[z][2]] for x in (0, 1) for y in (0, 1) for z in (0, 1)])  # fmt: skip # noqa: E501
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangle = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    return Obstacle("box", vertex.astype(float), triangle[:, ::-1] if flip else triangle, True)


def scene_of(*obstacles: Obstacle, cell_size: float = CELL, **particles) -> Scene:
    empty = {"position_N3": np.zeros((0, 3), np.float32), "velocity_N3": np.zeros((0, 3), np.float32), "material_N": np.zeros(0, np.uint8)}  # fmt: skip # noqa: E501
    return Scene(**{**empty, **particles}, obstacles=obstacles, cell_size=cell_size)


def dropped(material: int, y: float, speed: float, *obstacles: Obstacle) -> Scene:
    position = np.random.default_rng(0).uniform((0.4, y, 0.4), (0.6, y + 0.15, 0.6), (250, 3)).astype(np.float32)
    velocity = np.tile(np.float32([0, -speed, 0]), (250, 1))
    return scene_of(*obstacles, position_N3=position, velocity_N3=velocity, material_N=np.full(250, material, np.uint8))


# a particle of each material: with it beside, every test shares one compiled kernel
BESIDE = scene_of(
    sheet(0.2), position_N3=np.float32([[0.3, 0.5, 0.5], [0.5, 0.5, 0.5], [0.7, 0.5, 0.5]]),
    velocity_N3=np.zeros((3, 3), np.float32), material_N=np.arange(3).astype(np.uint8),
)  # fmt: skip


def test_sheet_nodes() -> None:
    """A sheet claims the nodes within 1.5 cells with normals toward their own side; the nearest stop both ways."""
    y = 5.3 * CELL
    collider = build_collider(scene_of(sheet(y)), 1.5)
    assert sorted(set(collider.node_K3[:, 1])) == [4, 5, 6]
    assert len(collider.node_K3) == 3 * 16 * 16
    side = np.sign(collider.node_K3[:, 1] * CELL - y)
    assert np.allclose(collider.normal_K3, np.stack([0 * side, side, 0 * side], axis=1), atol=1e-6)
    assert set(collider.node_K3[collider.kind_K == BOTH_SIDES, 1]) == {5}


def test_one_layer_of_nodes_holds_a_level_sheet() -> None:
    """With the default band a level sheet has one layer of nodes wherever it lies, at most 0.15 cells above it as
    gravity goes; an upright one has the nodes within half a cell.
    """
    band = MpmConfig().collider_band_cells
    for offset in (0.0, 0.1, 0.15, 0.4, 0.5, 0.84, 0.86):
        height = 5 + offset
        for gravity, sign in ((-9.8, 1), (9.8, -1)):
            collider = build_collider(scene_of(sheet(height * CELL), gravity=(0.0, gravity, 0.0)), band)
            above = sign * (collider.node_K3[:, 1] - height)
            assert len(set(above)) == 1 or offset in (0.15, 0.85)
            assert above.min() >= -0.85 - 1e-5 and above.max() <= 0.15 + 1e-5
            assert (collider.kind_K == BOTH_SIDES).all()
        upright = build_collider(scene_of(sheet(height * CELL), gravity=(9.8, 0.0, 9.8)), band)
        assert np.abs(upright.node_K3[:, 1] - height).max() <= 0.5 + 1e-5


def test_sheet_on_nodes() -> None:
    """Where the sheet runs through nodes, those take the face normal and stop motion both ways."""
    collider = build_collider(scene_of(sheet(5 * CELL)), 1.5)
    on = collider.node_K3[:, 1] == 5
    assert (collider.kind_K[on] == BOTH_SIDES).all()
    assert np.allclose(np.abs(collider.normal_K3[on]), (0, 1, 0), atol=1e-6)
    assert np.allclose(np.linalg.norm(collider.normal_K3, axis=1), 1, atol=1e-6)


@pytest.mark.parametrize("flip", [False, True], ids=["outward", "inward"])
def test_body_nodes(flip: bool) -> None:
    """A closed body claims its inside but for a third of a cell, normals outward, whichever way its faces turn."""
    low, high = 4.2 * CELL, 11.1 * CELL
    collider = build_collider(scene_of(box((low,) * 3, (high,) * 3, flip)), 1.5)
    node = collider.node_K3 * CELL
    assert ((node > low + 0.35 * CELL) & (node < high - 0.35 * CELL)).all(axis=1).sum() == len(node) == 6**3
    centre = (low + high) / 2
    assert ((node - centre) * collider.normal_K3).sum(axis=1).min() > 0
    assert collider.count_inside(np.array([[0.5, 0.5, 0.5], [0.1, 0.5, 0.5]], np.float32)) == 1


def test_sheet_nodes_of_a_crumpled_mesh() -> None:
    """Over 120 random triangles of mixed size the contact nodes are exactly those that a search over all finds."""
    corner = np.random.default_rng(0).uniform(0, 1, (120, 1, 3))
    corner = (
        corner + np.random.default_rng(1).uniform(-1, 1, (120, 3, 3)) * np.geomspace(0.005, 0.2, 120)[:, None, None]
    )
    mesh = Obstacle("crumpled", corner.reshape(-1, 3), np.arange(360).reshape(-1, 3).astype(np.int32), False)
    collider = build_collider(scene_of(mesh, gravity=(0.0, 0.0, 0.0)), 1.5)
    node = np.stack(np.unravel_index(np.arange(16**3), (16,) * 3), axis=1)
    distance = np.full(len(node), np.inf)
    for triangle in corner:
        foot = closest_points(node * CELL, np.broadcast_to(triangle, (len(node), 3, 3)))
        distance = np.minimum(distance, np.linalg.norm(node * CELL - foot, axis=1))
    assert np.array_equal(collider.node_K3, node[distance <= 1.5 * CELL])


def test_closest_obstacle_wins() -> None:
    """Between two sheets each node takes the nearer one."""
    both = build_collider(scene_of(sheet(5.1 * CELL), sheet(7.1 * CELL)), 1.5)
    normal = {int(y): both.normal_K3[both.node_K3[:, 1] == y][0, 1] for y in (4, 6, 7, 8)}
    # node 6 is 0.9 above the lower sheet and 1.1 below the upper one
    assert {y: round(float(n)) for y, n in normal.items()} == {4: -1, 6: 1, 7: -1, 8: 1}


def test_odd_meshes() -> None:
    """No triangles, no area, wholly outside the domain: no contacts. Not finite, bad indices: refused."""
    point = Obstacle("point", np.full((3, 3), 0.5), np.array([[0, 1, 2]], np.int32), False)
    line = Obstacle("line", np.array([[0.2, 0.2, 0.2], [0.4, 0.4, 0.4], [0.6, 0.6, 0.6]]), np.array([[0, 1, 2]]), True)
    none = Obstacle("none", np.zeros((0, 3)), np.zeros((0, 3), np.int32), True)
    away = Obstacle("away", box((2, 2, 2), (3, 3, 3)).vertex_V3, box((2, 2, 2), (3, 3, 3)).triangle_F3, True)
    assert len(build_collider(scene_of(point, line, none, away), 1.5).node_K3) == 0
    with pytest.raises(ConfigError, match="vertex_V3 of obstacle 0"):
        build_collider(scene_of(Obstacle("nan", np.full((3, 3), np.nan), np.array([[0, 1, 2]]), False)), 1.5)
    with pytest.raises(ConfigError, match="triangle_F3 of obstacle 0"):
        build_collider(scene_of(Obstacle("index", np.eye(3), np.array([[0, 1, 3]]), False)), 1.5)


def test_one_huge_triangle_and_many_small_ones() -> None:
    """A triangle far larger than the domain, and its surface cut in 80,000, give the same contacts."""
    y, cells = 0.51, 200
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
    assert np.allclose(a.normal_K3, b.normal_K3, atol=1e-5)


@pytest.mark.parametrize("speed", [3.0, 10.0])
@pytest.mark.parametrize("offset", [0.0, 0.05, 0.3, 0.5, 0.7])
def test_sheets_do_not_leak(speed: float, offset: float) -> None:
    """Nothing passes an axis-aligned sheet at 3 and 10 m/s, wherever it lies between the nodes."""
    y = (5 + offset) * CELL
    scenes = [dropped(material, y + 2.5 * CELL, speed, sheet(y)) for material in range(3)]
    for name, outcome in zip(MATERIALS, simulate(scenes, CONFIG, 11, 60.0), strict=True):
        assert isinstance(outcome, Simulated), (name, outcome)
        assert outcome.position_TN3[:, :, 1].min() > y, name


def test_bodies_keep_particles_out() -> None:
    """Nothing enters a closed box, thick or thinner than a cell, and the counters say so."""
    thick = box((0.3, 0.25, 0.3), (0.7, 0.5, 0.7))
    thin = box((0.1, 0.48, 0.1), (0.9, 0.5, 0.9))
    scenes = [dropped(material, 0.63, 4, body) for material in range(3) for body in (thick, thin)]
    for outcome in simulate(scenes, CONFIG, 11, 60.0):
        assert isinstance(outcome, Simulated), outcome
        assert outcome.counters["particles_inside_obstacles_at_start"] == 0
        assert outcome.counters["particles_inside_obstacles_at_end"] == 0


def test_particles_inside_at_the_start_are_counted() -> None:
    """Particles that begin inside a body are counted, and the simulation stays finite."""
    scene = dropped(0, 0.4, 0, box((0.3, 0.3, 0.3), (0.7, 0.7, 0.7)))
    outcome, _ = simulate([scene, BESIDE], CONFIG, 3, 60.0)
    assert isinstance(outcome, Simulated)
    assert outcome.counters["particles_inside_obstacles_at_start"] == 250
    assert np.isfinite(outcome.position_TN3).all()


def test_friction_brakes() -> None:
    """On a sheet a block of snow slides on without friction and slower with it."""
    position = np.random.default_rng(0).uniform((0.25, 0.42, 0.4), (0.4, 0.55, 0.55), (250, 3)).astype(np.float32)
    velocity = np.tile(np.float32([2, 0, 0]), (250, 1))
    scene = scene_of(sheet(0.35), position_N3=position, velocity_N3=velocity, material_N=np.full(250, 2, np.uint8))
    moved = []
    for friction in (0.0, 0.6):
        config = MpmConfig(device="cpu", collider_friction=friction)
        outcome, _ = simulate([scene, BESIDE], config, 10, 60.0)
        moved.append((outcome.position_TN3[-1] - outcome.position_TN3[0])[:, 0].mean())
    assert moved[0] == pytest.approx(2 * 9 / 60, rel=0.05)
    assert moved[1] < 0.95 * moved[0]


def test_swept_test_alone_holds() -> None:
    """Without contact at the nodes particles pass a sheet and a cone; the swept test lets none pass, and counts."""
    cone = shape_obstacle("cone", 0.5, (0.5, 0.4, 0.5))
    scenes = [dropped(material, 0.68, 6, body) for material in range(3) for body in (sheet(5.3 * CELL), cone)]
    for projection in (False, True):
        config = MpmConfig(device="cpu", collider_band_cells=0.0, collider_projection=projection)
        colliders = [dataclasses.replace(build_collider(scene, 0.0), **NO_NODES) for scene in scenes]
        passed, counted = [], []
        for scene, outcome in zip(scenes, simulate(scenes, config, 13, 60.0, colliders=colliders), strict=True):
            assert isinstance(outcome, Simulated), outcome
            counted.append(outcome.counters["surface_projections"])
            path = outcome.position_TN3.reshape(-1, 3)
            passed.append(contains(path, cone).sum() if scene.obstacles[0].closed else (path[:, 1] < 5.3 * CELL).sum())
        if projection:
            assert passed == [0] * len(scenes) and min(counted) > 0
        else:
            assert min(passed) > 0 and counted == [0] * len(scenes)
