"""Computes the parts of a training step around the network on the device: batch, loss, Adam and counters.

The sample table has a row of int64 numbers for each scene of each update. A row holds: the address of the window's
first frame of positions, number of particles, first row in the batch, seed, address of the materials (int32), weight of
the loss (as the bits of a float64), address of the columns of parameters (float32; 0: all are 0), address of
RestShape.packed (0: no elastic bodies), and the scene's row of the obstacle table. The last column of that row is the
symmetry of the sample.
Shape legend: N particles of all scenes, S scenes, H velocity history.
"""

import triton
import triton.language as tl

from hgn.kernels.blocks import nearest_tf32
from hgn.kernels.geometry import GEOMETRY_COLUMNS, add_above
from hgn.kernels.obstacles import CODE_BITS, CODE_MASK, OBSTACLE_COLUMNS
from hgn.kernels.triton_compat import settle_keys
from hgn.network import elastic
from hgn.scene import rest_shape

SAMPLE_COLUMNS = tl.constexpr(13)
PACKED, NEIGHBOURS = tl.constexpr(elastic.PACKED), tl.constexpr(rest_shape.NEIGHBOURS)
JITTER_OFFSET = tl.constexpr(0x7FFFFFF0)  # offset of the jitter in the seed's stream, far from the noise
WAVES_OFFSET = tl.constexpr(0x7FFFF000)  # offset of the smooth noise in the seed's stream
REPEAT = tl.constexpr(8)  # status bit: another rank must repeat the update
AGAIN = tl.constexpr(11)  # overflow, out of the cell box, or REPEAT: the same update runs again with larger buffers
BETA_1 = tl.constexpr(0.9)  # torch.optim.Adam's defaults
BETA_2 = tl.constexpr(0.999)
EPSILON = tl.constexpr(1e-8)


@triton.jit
def draw_waves(
    samples, update, waves, amplitude_step, largest_number, log_range, scenes,
    HISTORY: tl.constexpr, WAVES: tl.constexpr,
):  # fmt: skip
    """Draws the plane waves of a scene's smooth velocity noise from the seed of its sample. Each scene has a program.

    waves [S, WAVES, 4 + 3 HISTORY] hold the wave vector (uniform direction, log-uniform length), the phase, and the
    change of the amplitude at each velocity, oldest first.

    Rule: hgn.training.noise; test: tests/kernels/test_update.py.
    """
    scene = tl.program_id(0)
    sample = samples + (tl.load(update).to(tl.int64) * scenes + scene) * SAMPLE_COLUMNS
    seed = tl.load(sample + 3)
    index = tl.arange(0, WAVES)
    columns: tl.constexpr = 4 + 3 * HISTORY
    line = waves + (scene * WAVES + index) * columns
    draw = index + WAVES_OFFSET
    x, y, z = tl.randn(seed, draw), tl.randn(seed, draw + WAVES), tl.randn(seed, draw + 2 * WAVES)
    number = largest_number * tl.exp(-log_range * tl.rand(seed, draw + 3 * WAVES))
    number /= tl.sqrt(x * x + y * y + z * z)
    tl.store(line, number * x)
    tl.store(line + 1, number * y)
    tl.store(line + 2, number * z)
    tl.store(line + 3, 6.283185307179586 * tl.rand(seed, draw + 4 * WAVES))
    for k in tl.static_range(3 * HISTORY):
        tl.store(line + 4 + k, amplitude_step * tl.randn(seed, draw + (5 + k) * WAVES))


@triton.jit
def assemble_batch(
    samples, sample_vectors, update, position, velocity, scene_of, material_of, target, loss_weight_of, origin,
    domain, gravity, obstacle_table, particle_count, mean, std, noise_step, waves, jitter, scenes,
    wall_friction, parameter_of, rest_of, obstacle_cell_size,
    HISTORY: tl.constexpr, SYMMETRY: tl.constexpr, NOISE: tl.constexpr, WAVES: tl.constexpr,
    FRICTION: tl.constexpr, PARAMETERS: tl.constexpr, WIDTH: tl.constexpr, REST: tl.constexpr,
    DIMENSIONS: tl.constexpr, SCENES: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Writes windows with noise in the inputs (paper sec. 3.3): a random walk of velocity noise that positions follow.

    With NOISE each particle has its own noise. With WAVES a part of it comes from its scene's waves, see draw_waves.
    The target is v_true^{n+1} - v_noisy^n minus gravity, normalised. sample_vectors [updates, S, 3, 3] are the domain's
    size, and gravity and the walls' friction under the sample's symmetry; gravity is zero with absolute inputs. The
    kernel copies with FRICTION the walls' friction, the first PARAMETERS of WIDTH columns of parameter_of, and with
    REST the rest shapes. Grid origins are uniform in [-jitter, 0]. Noise and jitter are Philox numbers that depend only
    on the sample's seed. With SYMMETRY the window is the image of the stored one. Velocities come from stored
    positions, because mirrored positions are rounded.
    SCENES is a power of two, at least `scenes`. Axes from DIMENSIONS on have neither noise nor jitter.

    Rule: hgn.training.noise; test: tests/kernels/test_update.py.
    """
    table = samples + tl.load(update).to(tl.int64) * scenes * SAMPLE_COLUMNS
    vectors = sample_vectors + tl.load(update) * scenes * 9
    last = table + (scenes - 1) * SAMPLE_COLUMNS
    count = (tl.load(last + 1) + tl.load(last + 2)).to(tl.int32)
    scene = tl.arange(0, SCENES)
    there = scene < scenes
    if tl.program_id(0) == 0:
        # One vector holds all scenes. A loop over scenes would wait for the reads of each.
        tl.store(particle_count, count)
        seed = tl.load(table + scene * SAMPLE_COLUMNS + 3, mask=there, other=0)
        for axis in tl.static_range(3):
            draw = tl.rand(seed, scene * 0 + JITTER_OFFSET + axis)
            tl.store(origin + scene * 3 + axis, -jitter * draw if axis < DIMENSIONS else 0.0 * draw, mask=there)
            size = tl.load(vectors + scene * 9 + axis, mask=there, other=0.0)
            tl.store(domain + scene * 3 + axis, size, mask=there)
            own_gravity = tl.load(vectors + scene * 9 + 3 + axis, mask=there, other=0.0)
            tl.store(gravity + scene * 3 + axis, own_gravity, mask=there)
            if FRICTION:
                rough = tl.load(vectors + scene * 9 + 6 + axis, mask=there, other=0.0)
                tl.store(wall_friction + scene * 3 + axis, rough, mask=there)
        for i in tl.static_range(OBSTACLE_COLUMNS):
            at = table + scene * SAMPLE_COLUMNS + SAMPLE_COLUMNS - OBSTACLE_COLUMNS + i
            value = tl.load(at, mask=there, other=0)
            tl.store(obstacle_table + scene * OBSTACLE_COLUMNS + i, value, mask=there)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = row < count
    # The scene of a row is the number of scenes, without the first one, that begin at or before the row.
    begins = tl.load(table + scene * SAMPLE_COLUMNS + 2, mask=there & (scene > 0), other=1 << 40)
    scene_row = tl.sum((row[:, None] >= begins[None, :]).to(tl.int32), 1)
    line = table + scene_row * SAMPLE_COLUMNS
    address = tl.load(line, mask=live, other=0)
    particles = tl.load(line + 1, mask=live, other=1)
    own = row - tl.load(line + 2, mask=live, other=0)
    seed_row = tl.load(line + 3, mask=live, other=0)
    tl.store(scene_of + row, scene_row, mask=live)
    materials = tl.load(line + 4, mask=live, other=0).to(tl.pointer_type(tl.int32))
    tl.store(material_of + row, tl.load(materials + own, mask=live, other=0), mask=live)
    if PARAMETERS > 0:
        number = tl.arange(0, 8)[None, :]
        values = tl.load(line + 6, mask=live, other=0)[:, None]
        at = values.to(tl.pointer_type(tl.float32)) + own[:, None] * PARAMETERS + number
        written = live[:, None] & (number < PARAMETERS)
        value = tl.load(at, mask=written & (values != 0), other=0.0)
        tl.store(parameter_of + row[:, None] * WIDTH + number, value, mask=written)
    if REST:
        number = tl.arange(0, 64)[None, :]
        shape = tl.load(line + 7, mask=live, other=0)[:, None]
        written = live[:, None] & (number < PACKED)
        at = shape.to(tl.pointer_type(tl.int32)) + own[:, None] * PACKED + number
        value = tl.load(at, mask=written & (shape != 0), other=0)
        value = tl.where((number < NEIGHBOURS) & (shape == 0), -1, value)
        value = tl.where((number < NEIGHBOURS) & (value >= 0), value + (row - own)[:, None].to(tl.int32), value)
        tl.store(rest_of + row[:, None] * PACKED + number, value, mask=written)
    weight = tl.load(line + 5, mask=live, other=0).to(tl.float64, bitcast=True).to(tl.float32)
    tl.store(loss_weight_of + row, weight / (scenes * particles.to(tl.float32)), mask=live)
    first = address.to(tl.pointer_type(tl.float32)) + own * 3
    frame = particles * 3
    if SYMMETRY:
        symmetry = tl.load(line + SAMPLE_COLUMNS - 1, mask=live, other=0)
    if WAVES > 0:
        columns: tl.constexpr = 4 + 3 * HISTORY
        wave = waves + (scene_row[:, None] * WAVES + tl.arange(0, WAVES)[None, :]) * columns
        height = tl.load(wave + 3)
        for axis in tl.static_range(3):
            place = tl.load(first + HISTORY * frame + axis, mask=live, other=0.0)
            height += tl.load(wave + axis) * place[:, None]
        height = tl.cos(height)
    for axis in tl.static_range(3):
        column = first + axis
        if SYMMETRY:
            part = symmetry >> CODE_BITS * axis
            column = first + (part & 3)
            mirrored = (part >> 2 & 1) == 1
        walk = tl.zeros((BLOCK,), tl.float32)
        moved = tl.zeros((BLOCK,), tl.float32)
        before = tl.load(column, mask=live, other=0.0)
        v = walk
        for k in tl.static_range(HISTORY):
            if NOISE and axis < DIMENSIONS:
                walk += noise_step * tl.randn(seed_row, ((own * HISTORY + k) * 3 + axis).to(tl.int32))
            if WAVES > 0 and axis < DIMENSIONS:
                walk += tl.sum(height * tl.load(wave + 4 + k * 3 + axis), 1)
            moved += walk
            now = tl.load(column + (k + 1) * frame, mask=live, other=0.0)
            step = now - before
            if SYMMETRY:
                step = tl.where(mirrored, -step, step)
            v = step + walk
            before = now
            # Column 0 is the newest velocity.
            tl.store(velocity + row * (3 * HISTORY) + 3 * (HISTORY - 1 - k) + axis, v, mask=live)
        step = tl.load(column + (HISTORY + 1) * frame, mask=live, other=0.0) - before
        if SYMMETRY:
            step = tl.where(mirrored, -step, step)
            mirror_sum = (part >> 3 & CODE_MASK).to(tl.float32) * obstacle_cell_size
            before = tl.where(mirrored, mirror_sum - before, before)
        tl.store(position + row * 3 + axis, before + moved, mask=live)
        acceleration = step - v - tl.load(vectors + scene_row * 9 + 3 + axis, mask=live, other=0.0)
        scaled = (acceleration - tl.load(mean + axis)) / tl.load(std + axis)
        tl.store(target + row * 3 + axis, scaled, mask=live)


@triton.jit
def sum_errors(
    output, target, cell_of, weight_of, particle_count, sums, OUT: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    """Adds the particles' errors, and 1 in column 3, with the weights of their finest cells, to `sums` [C, 4].

    Rule: hgn.training.cell_means; test: tests/kernels/test_cell_means.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live, part, corner = row < count, tl.arange(0, 4)[None, :], tl.arange(0, 8)[None, :]
    here = live[:, None] & (part < 3)
    error = tl.load(output + row[:, None] * OUT + part, mask=here, other=1.0)
    error -= tl.load(target + row[:, None] * 3 + part, mask=here, other=0.0)
    cell = tl.load(cell_of + row[:, None] * 8 + corner, mask=live[:, None], other=0)
    weight = tl.load(weight_of + row[:, None] * 8 + corner, mask=live[:, None], other=0.0)
    at = sums + cell[:, :, None] * 4 + part[:, None, :]
    tl.atomic_add(at, weight[:, :, None] * error[:, None, :], mask=(weight > 0)[:, :, None], sem="relaxed")


@triton.jit
def sum_errors_above(sums, parent, geometry, counts, LEVELS: tl.constexpr, BLOCK: tl.constexpr):
    """Adds the sums of the finest cells to all cells above them, in `sums` [.., 4] of all levels.

    Rule: hgn.training.cell_means; test: tests/kernels/test_cell_means.py.
    """
    cell = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    add_above(sums, parent, geometry, cell, cell < tl.load(counts), LEVELS)


@triton.jit
def loss_gradient(
    output, target, loss_weight_of, particle_count, gradient, loss, scale, cell_of, weight_of, sums, parent, geometry,
    cell_mean_weight, OUT: tl.constexpr, LEVELS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Computes the mean squared error of normalised accelerations over axes, particles and scenes, and its gradient.

    The gradient is multiplied by `scale`. With LEVELS the errors of the cells' means in `sums` are added, with
    `cell_mean_weight` (hgn.training.cell_means).

    Rule: torch's autograd; test: tests/kernels/test_update.py, tests/kernels/test_cell_means.py.
    """
    count = tl.load(particle_count)
    if tl.program_id(0) * BLOCK >= count:
        return
    row = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    column = tl.arange(0, OUT)
    live = (row < count)[:, None] & (column < 3)[None, :]
    at = row[:, None] * OUT + column[None, :]
    error = tl.load(output + at, mask=live, other=0.0)
    error -= tl.load(target + row[:, None] * 3 + column[None, :], mask=live, other=0.0)
    loss_weight = tl.load(loss_weight_of + row, mask=row < count, other=0.0)[:, None] / 3
    weighted = error
    for i in tl.static_range(8 if LEVELS > 0 else 0):
        cell = tl.load(cell_of + row * 8 + i, mask=row < count, other=0)
        weight = cell_mean_weight * tl.load(weight_of + row * 8 + i, mask=row < count, other=0.0)
        there = (row < count) & (weight > 0)
        for level in tl.static_range(LEVELS):
            line = geometry + level * GEOMETRY_COLUMNS
            first = tl.load(line + 6)
            mean = sums + (first + cell) * 4
            factor = weight / tl.load(mean + 3, mask=there, other=1.0)
            weighted += factor[:, None] * tl.load(
                mean[:, None] + column[None, :], mask=live & there[:, None], other=0.0
            )
            cell = tl.load(parent + first + cell, mask=there & (level < LEVELS - 1), other=-1)
            there = there & (cell >= 0)
    tl.store(gradient + at, 2 * scale * loss_weight * weighted, mask=(row < count)[:, None])
    tl.atomic_add(loss, tl.sum(tl.sum(loss_weight * error * weighted, 1), 0))


@triton.jit
def flag_overflow(status, flag):
    """Writes after the gradient whether this rank must repeat the update. The ranks sum this flag with the gradient.

    Test: tests/kernels/test_ranks.py.
    """
    tl.store(flag, (tl.load(status) & AGAIN).to(tl.float32))


@triton.jit
def square_norm(gradient, size, rank_weight, flag, status, norm, BLOCK: tl.constexpr):
    """Adds the squares of `gradient` times `rank_weight` to norm[0], which is not finite if one of them is not.

    `gradient` is the sum over the ranks, and `rank_weight` is 1 / (number of ranks).

    Test: tests/kernels/test_ranks.py.
    """
    if tl.program_id(0) == 0 and tl.load(flag) > 0:
        tl.atomic_or(status, REPEAT)
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    value = tl.load(gradient + at, mask=at < size, other=0.0) * rank_weight
    tl.atomic_add(norm, tl.sum(value * value, 0))


@triton.jit
def adam(
    value, weight, gradient, rank_weight, first_moment, second_moment, rates, update, step, status, norm, size,
    others,
    PRECISION: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Makes a step of Adam (Kingma & Ba 2015) on flat buffers, if the status is zero and the gradient finite.

    rates [updates] are the learning rates. step, float64 [1], counts the steps. `weight` is the copy for products at
    this precision. `others`, int8 [size] or None, marks the elements that another optimiser updates.

    Rule: torch.optim.Adam; test: tests/kernels/test_update.py.
    """
    if tl.load(status) != 0:
        return
    if (tl.load(norm) < float("inf")) == 0:
        return
    time = tl.load(step) + 1
    first_bias = (1 - tl.exp(time * -0.10536051565782628)).to(tl.float32)  # 1 - BETA_1^time
    second_bias = (1 - tl.exp(time * -0.0010005003335835335)).to(tl.float32)  # 1 - BETA_2^time
    rate = tl.load(rates + tl.load(update))
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < size
    if others is not None:
        mask &= tl.load(others + at, mask=mask, other=1) == 0
    g = tl.load(gradient + at, mask=mask, other=0.0) * rank_weight
    m = tl.load(first_moment + at, mask=mask, other=0.0)
    v = tl.load(second_moment + at, mask=mask, other=0.0)
    m += (g - m) * (1 - BETA_1)
    v += (g * g - v) * (1 - BETA_2)
    tl.store(first_moment + at, m, mask=mask)
    tl.store(second_moment + at, v, mask=mask)
    x = tl.load(value + at, mask=mask, other=0.0)
    x -= rate / first_bias * m / (tl.sqrt(v / second_bias) + EPSILON)
    tl.store(value + at, x, mask=mask)
    if PRECISION == "fp16":
        tl.store(weight + at, x, mask=mask)
    if PRECISION == "tf32":
        tl.store(weight + at, nearest_tf32(x), mask=mask)


@triton.jit
def average_values(value, average, ema_weights, update, status, size, BLOCK: tl.constexpr):
    """Updates the moving average of the values. ema_weights [updates] are those of the new values.

    An update that is repeated does nothing here. After a skipped update the new values equal the old ones.

    Rule: hgn.training.torch_updates.TorchUpdates; test: tests/kernels/test_training.py.
    """
    if (tl.load(status) & AGAIN) != 0:
        return
    at = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = at < size
    mean = tl.load(average + at, mask=mask, other=0.0)
    mean += (tl.load(value + at, mask=mask, other=0.0) - mean) * tl.load(ema_weights + tl.load(update))
    tl.store(average + at, mean, mask=mask)


@triton.jit
def finish_update(status, update, step, loss, norm, loss_sum, counters):
    """Counts the update, unless it is repeated with larger buffers.

    loss_sum is the sum and the number of finite losses. counters are the sum and the number of finite norms, the
    number of skipped updates, the number skipped in a row up to now, and the largest such number.

    Test: tests/kernels/test_update.py.
    """
    if (tl.load(status) & AGAIN) == 0:
        tl.store(update, tl.load(update) + 1)
        value = tl.load(loss)
        if tl.abs(value) < float("inf"):
            tl.store(loss_sum, tl.load(loss_sum) + value)
            tl.store(loss_sum + 1, tl.load(loss_sum + 1) + 1.0)
        square = tl.load(norm)
        if square < float("inf"):
            tl.store(step, tl.load(step) + 1)
            tl.store(counters, tl.load(counters) + tl.sqrt(square))
            tl.store(counters + 1, tl.load(counters + 1) + 1.0)
            tl.store(counters + 3, 0.0)
        else:
            tl.store(counters + 2, tl.load(counters + 2) + 1.0)
            row = tl.load(counters + 3) + 1.0
            tl.store(counters + 3, row)
            tl.store(counters + 4, tl.maximum(tl.load(counters + 4), row))
    tl.store(loss, 0.0)
    tl.store(norm, 0.0)


settle_keys(globals())
