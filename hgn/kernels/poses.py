"""Moves places and directions to the frames of moving obstacles and back, on the device.

The table of hgn.kernels.moving has a record of RECORD int64 numbers for each instant and each row (hgn.network.moving):
the row of the obstacle table, that of the barrier table, and POSE float32 numbers R, p, c, A, b, R' and p'. The kernels
read the number of the instant on the device, because CUDA graphs repeat their arguments.
"""

import triton
import triton.language as tl

from hgn.kernels.obstacles import BARRIER_COLUMNS, OBSTACLE_COLUMNS
from hgn.kernels.triton_compat import settle_keys

FIRST_POSE = OBSTACLE_COLUMNS.value + BARRIER_COLUMNS.value  # column of the poses
POSE = 40  # float32 numbers of a pose, with padding
ROW_COLUMNS = FIRST_POSE + POSE // 2

RECORD, BARRIER = tl.constexpr(ROW_COLUMNS), tl.constexpr(OBSTACLE_COLUMNS.value)
POSES = tl.constexpr(2 * FIRST_POSE)  # float32 column of R
PLACE, PIVOT, CHANGE, SHIFT = tl.constexpr(9), tl.constexpr(12), tl.constexpr(15), tl.constexpr(24)
LATER, LATER_PLACE = tl.constexpr(27), tl.constexpr(36)


@triton.jit
def turned(matrix, vector, live, BACK: tl.constexpr):
    """Returns M times vectors, with BACK its transpose times vectors. `matrix` are the addresses of M, row by row."""
    result = ()
    for i in tl.static_range(3):
        total = tl.load(matrix + (i if BACK else 3 * i), mask=live, other=0.0) * vector[0]
        total += tl.load(matrix + (3 + i if BACK else 3 * i + 1), mask=live, other=0.0) * vector[1]
        total += tl.load(matrix + (6 + i if BACK else 3 * i + 2), mask=live, other=0.0) * vector[2]
        result = result + (total,)  # noqa: RUF005 - Triton does not support unpacking here
    return result


@triton.jit
def plus(vector, place, live, sign: tl.constexpr):
    """Returns vectors plus `sign` times those at the addresses `place`."""
    x = vector[0] + sign * tl.load(place, mask=live, other=0.0)
    y = vector[1] + sign * tl.load(place + 1, mask=live, other=0.0)
    return x, y, vector[2] + sign * tl.load(place + 2, mask=live, other=0.0)


@triton.jit
def undone(pose, place, live, ROTATION: tl.constexpr, AT: tl.constexpr):
    """Returns places in the obstacles' frames (Poses.undo), with columns 0 and PLACE of `pose` those of this frame."""
    return plus(turned(pose + ROTATION, plus(place, pose + AT, live, -1), live, True), pose + PIVOT, live, 1)


@triton.jit
def surface_motion(pose, place, live):
    """Returns V at places (Poses.velocity)."""
    return plus(turned(pose + CHANGE, plus(place, pose + PLACE, live, -1), live, False), pose + SHIFT, live, 1)


settle_keys(globals())
