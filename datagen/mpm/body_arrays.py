"""Arrays of a launch's moving obstacles for kernels (datagen.mpm.body_kernel).

`contact` contains, in this order: the first of each scene's second fields, or -1 without moving sheets
(SHAPE.second_fields); the index of each scene's first head, and the end of the heads (SHAPE.bodies); the heads
(layout.BodyHead); for each obstacle a table of its lists by base node (-1: none), and the lists (see LIST_HEAD).
"""

from collections.abc import Sequence

import numpy as np

from datagen.mpm.body import SAMPLES_PER_CELL, Body
from datagen.mpm.layout import HEAD, KEY, STATE
from datagen.mpm.surface_kernel import LIST_HEAD, TRIANGLE_VECTORS
from datagen.mpm.sweep import Sweep


def body_arrays(
    bodies: Sequence[Sequence[Body]],
    second_fields: np.ndarray,
    frictions: Sequence[np.ndarray],
    cell_masses: Sequence[float],
    first_place: int,
    first_vector: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the part of `contact` from first_place on, that of `contact_normal` from first_vector on, and `pose`.

    All arguments except the last two have one entry for each scene; `frictions` contains those of all its obstacles.
    """
    counts = [len(own) for own in bodies]
    begins = first_place + 2 * len(counts) + 1 + HEAD.length * np.concatenate([[0], np.cumsum(counts)])
    heads, tables, vectors, poses = [], list[np.ndarray](), [np.zeros((0, 3), np.float32)], [np.zeros(1, np.float32)]
    place, pose = int(begins[-1]), 1
    for own, friction, cell_mass in zip(bodies, frictions, cell_masses, strict=True):
        for body in own:
            sweep = body.sweep
            cells = int(np.prod(body.shape))
            samples = 3 * len(body.sample_S33)
            head = np.empty(HEAD.length, np.int32)
            head[HEAD.closed], head[HEAD.state], head[HEAD.keys] = body.closed, pose, len(body.key_TK)
            head[HEAD.samples], head[HEAD.lists] = first_vector, place
            head[HEAD.shape : HEAD.shape + 3] = SAMPLES_PER_CELL * np.array(body.shape) + 1
            head[HEAD.cells : HEAD.cells + 3] = body.shape
            table = np.full(cells, -1, np.int32)
            table[np.ravel_multi_index(tuple(sweep.base_K3.T), body.shape)] = place + cells + list_begins(sweep)
            tables += [table, triangle_lists(sweep, first_vector + samples)]
            triangles = triangle_vectors(sweep, friction)
            vectors += [body.sample_S33.reshape(-1, 3), triangles.reshape(-1, 3)]
            state = np.zeros(STATE.first_key, np.float32)
            state[STATE.origin : STATE.origin + 3] = body.origin_3
            state[STATE.friction], state[STATE.cell_mass] = friction[body.obstacle], cell_mass
            state[STATE.bearing], state[STATE.key] = body.bearing, -1
            # a motion that begins at 0 or later begins in the pose of its first keyframe
            state[STATE.end : STATE.turn] = body.key_TK[0, KEY.place : KEY.turn]
            poses += [state, body.key_TK.ravel()]
            heads.append(head)
            place += cells + len(tables[-1])
            pose += len(state) + body.key_TK.size
            first_vector += samples + TRIANGLE_VECTORS * len(triangles)
    return (
        np.concatenate([second_fields, begins.astype(np.int32), *heads, *tables]),
        np.concatenate(vectors),
        np.concatenate(poses),
    )


def list_begins(sweep: Sweep) -> np.ndarray:
    """Returns the starts of a sweep's lists in `triangle_lists`, int32."""
    return (sweep.begin_K + LIST_HEAD * np.arange(len(sweep.begin_K))).astype(np.int32)


def triangle_lists(sweep: Sweep, first_vector: int) -> np.ndarray:
    """Returns the lists of a sweep with their heads, int32. The triangles' vectors start at first_vector."""
    count = np.diff(np.append(sweep.begin_K, len(sweep.triangle_L)))
    head = list_begins(sweep)
    lists = np.empty(LIST_HEAD * len(count) + len(sweep.triangle_L), np.int32)
    lists[head], lists[head + 1] = count, sweep.sheets_K
    body = np.arange(len(sweep.triangle_L)) + np.repeat(LIST_HEAD * np.arange(1, len(count) + 1), count)
    lists[body] = first_vector + TRIANGLE_VECTORS * sweep.triangle_L
    return lists


def triangle_vectors(sweep: Sweep, friction: np.ndarray) -> np.ndarray:
    """Returns the vectors of a sweep's triangles, float32 [F, TRIANGLE_VECTORS, 3]. `friction` is by obstacle."""
    vector = np.zeros((len(sweep.triangle_F43), TRIANGLE_VECTORS, 3), np.float32)
    vector[:, :4] = sweep.triangle_F43
    vector[:, 4, 0] = friction[sweep.obstacle_F]
    return vector
