"""Integration on the device: a frame is taken only if nothing went wrong before it.

Shape legend: N particles, T frames kept between two looks of the host.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.barriers import BARRIER_COLUMNS, kept_apart, wall_limit
from hgn.kernels.triton_compat import gdc_launch_dependents, gdc_wait, settle_keys

DIVERGED = tl.constexpr(4)


@triton.jit
def _axes(at, live):
    """The three coordinates of each particle, a vector each."""
    x, y = tl.load(at, mask=live, other=0.0), tl.load(at + 1, mask=live, other=0.0)
    return x, y, tl.load(at + 2, mask=live, other=0.0)


@triton.jit
def integrate(
    output, position, velocity, scene_of, domain, gravity, mean, std, particle_count, status, lost, frame, path,
    near, far, barrier_table, within, slack, least_crease, OUT: tl.constexpr, HISTORY: tl.constexpr,
    COLUMNS: tl.constexpr, WALLED_AXES: tl.constexpr, SURFACES: tl.constexpr, OVERLAP: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """v += a, x += v, and the new positions into path [T, N, 3] at `frame`; a is gravity and the restored output.

    Where the status is not zero, nothing changes. Particles that are not finite or farther from the domain than its
    own size are counted in `lost`, once an axis; `advance` then ends the simulation. All others are held between the
    walls of the first WALLED_AXES axes, `near` and `far` from the planes, and, with SURFACES, by obstacles, as
    hgn.kernels.barriers says of `barrier_table` and the numbers behind it; hgn.runtime.holding has the rule.

    Reference: hgn.runtime.simulator.Simulator on the torch backend; test: tests/kernels/test_rollout.py.
    """
    if OVERLAP:
        gdc_wait()
        gdc_launch_dependents()
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    if tl.load(status) != 0:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, COLUMNS)[None, :]  # of the velocities, newest first: a particle's lie side by side
    axis, newest = column % 3, column < 3
    live = (row < count)[:, None] & (column < 3 * HISTORY)
    live_axis = live & newest
    entry = row[:, None] * 3 + axis
    at = velocity + row[:, None] * (3 * HISTORY) + column
    v = tl.load(at - tl.where(newest, 0, 3), mask=live, other=0.0)
    a = tl.load(output + row[:, None] * OUT + axis, mask=live_axis, other=0.0)
    a = a * tl.load(std + axis) + tl.load(mean + axis)
    scene = tl.load(scene_of + row, mask=row < count, other=0)
    a += tl.load(gravity + scene[:, None] * 3 + axis, mask=live_axis, other=0.0)
    v = tl.where(newest, v + a, v)
    before = tl.load(position + entry, mask=live_axis, other=0.0)
    x = before + v
    size = tl.load(domain + scene[:, None] * 3 + axis, mask=live_axis, other=1.0)
    inside = (x > -size) & (x < 2 * size)  # NaN is outside
    if WALLED_AXES > 0:
        stopped, limit = wall_limit(x, before, size, near, far)
        stopped = stopped & live_axis & (axis < WALLED_AXES)
        v = tl.where(stopped, limit - before, v)
        x = tl.where(stopped, limit, x)
    if SURFACES > 0:
        begin = position + row * 3
        bx, by, bz = _axes(begin, row < count)
    now = tl.load(frame).to(tl.int64)
    tl.debug_barrier()  # all have read before one writes
    tl.store(at, v, mask=live)
    tl.store(position + entry, x, mask=live_axis)
    tl.store(path + now * count * 3 + entry, x, mask=live_axis)
    outside = tl.sum(tl.sum((live_axis & (inside == 0)).to(tl.int32), 1), 0)
    if outside > 0:
        tl.atomic_add(lost, outside)
    if SURFACES > 0:
        tl.debug_barrier()  # what other threads wrote is read: as columns of the above, each number would be in 16
        x, y, z = _axes(begin, row < count)
        width, height, depth = _axes(domain + scene * 3, row < count)
        line = barrier_table + scene * BARRIER_COLUMNS
        ends = kept_apart(
            bx, by, bz, x, y, z, width, height, depth, line, row < count, within, slack, least_crease, near, far,
            SURFACES, WALLED_AXES > 0,
        )  # fmt: skip
        begins, free = (bx, by, bz), (x, y, z)
        for k in tl.static_range(3):
            moved = (row < count) & (ends[k] != free[k])
            tl.store(begin + k, ends[k], mask=moved)
            tl.store(path + now * count * 3 + row * 3 + k, ends[k], mask=moved)
            tl.store(velocity + row * (3 * HISTORY) + k, ends[k] - begins[k], mask=moved)


@triton.jit
def advance(status, lost, frame, OVERLAP: tl.constexpr):
    """Counts the frame, unless it was not taken.

    Reference: hgn.runtime.simulator.Simulator on the torch backend; test: tests/kernels/test_rollout.py.
    """
    if OVERLAP:
        gdc_wait()
    if tl.load(status) == 0:
        tl.store(frame, tl.load(frame) + 1)
        if tl.load(lost) > 0:
            tl.store(status, DIVERGED)


settle_keys(globals())
