"""Moving obstacles in their own frames: samples of the surface on a grid, lists of triangles, and the motion.

An obstacle's frame turns and moves with it. Kernels (datagen.mpm.body_kernel) transform nodes and particles into this
frame, so contacts are computed once. All lengths are in the solver's cells. The frame's axes are the principal axes of
the vertices, if the grid is smaller with them: a tilted sheet then needs few samples.
Shape legend: S samples, F triangles, T keyframes.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from datagen.mpm.layout import KEY
from datagen.mpm.surface_samples import Box, closed_samples, sheet_samples, triangles_of
from datagen.mpm.sweep import Sweep, build_sweep
from hgn.scene.motion import Motion, turning
from hgn.scene.scene import Obstacle, Scene
from hgn.schema import require

STENCIL_CELLS = 1.501  # largest distance of a particle's nodes along each axis, with rounding
WIDENED = 1 + 1e-3  # factor for triangles, because kernels search a ten-thousandth beyond their edges
REACH_CELLS = WIDENED * STENCIL_CELLS * np.sqrt(3.0)  # largest distance of a particle's nodes in any direction
SAMPLES_PER_CELL = 2  # samples along an axis; between them the surface is interpolated
FAR = 1000.0  # distance of samples that are too far from the surface
MARGIN = 3**0.5 / SAMPLES_PER_CELL  # distance of the samples around a point from it
CLOSED_REACH = 1.5  # half the side of the cube around a particle in which lists contain a closed body's triangles
SHEET_REACH = 0.5 + REACH_CELLS  # the same for sheets: a particle's nodes lie in it, however the frame is turned
MAXIMUM_MOVE_CELLS = 100.0  # largest motion of an obstacle in a frame


@dataclass(frozen=True, eq=False)
class Body:
    """A moving obstacle. The origin of its frame is the first sample."""

    obstacle: int  # index in the scene
    closed: bool
    bearing: float  # height above a thin closed body up to which nodes stop motion
    origin_3: np.ndarray  # float64, from the origin to the pivot of the motion
    shape: tuple[int, int, int]  # number of cells along each axis of the frame
    # float32 [S, 3, 3]: the vector from the closest surface point, without its part along a sheet beyond the rim;
    # the normal, outward or of the nearest triangle; and for closed bodies the height above the surface and 1 at
    # thin places, for sheets the distance along the sheet from its rim and 1 where the rim is nearest
    sample_S33: np.ndarray
    sweep: Sweep
    key_TK: np.ndarray  # float32, see layout.Key


def build_body(obstacle: Obstacle, index: int, band: float, scene: Scene) -> list[Body]:
    """Returns a moving obstacle in its own frame; nothing if it never comes near the domain."""
    motion, cell_size = obstacle.motion, scene.cell_size
    assert motion is not None
    pivot = np.asarray(motion.pivot, np.float64)
    triangle_F33, rim_F6 = triangles_of(obstacle, index, cell_size)
    if not len(triangle_F33):
        return []
    reach = REACH_CELLS + MARGIN
    axes_33 = _axes(triangle_F33, reach)
    triangle_F33 = (triangle_F33 - pivot / cell_size) @ axes_33.T
    low, high = _visited(motion, scene, axes_33)
    low = np.floor(np.maximum(triangle_F33.min(axis=(0, 1)) - reach, low))
    high = np.ceil(np.minimum(triangle_F33.max(axis=(0, 1)) + reach, high))
    if (high <= low).any():
        return []
    x, y, z = (high - low).astype(int).tolist()
    triangle_F33 = triangle_F33 - low
    box = Box(
        SAMPLES_PER_CELL * triangle_F33,
        SAMPLES_PER_CELL * reach,
        tuple(SAMPLES_PER_CELL * cells + 1 for cells in (x, y, z)),
        SAMPLES_PER_CELL,
    )
    vertex_V3 = (obstacle.vertex_V3 - pivot) @ axes_33.T - low * cell_size
    own = dataclasses.replace(obstacle, vertex_V3=vertex_V3, motion=None)
    return [
        Body(
            index,
            obstacle.closed,
            max(band, 1.0),
            -low,
            (x, y, z),
            _samples(own, SAMPLES_PER_CELL * triangle_F33, rim_F6, band, box, cell_size / SAMPLES_PER_CELL),
            build_sweep(
                triangle_F33,
                np.full(len(triangle_F33), index),
                0 if obstacle.closed else len(triangle_F33),
                (x, y, z),
                CLOSED_REACH if obstacle.closed else SHEET_REACH,
            ),
            _keys(obstacle, motion, cell_size, axes_33),
        )
    ]


def _samples(
    obstacle: Obstacle, triangle_F33: np.ndarray, rim_F6: np.ndarray, band: float, box: Box, spacing: float
) -> np.ndarray:
    count = int(np.prod(box.grid))
    sample = np.zeros((count, 3, 3), np.float32)
    sample[:, 2, 0] = FAR
    if obstacle.closed:
        flat, height, normal, thin = closed_samples(obstacle, triangle_F33, band, box, spacing)
        offset, along, flag = height[:, None] * normal, height, thin
    else:
        flat, distance, depth, away, flag, normal = sheet_samples(triangle_F33, rim_F6, box)
        offset, along = depth[:, None] * away, np.sqrt(np.maximum(distance**2 - depth**2, 0.0)) * flag
    place = box.flat_in_grid(flat)
    sample[place, 0] = offset / SAMPLES_PER_CELL
    sample[place, 1] = normal
    sample[place, 2, 0] = along / SAMPLES_PER_CELL
    sample[place, 2, 1] = flag
    return sample


def _axes(triangle_F33: np.ndarray, reach: float) -> np.ndarray:
    """Returns the axes of the frame as rows, float64 [3, 3]: those of the scene, or principal axes."""
    corner_P3 = triangle_F33.reshape(-1, 3)
    _, _, axes_33 = np.linalg.svd(corner_P3 - corner_P3.mean(axis=0), full_matrices=False)
    axes_33[2] = np.cross(axes_33[0], axes_33[1])
    own, given = (
        float(np.prod(np.ptp(place_P3, axis=0) + 2 * reach)) for place_P3 in (corner_P3 @ axes_33.T, corner_P3)
    )
    return axes_33 if own < 0.9 * given else np.eye(3)


def _visited(motion: Motion, scene: Scene, axes_33: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the box around the pivot, in the obstacle's frame, that contains the domain at all times, in cells."""
    corner_83 = np.array(np.meshgrid(*((0.0, length) for length in scene.domain_size))).reshape(3, -1).T
    place_T83 = corner_83 - (np.asarray(motion.pivot) + motion.translation_T3)[:, None]
    if (motion.rotation_T33 == motion.rotation_T33[0]).all():
        own_T83 = place_T83 @ motion.rotation_T33[0] @ axes_33.T
        low, high = own_T83.min(axis=(0, 1)), own_T83.max(axis=(0, 1))
    else:
        high = np.full(3, np.linalg.norm(place_T83, axis=2).max())
        low = -high
    return low / scene.cell_size - 1, high / scene.cell_size + 1


def _keys(obstacle: Obstacle, motion: Motion, cell_size: float, axes_33: np.ndarray) -> np.ndarray:
    key = np.zeros((len(motion.time_T), KEY.length), np.float32)
    arm = np.linalg.norm(obstacle.vertex_V3 - np.asarray(motion.pivot), axis=1).max(initial=0.0)
    rotation_T33, place_T3 = motion.rotation_T33, np.asarray(motion.pivot) + motion.translation_T3
    key[:, KEY.time] = motion.time_T
    key[:, KEY.place : KEY.place + 3] = place_T3 / cell_size
    key[:, KEY.axes : KEY.axes + 9] = (axes_33 @ rotation_T33.transpose(0, 2, 1)).reshape(-1, 9)
    for k, span in enumerate(np.diff(motion.time_T)):
        turn = turning(rotation_T33[k + 1] @ rotation_T33[k].T) / span
        velocity = (place_T3[k + 1] - place_T3[k]) / span
        key[k, KEY.turn : KEY.turn + 3] = turn
        key[k, KEY.velocity : KEY.velocity + 3] = velocity / cell_size
        key[k, KEY.speed] = np.linalg.norm(velocity) + np.linalg.norm(turn) * arm
    return key


def require_slow(scenes: Sequence[Scene], frame_rate_hz: float) -> None:
    """Raises: ConfigError if an obstacle moves more than MAXIMUM_MOVE_CELLS in a frame."""
    for index, scene in enumerate(scenes):
        for number, obstacle in enumerate(scene.obstacles):
            if obstacle.motion is None:
                continue
            key_TK = _keys(obstacle, obstacle.motion, scene.cell_size, np.eye(3))
            fastest = int(key_TK[:, KEY.speed].argmax())
            way = float(key_TK[fastest, KEY.speed]) / (frame_rate_hz * scene.cell_size)
            require(
                way <= MAXIMUM_MOVE_CELLS,
                f"obstacles[{number}].keyframes of scene {index}",
                f"no faster than {MAXIMUM_MOVE_CELLS:g} cells a frame",
                f"{way:.4g} after {float(key_TK[fastest, KEY.time]):.4g} s",
                "move it more slowly",
            )
