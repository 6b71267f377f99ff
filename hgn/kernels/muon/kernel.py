"""Computes Muon's momentum and steps on square blocks of the packed weights, see hgn.training.muon."""

import triton
import triton.language as tl

from hgn.kernels.blocks import nearest_tf32
from hgn.kernels.triton_compat import settle_keys


@triton.jit
def momentum_directions(
    starts, pitch, gradient, rank_weight, first_moment, direction, status, norm, momentum, epsilon,
    WIDTH: tl.constexpr,
):  # fmt: skip
    """Updates the momentum of square blocks (hgn.network.orthogonal), and writes Nesterov's normalised momentum.

    The blocks begin at `starts`, and their rows are `pitch` apart. The output is direction [blocks, WIDTH, WIDTH]. Each
    block has a program. The kernel does nothing where `adam` does nothing.

    Rule: hgn.training.muon.Muon; test: tests/kernels/test_update.py.
    """
    if tl.load(status) != 0:
        return
    if (tl.load(norm) < float("inf")) == 0:
        return
    block = tl.program_id(0)
    row, column = tl.arange(0, WIDTH)[:, None], tl.arange(0, WIDTH)[None, :]
    place = row * WIDTH + column
    at = tl.load(starts + block) + row * tl.load(pitch + block) + column
    g = tl.load(gradient + at) * rank_weight
    m = tl.load(first_moment + at)
    m += (g - m) * (1 - momentum)
    tl.store(first_moment + at, m)
    ahead = m + (g - m) * (1 - momentum)
    length = tl.sqrt(tl.sum(tl.sum(ahead * ahead, 1), 0)) + epsilon
    tl.store(direction + block * WIDTH * WIDTH + place, ahead / length)


@triton.jit
def step_blocks(
    starts, pitch, direction, value, weight, rates, update, status, norm, step_size,
    PRECISION: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Moves square blocks against their directions by rate times `step_size`. It writes values and weights as `adam`.

    Rule: hgn.training.muon.Muon; test: tests/kernels/test_update.py.
    """
    if tl.load(status) != 0:
        return
    if (tl.load(norm) < float("inf")) == 0:
        return
    block = tl.program_id(0)
    row, column = tl.arange(0, WIDTH)[:, None], tl.arange(0, WIDTH)[None, :]
    place = row * WIDTH + column
    at = tl.load(starts + block) + row * tl.load(pitch + block) + column
    along = tl.load(direction + block * WIDTH * WIDTH + place).to(tl.float32)
    rate = tl.load(rates + tl.load(update))
    x = tl.load(value + at)
    x -= rate * (step_size * along)
    tl.store(value + at, x)
    if PRECISION == "fp16":
        tl.store(weight + at, x)
    if PRECISION == "tf32":
        tl.store(weight + at, nearest_tf32(x))


settle_keys(globals())
