"""Simulates the scenes of a data set on a finer grid than the networks see, with more particles.

Each visible particle of a scene is represented by the same number of fine particles, its children. The first child
starts at the position of the visible particle. The others start around it, and their mean is there. So all fine
particles have the same mass, and a scene's first frame, total mass, momentum and centre of mass do not depend on the
grid. An episode contains the first child of each visible particle. It does not contain the children's mean, because
this is no point of the material once they separate (results/solver/README.md).
Shape legend: T frames, N visible particles, C children of each, M = N C fine particles, F triangles.
"""

import dataclasses

import numpy as np

from hgn.config import DatagenConfig, MpmConfig
from hgn.scene.distance import closest_points
from hgn.scene.scene import Scene
from hgn.scene.streams import Stream, stream

SURFACE_FRACTION = 0.9  # fraction of the distance to an obstacle's surface within which children may start


def fine_scene(scene: Scene, cell_size: float, wall: float) -> Scene:
    """Returns the scene with its particles' children for a grid of `cell_size`; the same scene for its own cell size.

    The number of children is the ratio of the cells' volumes, rounded. They fill the volume that a particle has at the
    start. They stay at least `wall` from the domain's planes, and do not cross the surface of an obstacle.
    """
    volume = (scene.cell_size / cell_size) ** 3
    children = max(1, round(volume))
    if abs(volume - 1) < 1e-6:
        return scene
    offset_NC3 = _offsets(scene, children, wall)
    density = scene.particles_per_cell
    return dataclasses.replace(
        scene.selected(np.repeat(np.arange(scene.particle_count), children)),
        position_N3=(scene.position_N3[:, None] + offset_NC3).astype(np.float32).reshape(-1, 3),
        cell_size=cell_size,
        particles_per_cell=None if density is None else density * children / volume,
    )


def wall_thickness(config: MpmConfig, cell_size: float) -> float:
    """Returns the thickness of the near walls, up to their last node. Far walls are one cell thicker."""
    return (config.wall_cells - 1) * cell_size


def solver_on_grid(config: MpmConfig, cell_size: float, own_cell_size: float) -> MpmConfig:
    """Returns the solver's settings for another cell size.

    On a finer grid near walls end at the same position, and far walls less than a cell further out. On a coarser grid
    near walls end less than one of its cells from that position.
    """
    ratio = own_cell_size / cell_size
    return dataclasses.replace(config, wall_cells=max(2, 1 + int((config.wall_cells - 1) * ratio + 1e-6)))


def visible_positions(position_TM3: np.ndarray, visible: int) -> np.ndarray:
    """Returns the positions of `visible` particles from the positions of all children, float32 [T, N, 3]."""
    children = position_TM3.shape[1] // max(visible, 1)
    return position_TM3 if children <= 1 else np.ascontiguousarray(position_TM3[:, ::children])


def scene_to_simulate(scene: Scene, config: DatagenConfig) -> Scene:
    """Returns the scene that the solver simulates for a scene of a data set, with settings of `solver_on_grid`."""
    return fine_scene(scene, config.reference_cell_size, wall_thickness(config.mpm, scene.cell_size))


def _offsets(scene: Scene, children: int, wall: float) -> np.ndarray:
    """Returns the children's offsets, float64 [N, C, 3]. The first offset and their mean are zero."""
    generator = stream(scene.seed, Stream.FINER_PARTICLES)
    # edge of the cube that a particle fills; in single precision, because cubic roots differ between machines
    edge = scene.cell_size / float(np.float32((scene.particles_per_cell or 8.0) ** (1 / 3)))
    offset_NC3 = np.zeros((scene.particle_count, children, 3))
    others_NC3 = offset_NC3[:, 1:]
    if others_NC3.size == 0:
        return offset_NC3
    others_NC3[:] = edge * (generator.random(others_NC3.shape) - 0.5)
    others_NC3 -= others_NC3.mean(axis=1, keepdims=True)
    room_N3 = np.minimum(scene.position_N3 - wall, np.array(scene.domain_size) - wall - scene.position_N3)
    reach_N3 = np.abs(others_NC3).max(axis=1)
    offset_NC3 *= np.clip(room_N3 / np.maximum(reach_N3, 1e-12), 0.0, 1.0)[:, None]
    reach_N = np.sqrt((offset_NC3**2).sum(axis=2).max(axis=1))
    room_N = SURFACE_FRACTION * _surface_distances(scene, edge)
    offset_NC3 *= np.clip(room_N / np.maximum(reach_N, 1e-12), 0.0, 1.0)[:, None, None]
    return offset_NC3


def _surface_distances(scene: Scene, reach: float) -> np.ndarray:
    """Returns the particles' distances to obstacles in their first pose, float64 [N]; inf if more than `reach`."""
    from scipy.spatial import cKDTree

    distance_N = np.full(scene.particle_count, np.inf)
    tree = cKDTree(scene.position_N3)
    for obstacle in scene.obstacles:
        corner_F33 = obstacle.at(0.0).corners
        centre_F3 = corner_F33.mean(axis=1)
        radius_F = np.sqrt(((corner_F33 - centre_F3[:, None]) ** 2).sum(axis=2).max(axis=1, initial=0.0))
        for corner_33, near in zip(corner_F33, tree.query_ball_point(centre_F3, radius_F + reach), strict=True):
            if near:
                point_P3 = scene.position_N3[near].astype(np.float64)
                away_P3 = point_P3 - closest_points(point_P3, np.broadcast_to(corner_33, (len(near), 3, 3)))
                distance_P = np.sqrt((away_P3**2).sum(axis=1))
                distance_N[near] = np.minimum(distance_N[near], np.where(distance_P <= reach, distance_P, np.inf))
    return distance_N
