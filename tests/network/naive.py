"""The network of the paper written the slow, literal way, over the weights of the real one.

Cells live in dictionaries, pairs and edges in Python lists, and every MLP sees its concatenated input: no splitting
of first layers, no keys, no sorting. Used only to check the real network.
"""

from __future__ import annotations

import itertools
import math
from functools import partial

import torch

from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork


def naive_normalised_acceleration(
    network: HierarchicalGraphNetwork, state: ParticleState, origin_S3: torch.Tensor
) -> torch.Tensor:
    """The network's raw output, [N, 3], scene by scene."""
    rows = {}
    for scene in range(len(state.domain_S3)):
        members = torch.nonzero(state.scene_N == scene).flatten().tolist()
        for particle, value in zip(members, _one_scene(network, state, members, scene, origin_S3), strict=True):
            rows[particle] = value
    return torch.stack([rows[i] for i in range(len(state.position_N3))])


def _one_scene(network, state, members, scene, origin_S3):
    config, size = network.config, network.config.cell_size
    maximum = 8.0 * size
    latent = []
    for i in members:
        x = state.position_N3[i]
        v = ((state.velocity_NM3[i] - network.normaliser.velocity_mean) / network.normaliser.velocity_std).flatten()
        parts = [v]
        if config.obstacle_features:
            parts.append(_normal(state, x, scene))
        parts.append(torch.cat([x, state.domain_S3[scene] - x]).clamp(-maximum, maximum) / maximum)
        latent.append(parts)

    pairs = []  # (particle row, cell, weight, centre - x in cells)
    for row, i in enumerate(members):
        u = (state.position_N3[i] - origin_S3[scene]) / size - 0.5
        base = [math.floor(value) for value in u.tolist()]
        for corner in itertools.product((0, 1), repeat=3):
            weight = torch.ones((), dtype=u.dtype)
            for axis in range(3):
                fraction = u[axis] - base[axis]
                weight = weight * (fraction if corner[axis] else 1 - fraction)
            if float(weight) != 0:
                cell = tuple(b + c for b, c in zip(base, corner, strict=True))
                pairs.append((row, cell, weight, torch.tensor(cell).to(u) - u))

    if config.relative:
        columns = [_relative(network, state, i, scene, row, members, pairs) for row, i in enumerate(members)]
        felt = _gated(config, columns, pairs)
        latent = [[torch.tensor(line, dtype=state.position_N3.dtype)] for line in columns]
    embedding = network.embedding.weight
    latent = [
        network.encode(torch.cat([*parts, embedding[state.material_N[i]]]))
        for i, parts in zip(members, latent, strict=True)
    ]

    values = {}
    for row, cell, weight, offset in pairs:
        message = network.particle_to_cell(latent[row], offset)
        values[cell] = values.get(cell, 0) + weight * message

    down = []
    for level in range(config.levels):
        values = _messages(network.passing_down[level], values)
        down.append(values)
        if level < config.levels - 1:
            coarse = {}
            for cell, value in values.items():
                parent = tuple(k // 2 for k in cell)
                offset = torch.tensor([2 * p + 1 - (k + 0.5) for p, k in zip(parent, cell, strict=True)]).to(value)
                coarse[parent] = coarse.get(parent, 0) + network.fine_to_coarse[level](value, offset)
            values = coarse
    for level in reversed(range(config.levels - 1)):
        fine = {}
        for cell, value in down[level].items():
            parent = tuple(k // 2 for k in cell)
            offset = torch.tensor([k + 0.5 - (2 * p + 1) for p, k in zip(parent, cell, strict=True)]).to(value)
            fine[cell] = value + network.coarse_to_fine[level](values[parent], value, offset)
        values = _messages(network.passing_up[level], fine)

    change = [torch.zeros_like(value) for value in latent]
    for row, cell, weight, offset in pairs:
        change[row] = change[row] + weight * network.cell_to_particle(values[cell], latent[row], -offset)
    output = [network.decode(value + delta) for value, delta in zip(latent, change, strict=True)]
    if not config.relative:
        return output
    output = _balanced(config, *felt, pairs, output)
    scale = network.normaliser.acceleration_std[0]
    for level in range(2 * network.step.rests):
        moving = [value + state.velocity_NM3[i, 0] / scale for i, value in zip(members, output, strict=True)]
        slow = []
        large = [config.materials[int(state.material_N[i])] != "water" or not level for i in members]
        for rate in _deforming(config, felt[0], pairs, moving, level, large):
            ratio = rate.norm() * scale / (network.step.rest_threshold * state.gravity_S3[scene].norm() + 1e-300)
            slow.append((2 - ratio**2).clamp(0, 1) * rate)
        stopped = _deforming(config, felt[0], pairs, slow, level, large)
        output = [value - part for value, part in zip(output, stopped, strict=True)]
    return output


def _relative(network, state, i, scene, row, members, pairs):
    """The columns of relative inputs, one number after the other, with no gate yet."""
    config, scale = network.config, float(network.normaliser.acceleration_std[0])
    x, gravity = state.position_N3[i].tolist(), state.gravity_S3[scene].tolist()
    v = state.velocity_NM3[i].tolist()

    def f(value):
        return math.asinh(value / scale)

    history = [f(v[k][a] - v[k + 1][a] - gravity[a]) for k in range(len(v) - 1) for a in range(3)]
    surroundings = []
    for level in range(config.levels):
        mass, momentum = {}, {}
        for other, cell, weight, _ in pairs:
            at = tuple(k >> level for k in cell)
            mass[at] = mass.get(at, 0.0) + float(weight)
            moving = state.velocity_NM3[members[other], 0].tolist()
            momentum[at] = [p + float(weight) * u for p, u in zip(momentum.get(at, [0.0] * 3), moving, strict=True)]
        mean = [0.0] * 3
        for other, cell, weight, _ in pairs:
            at = tuple(k >> level for k in cell)
            if other == row:
                mean = [m + float(weight) * p / mass[at] for m, p in zip(mean, momentum[at], strict=True)]
        surroundings += [f(v[0][a] - mean[a]) for a in range(3)]
    reach, walls = 3.0 * config.cell_size, []
    for side in (0, 1):
        for a in range(3):
            distance = x[a] if side == 0 else float(state.domain_S3[scene, a]) - x[a]
            away = v[0][a] if side == 0 else -v[0][a]
            walls.append(min(max(1 - (distance + min(0.0, away)) / reach, 0.0), 2.0))
    normals = []
    if config.obstacle_features:
        place = state.position_N3[i]
        ahead = [_normal(state, place + state.velocity_NM3[i, 0] * (k / 4), scene) for k in (1, 2, 3, 4)]
        seen = [normal for normal in ahead if normal.any()]
        normals = [*_normal(state, place, scene).tolist(), *(seen[0].tolist() if seen else [0.0] * 3)]
    return [*history, *surroundings, *(f(v[0][a]) for a in range(3)), *walls, *normals]


def _gated(config, columns, pairs):
    """Gates the columns of contact, and says how touched and how disturbed a coarsest cell is: functions of it."""
    motion = 3 * (config.velocity_history - 1 + config.levels)
    top = [(row, tuple(k >> config.levels - 1 for k in cell), weight) for row, cell, weight, _ in pairs]
    touch = [1.0 if any(x[motion + 9 :]) else min(1.0, 2 * max(x[motion + 3 : motion + 9])) for x in columns]
    touched, disturbed = {}, {}
    for row, cell, _ in top:
        moved = sum((value / 0.01) ** 2 for value in columns[row][:motion])
        touched[cell] = max(touched.get(cell, 0.0), touch[row])
        disturbed[cell] = max(disturbed.get(cell, 0.0), min(1.0, touch[row] + moved))

    def around(values, cell):
        sides = [tuple(k + sign * (a == b) for b, k in enumerate(cell)) for a in range(3) for sign in (1, -1)]
        return max([values[cell], *(values[side] for side in sides if side in values)])

    for i, line in enumerate(columns):
        gate = sum(float(weight) * around(touched, cell) for row, cell, weight in top if row == i)
        line[motion : motion + 3] = [gate * value for value in line[motion : motion + 3]]

    def slip(cell):
        """What surfaces leave free of a mean force."""
        matrix = torch.zeros(3, 3, dtype=torch.float64)
        for row, at, weight in top:
            surfaces = torch.tensor(columns[row][motion + 3 :], dtype=torch.float64)
            near_6 = (2 * surfaces[:6]).clamp(max=1)
            normals = [*surfaces[6:].view(-1, 3), torch.zeros(3, dtype=torch.float64)]
            first_3 = next((n for n in normals if n.any()), normals[-1])
            if at == cell:
                matrix += float(weight) * (torch.diag(near_6[:3] + near_6[3:]) + torch.outer(first_3, first_3))
        return torch.linalg.inv(torch.eye(3).double() + matrix / (0.1 + 1e-3 * matrix.trace()))

    return partial(around, touched), partial(around, disturbed), slip


def _free(top, place):
    """What takes mean and rotation out of a field of pairs of particles and cells, which lie there, in cells."""

    def free(field, cells):
        """How well a rotation is known, and accelerations of these cells' pairs without what turns them all."""
        mine = [i for i, (_, cell, _) in enumerate(top) if cell in cells]
        total = sum(top[i][2] for i in mine)
        centre = sum(top[i][2] * place[i] for i in mine) / total
        mean = sum(top[i][2] * field[i] for i in mine) / total
        turn, inertia = torch.zeros(3, dtype=mean.dtype), torch.zeros(3, 3, dtype=mean.dtype)
        for i in mine:
            y, share = place[i] - centre, top[i][2] / total
            turn += share * torch.linalg.cross(y, field[i] - mean)
            inertia += share * (y @ y * torch.eye(3, dtype=y.dtype) - torch.outer(y, y))
        product, moments = torch.linalg.det(inertia), torch.trace(inertia) / 3
        known = product / (product + (0.2 * (moments + 1e-3)) ** 3)
        rate = torch.linalg.lstsq(inertia, turn, rcond=1e-10, driver="gelsd").solution
        still = [field[i] - mean - torch.linalg.cross(rate, place[i] - centre) for i in mine]
        return known, {i: known * value for i, value in zip(mine, still, strict=True)}

    return free


def _deforming(config, touched, pairs, values, level, resting):
    """The part of values that deforms what touches and is `resting`, between cells 4^level times the coarsest
    (rest.Deformation)."""
    span, hats = 2 ** (config.levels - 1), []
    for row in range(len(values)):
        mine = [(cell, weight, offset) for i, cell, weight, offset in pairs if i == row]
        gate = resting[row] * sum(
            weight * touched(tuple(k >> config.levels - 1 for k in cell)) for cell, weight, _ in mine
        )
        place = ((torch.tensor(mine[0][0]) + 0.5 - mine[0][2]) / span - 0.5) / 4**level
        for corner in itertools.product((0, 1), repeat=3):
            middle = torch.floor(place) + torch.tensor(corner)
            hats.append((row, tuple(middle.tolist()), gate * (1 - (place - middle).abs()).prod(), place))
    top = [hat[:3] for hat in hats if float(hat[2]) > 0]
    free = _free(top, [hat[3] for hat in hats if float(hat[2]) > 0])
    result = [torch.zeros(3, dtype=value.dtype) for value in values]
    for middle in {middle for _, middle, _ in top}:
        known, parts = free({i: values[row] for i, (row, at, _) in enumerate(top) if at == middle}, {middle})
        for i, part in parts.items():
            row, _, weight = top[i]
            result[row] = result[row] + weight * part / max(known, 0.5)
    return result


def _balanced(config, touched, disturbed, slip, pairs, output):
    """Of accelerations and stresses what keeps momenta (relative.balanced): a coarsest cell's rotation is taken out,
    and that of two: fields over their particles, as they are."""
    top = [(row, tuple(k >> config.levels - 1 for k in cell), weight) for row, cell, weight, _ in pairs]
    free = _free(top, [(torch.tensor(k) + 0.5 - offset) / 2 ** (config.levels - 1) for _, k, _, offset in pairs])
    mass, mean = {}, {}
    for row, cell, weight in top:
        mass[cell] = mass.get(cell, 0.0) + weight
        mean[cell] = mean.get(cell, 0.0) + weight * output[row]
    result = [torch.zeros(3, dtype=value.dtype) for value in output]

    fields, pushes = [None] * len(top), []
    for cell in mass:
        own = {i: output[row][:3] for i, (row, at, _) in enumerate(top) if at == cell}
        for i, value in free(own, {cell})[1].items():
            kept = own[i] - slip(cell) @ mean[cell][:3] / mass[cell]
            fields[i] = disturbed(cell) * (touched(cell) * kept + (1 - touched(cell)) * value)
        for axis in range(3):
            other = tuple(k + (a == axis) for a, k in enumerate(cell))
            if other in mass:
                stress = (mean[cell] / mass[cell] + mean[other] / mass[other]) / 2
                force = stress[list({0: (3, 8, 7), 1: (8, 4, 6), 2: (7, 6, 5)}[axis])]
                pair = {
                    i: force / mass[cell] if at == cell else -force / mass[other] for i, (_, at, _) in enumerate(top)
                }
                factor = disturbed(cell) * disturbed(other) * mass[cell] * mass[other] / (mass[cell] + mass[other])
                pushes.append((factor, free(pair, {cell, other})[1]))
    for factor, values in pushes:
        for i, value in values.items():
            fields[i] = fields[i] + factor * value
    for i, (row, _, weight) in enumerate(top):
        result[row] = result[row] + weight * fields[i]
    return result


def _messages(passing, values):
    edges = {}
    for cell in values:
        for axis, sign in itertools.product(range(3), (1, -1)):
            sender = tuple(k + sign * (a == axis) for a, k in enumerate(cell))
            if sender in values:
                offset = [float(a - b) for a, b in zip(cell, sender, strict=True)]
                edges[sender, cell] = torch.tensor(offset).to(values[cell])
    for step, (edge, node) in enumerate(zip(passing.edge, passing.cell, strict=True)):
        messages = {pair: edge(values[pair[0]], values[pair[1]], f) for pair, f in edges.items()}
        edges = messages if step == 0 else {pair: edges[pair] + messages[pair] for pair in edges}
        sums = {cell: torch.zeros_like(value) for cell, value in values.items()}
        for (_, receiver), value in edges.items():
            sums[receiver] = sums[receiver] + value
        values = {cell: value + node(value, sums[cell]) for cell, value in values.items()}
    return values


def _normal(state, x, scene):
    if state.obstacles is None:
        return torch.zeros_like(x)
    cell = tuple(math.floor(value / state.obstacles.cell_size) for value in x.tolist())
    for key, normal in zip(state.obstacles.key_K.tolist(), state.obstacles.normal_K3, strict=True):
        coordinates = tuple(((key >> shift) & (1 << 17) - 1) - (1 << 16) for shift in (34, 17, 0))
        if key >> 51 == scene and coordinates == cell:
            return normal.to(x)
    return torch.zeros_like(x)
