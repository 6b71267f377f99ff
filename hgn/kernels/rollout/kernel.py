"""Integration on the device: a frame is taken only if nothing went wrong before it.

Shape legend: N particles, T frames kept between two looks of the host.
"""

from __future__ import annotations

import triton
import triton.language as tl

from hgn.kernels.keys import settle_keys

DIVERGED = tl.constexpr(4)


@triton.jit
def integrate(
    output,
    position,
    velocity,
    scene_of,
    domain,
    mean,
    std,
    particle_count,
    status,
    lost,
    frame,
    path,
    OUT: tl.constexpr,
    HISTORY: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """v += a, x += v, and the new positions into path [T, N, 3] at `frame`.

    Where the status is not zero, nothing changes. Particles that are not finite or farther from the domain than its
    own size are counted in `lost`, once an axis; `advance` then ends the simulation.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count * 3:
        return
    if tl.load(status) != 0:
        return
    entry = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = entry < count * 3
    row, axis = entry // 3, entry % 3
    a = tl.load(output + row * OUT + axis, mask=live, other=0.0)
    a = a * tl.load(std + axis) + tl.load(mean + axis)
    at = velocity + row * (3 * HISTORY) + axis
    newest = tl.load(at, mask=live, other=0.0)
    v = newest + a
    x = tl.load(position + entry, mask=live, other=0.0) + v
    for k in tl.static_range(HISTORY - 1):
        older = tl.load(at + 3 * (HISTORY - 2 - k), mask=live, other=0.0)
        tl.store(at + 3 * (HISTORY - 1 - k), older, mask=live)
    tl.store(at, v, mask=live)
    tl.store(position + entry, x, mask=live)
    tl.store(path + tl.load(frame).to(tl.int64) * count * 3 + entry, x, mask=live)
    size = tl.load(domain + tl.load(scene_of + row, mask=live, other=0) * 3 + axis, mask=live, other=1.0)
    inside = (x > -size) & (x < 2 * size)  # NaN is outside
    outside = tl.sum((live & (inside == 0)).to(tl.int32), 0)
    if outside > 0:
        tl.atomic_add(lost, outside)


@triton.jit
def advance(status, lost, frame):
    """Counts the frame, unless it was not taken."""
    if tl.load(status) == 0:
        tl.store(frame, tl.load(frame) + 1)
        if tl.load(lost) > 0:
            tl.store(status, DIVERGED)


settle_keys(globals())
