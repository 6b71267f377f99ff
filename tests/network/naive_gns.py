"""GNS written the slow, literal way, over the weights of the real one: every MLP on its concatenated input, every
pair of particles tried. Used only to check the real network.
"""

import torch


def naive_edges(position_N3, scene_N, radius):
    """All (sender, receiver) of one scene with a distance below the radius, each particle with itself too."""
    distance_NN = (position_N3[:, None] - position_N3[None]).square().sum(-1)
    near_NN = (distance_NN < radius * radius) & (scene_N[:, None] == scene_N[None])
    return {(sender, receiver) for sender, receiver in torch.nonzero(near_NN).tolist()}


def naive_gns_acceleration(network, state):
    """The network's raw output, [N, 3]."""
    config, normaliser = network.config, network.normaliser
    positions, latent, scenes = [], [], []
    for i in range(len(state.position_N3)):
        positions.append(state.position_N3[i])
        scenes.append(int(state.scene_N[i]))
        velocity = (state.velocity_NM3[i] - normaliser.velocity_mean) / normaliser.velocity_std
        normal = state.obstacles.normals(positions[-1][None], state.scene_N[i : i + 1])[0] if state.obstacles else None
        latent.append(_encode(network, state, positions[-1], scenes[-1], velocity, int(state.material_N[i]), normal))

    pairs = sorted(naive_edges(torch.stack(positions), torch.tensor(scenes), config.cell_size))
    edges = {}
    for sender, receiver in pairs:
        offset = (positions[sender] - positions[receiver]) / config.cell_size
        distance = offset.square().sum().sqrt().reshape(1)
        edges[sender, receiver] = _mlp(network.encode_edges, torch.cat([offset, distance]))
    for step in network.steps:
        updates = {(s, r): _mlp(step.edge, torch.cat([latent[s], latent[r], value])) for (s, r), value in edges.items()}
        sums = [torch.zeros_like(value) for value in latent]
        for (_, receiver), value in updates.items():
            sums[receiver] = sums[receiver] + value
        latent = [value + _mlp(step.node, torch.cat([value, total])) for value, total in zip(latent, sums, strict=True)]
        edges = {pair: value + updates[pair] for pair, value in edges.items()}
    return torch.stack([_mlp(network.decode, value) for value in latent[: len(state.position_N3)]])


def _encode(network, state, position, scene, velocity, kind, normal):
    config = network.config
    maximum = 8.0 * config.cell_size
    parts = [velocity.flatten()]
    if config.obstacle_features:
        parts.append(torch.zeros_like(position) if normal is None else normal)
    parts.append(torch.cat([position, state.domain_S3[scene] - position]).clamp(-maximum, maximum) / maximum)
    parts.append(network.embedding.weight[kind])
    return _mlp(network.encode, torch.cat(parts))


def _mlp(network, value):
    hidden = torch.relu(network.first.weight @ value + network.first.bias)
    out = network.second.weight @ hidden + network.second.bias
    if network.norm is None:
        return out
    centred = out - out.mean()
    return centred / (centred.square().mean() + network.norm.eps).sqrt() * network.norm.weight + network.norm.bias
