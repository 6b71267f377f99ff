"""The network of the paper written the slow, literal way, over the weights of the real one.

Cells live in dictionaries, pairs and edges in Python lists, and every MLP sees its concatenated input: no splitting
of first layers, no keys, no sorting. Used only to check the real network.
"""

import itertools
import math
from functools import cache

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
    return [network.decode(value + delta) for value, delta in zip(latent, change, strict=True)]


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
    normal = _normals(state.obstacles).get((scene, *cell))
    return torch.zeros_like(x) if normal is None else normal.to(x)


@cache
def _normals(obstacles):
    """By scene and cell."""
    return {
        (key >> 51, *(((key >> shift) & (1 << 17) - 1) - (1 << 16) for shift in (34, 17, 0))): normal
        for key, normal in zip(obstacles.key_K.tolist(), obstacles.normal_K3, strict=True)
    }
