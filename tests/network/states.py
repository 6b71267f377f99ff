"""Random network inputs for the tests."""

from dataclasses import replace

import numpy as np
import torch

from hgn.config import NetworkConfig
from hgn.network.build import build_network
from hgn.network.features import ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.scene.surface_field import REACH_CELLS
from hgn.step_config import StepConfig

GRAVITY = (0.0, -9.8 / 3600, 0.0)  # domain units per frame squared


def random_grid(seed, cells, cell_size=1 / 64, extent=24):
    """Random obstacle cells with random unit normals."""
    rng = np.random.default_rng(seed)
    cell_K3 = np.unique(rng.integers(0, extent, (cells, 3)), axis=0).astype(np.int32)
    normal_K3 = rng.normal(size=cell_K3.shape)
    normal_K3 /= np.linalg.norm(normal_K3, axis=1, keepdims=True)
    return ObstacleGrid(cell_size, cell_K3, normal_K3.astype(np.float32))


def random_state(counts, seed=0, dtype=torch.float64, obstacles=True, spread=0.3):
    """Particles of several scenes in a box of side `spread`."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(counts)
    grids = [random_grid(seed + i, 4_000) for i in range(len(counts))]
    return ParticleState(
        position_N3=(torch.rand(total, 3, generator=generator, dtype=torch.float64) * spread + 0.02).to(dtype),
        velocity_NM3=(torch.randn(total, 5, 3, generator=generator, dtype=torch.float64) * 1e-3).to(dtype),
        material_N=torch.randint(0, 3, (total,), generator=generator),
        scene_N=torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts)),
        domain_S3=torch.ones(len(counts), 3, dtype=dtype),
        gravity_S3=torch.tensor([GRAVITY]).repeat(len(counts), 1).to(dtype),
        obstacles=ObstacleCells.of(grids) if obstacles else None,
    )


def chosen(state, rows):
    """These particles of a state, in its scenes."""
    names = ("position_N3", "velocity_NM3", "material_N", "scene_N")
    return replace(state, **{name: getattr(state, name)[rows] for name in names})


def scene_of(state, scene, obstacles=None):
    """One scene taken out of a batch."""
    alone, here = chosen(state, state.scene_N == scene), slice(scene, scene + 1)
    scenes = {"scene_N": 0 * alone.scene_N, "domain_S3": state.domain_S3[here], "gravity_S3": state.gravity_S3[here]}
    scenes["frame_S"] = state.frame_S[here]
    return replace(alone, **scenes, obstacles=obstacles)


def airborne(counts=(40, 17, 1)):
    """Scenes far from walls and without obstacles, each with a gravity of its own; particles move as they please."""
    state = random_state(counts, obstacles=False, spread=0.2)
    gravity_S3 = 3e-3 * torch.randn(len(counts), 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return replace(state, position_N3=state.position_N3 + 0.38, gravity_S3=gravity_S3)


def in_flight(state, velocity, gravity_3):
    """All particles with one velocity, and the free fall that leads there behind them."""
    age_H1 = torch.arange(5, dtype=torch.float64)[:, None]
    velocity_H3 = torch.tensor(velocity, dtype=torch.float64) - age_H1 * gravity_3
    return replace(
        state,
        velocity_NM3=velocity_H3.expand(len(state.position_N3), 5, 3),
        gravity_S3=gravity_3.expand(state.scene_count, 3),
    )


def few(place_N3):
    """Places of a few particles about the middle of a domain, in finest cells, float64."""
    return 0.45 + 0.035 * torch.tensor(place_N3, dtype=torch.float64)


# on a line, in one place, on a line but for a hair, in one place but for one, two apart, on a plane
ODD_BODIES = [
    few([[0.3, 0.7, -0.2], [0.8, 1.7, -0.1], [-0.2, -0.3, -0.3], [1.8, 3.7, 0.1]]),
    few([[0.4, 0.2, 0.1]] * 3),
    few([[0.3, 0.7, -0.2], [0.8, 1.7, -0.1], [-0.2, -0.3, -0.3 + 1e-7]]),
    few([[0.4, 0.2, 0.1], [0.4, 0.2, 0.1], [-3.4, 0.3, 0.2]]),
    few([[0.0, 0.0, 0.0], [2.4, 3.1, 0.7]]),
    few([[0.3, 0.2, 0.0], [4.1, -2.2, 0.0], [-1.7, 0.4, 0.0], [2.2, 2.1, 0.0]]),
]


def drawn_outputs(count):
    """Accelerations and stresses [N, 9]."""
    return torch.randn(count, 9, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def on_device(state, device):
    return replace(state, **{name: value.to(device) for name, value in vars(state).items() if value is not None})


def network_of(dtype=torch.float64, **changes):
    """A small network with random weights, norms included, and a normaliser that is not the identity."""
    values = {"width": 16, "levels": 3, "message_passing_steps": 2} | changes
    network = _with_random_weights(values, dtype)
    assert isinstance(network, HierarchicalGraphNetwork)
    return network


def silent(network):
    """The network with an output of zero: with relative inputs, free flight."""
    with torch.no_grad():
        for parameter in network.decode.parameters():
            parameter.zero_()
    return network


def gns_of(dtype=torch.float64, **changes):
    """The same of GNS."""
    values = {"kind": "gns", "width": 16, "levels": 1, "message_passing_steps": 3} | changes
    network = _with_random_weights(values, dtype)
    assert isinstance(network, GraphNetworkSimulator)
    return network


def structure(values):
    """The network and the constraints of its frames that settings of both describe."""
    step = {name: values[name] for name in vars(StepConfig()) if name in values}
    return NetworkConfig(**{name: value for name, value in values.items() if name not in step}), StepConfig(**step)


def _with_random_weights(values, dtype):
    torch.manual_seed(5)
    config, step = structure(values)
    network = build_network(config, step)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    if config.relative:
        network.normaliser.set_isotropic(torch.tensor([1e-3, 2e-3, 1e-3]), 1e-3)
        return network.to(dtype)
    network.normaliser.set("velocity", torch.tensor([1e-4, -2e-3, 0.0]), torch.tensor([1e-3, 2e-3, 3e-3]), 1e-3)
    network.normaliser.set("acceleration", torch.tensor([0.0, -1e-3, 1e-5]), torch.tensor([1e-3, 2e-3, 1e-3]), 1e-3)
    return network.to(dtype)


def near_state(state):
    """A state with distances of obstacle cells, from far behind surfaces to out of reach."""
    cells, generator = state.obstacles, torch.Generator().manual_seed(6)
    distance_K = 3 * REACH_CELLS * (torch.rand(len(cells.key_K), generator=generator) - 0.4)
    return replace(state, obstacles=replace(cells, distance_K=distance_K))
