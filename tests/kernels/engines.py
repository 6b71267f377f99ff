"""An engine on the particles of a reference state, for the parity tests."""

from dataclasses import replace

import torch

from hgn.kernels.backward import FusedTrainingNetwork
from hgn.kernels.forward import FusedNetwork, feature_columns
from hgn.kernels.grid.op import DeviceGrid, Window
from hgn.kernels.packing import pack_network
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.step.op import DeviceParticles, rest_numbers
from hgn.kernels.tuning import Tuning


def device():
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def engine_of(network, state, precision="fp32", capacities=(), spare_particles=3, loss_scale=1.0, tuning=None):
    """All buffers that the forward pass writes are NaN before, so that what nobody writes shows."""
    config, where = network.config, device()
    particles = len(state.position_N3)
    capacities = capacities or tuple(max(16, 8 * particles) for _ in range(config.levels))
    box = state.position_N3.float()
    lower, upper = box.min(0).values.tolist(), box.max(0).values.tolist()
    window = Window.around(lower, upper, config.cell_size, config.levels, 2)
    grid = DeviceGrid(
        window,
        state.scene_count,
        capacities,
        particles + spare_particles,
        feature_columns(config),
        config.cell_size,
        where,
        config.relative,
        rest_numbers(network.step, window, state.scene_count, config.levels),
    )
    packed = pack_network(network)
    values = packed.gather(list(network.parameters())).to(where)
    count = torch.tensor([particles], dtype=torch.int32, device=where)
    return FusedTrainingNetwork(config, packed, values, grid, count, precision, loss_scale, tuning)


def inference_of(engine, network, half_cells=False, half_sums=False):
    """An engine that keeps nothing, on the same grid: other kernels than those of training."""
    tuning = replace(Tuning.of(engine.precision), half_cells=half_cells, half_sums=half_sums)
    given = (network.config, engine.packed, engine.values, engine.grid, engine.particle_count, engine.precision)
    return FusedNetwork(*given, tuning=tuning)


def run_forward(engine, network, state, origin_S3):
    """The engine's normalised accelerations of the state, [N, 3]."""
    prepare(engine, network, state, origin_S3)
    engine.forward()
    return engine.output[: len(state.position_N3), :3].cpu()


def prepare(engine, network, state, origin_S3):
    """Prepares the state's cells and features in the engine's grid; returns its particles there."""
    where, grid, config = engine.device, engine.grid, network.config

    def padded(value):
        full = torch.full((grid.particles, *value.shape[1:]), 7, dtype=value.dtype)
        full[: len(value)] = value
        return full.to(where)

    position = padded(state.position_N3.float())
    velocity = padded(state.velocity_NM3.float().flatten(1))
    scene = padded(state.scene_N.int())
    material = padded(state.material_N.int())
    origin, domain, gravity = (x.float().to(where) for x in (origin_S3, state.domain_S3, state.gravity_S3))
    obstacles = (
        SceneTable.of_obstacles(state.obstacles.to(where), state.scene_count) if state.obstacles is not None else None
    )
    grid.build(position, scene, origin, engine.particle_count)
    normaliser = network.normaliser
    grid.prepare(
        config,
        position,
        velocity,
        scene,
        material,
        origin,
        domain,
        gravity,
        engine.particle_count,
        *(x.float().to(where) for x in normaliser.feature_scale(config.relative)),
        obstacles,
    )
    return DeviceParticles(position, velocity, scene, material, domain, gravity, engine.particle_count)


def gradients(engine, network):
    """What `backward` left, shaped as the network's parameters."""
    found = [torch.zeros_like(p, dtype=torch.float32) for p in network.parameters()]
    engine.packed.scatter(engine.totals[: engine.packed.size].cpu(), found)
    return found
