"""An engine on the particles of a reference state, for the parity tests."""

from dataclasses import replace

import torch

from hgn.kernels.backward import FusedTrainingNetwork
from hgn.kernels.forward import FusedNetwork
from hgn.kernels.grid.op import CellBox, DeviceGrid, DeviceParticles
from hgn.kernels.moving import MovingTable
from hgn.kernels.packing import pack_network
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.step.op import rest_numbers
from hgn.kernels.tuning import Tuning
from hgn.network.elastic import COLUMNS


def device():
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def engine_of(network, state, precision="fp32", capacities=(), spare_particles=3, loss_scale=1.0, tuning=None):
    """All buffers that the forward pass writes are NaN before, so that what nobody writes shows."""
    config, where = network.config, device()
    particles = len(state.position_N3)
    capacities = capacities or tuple(max(16, 8 * particles) for _ in range(config.levels))
    box = state.position_N3.float()
    lower, upper = box.min(0).values.tolist(), box.max(0).values.tolist()
    box = CellBox.around(lower, upper, config.cell_size, config.levels, 2)
    more = rest_numbers(network.step, box, state.scene_count, config.levels)
    grid = DeviceGrid(config, box, capacities, state.scene_count, particles + spare_particles, where, more)
    packed = pack_network(network)
    values = packed.gather(list(network.parameters())).to(where)
    count = torch.tensor([particles], dtype=torch.int32, device=where)
    return FusedTrainingNetwork(packed, values, grid, count, precision, loss_scale, tuning)


def inference_of(engine, network, half_cells=False, half_sums=False):
    """An engine that keeps nothing, on the same grid: other kernels than those of training."""
    tuning = replace(Tuning.of(engine.precision), half_cells=half_cells, half_sums=half_sums)
    given = (engine.packed, engine.values, engine.grid, engine.particle_count, engine.precision)
    return FusedNetwork(*given, tuning=tuning)


def run_forward(engine, network, state, origin_S3):
    """The engine's normalised accelerations of the state, [N, 3]."""
    prepare(engine, network, state, origin_S3)
    engine.forward()
    return engine.output[: len(state.position_N3), :3].cpu()


def prepare(engine, network, state, origin_S3):
    """Prepares the state's cells and features in the engine's grid; returns its particles there."""
    where, grid = engine.device, engine.grid

    def padded(value):
        full = torch.full((grid.particles, *value.shape[1:]), 7, dtype=value.dtype)
        full[: len(value)] = value
        return full.to(where)

    scale = tuple(x.float().to(where) for x in network.normaliser.feature_scale(network.config.relative))
    walls_S3 = state.wall_friction_S3 if "friction" in network.config.own_physics else None
    columns_NP = state.parameter_NP
    if state.rest is not None:
        columns_NP = torch.cat([columns_NP, torch.zeros(len(columns_NP), COLUMNS)], 1)
    obstacles = state.obstacles and state.obstacles.to(where)
    obstacles = obstacles and SceneTable.of_obstacles(obstacles, state.scene_count, walls_S3 is not None)
    particles = DeviceParticles(
        position_N3=padded(state.position_N3.float()),
        velocity_NV=padded(state.velocity_NM3.float().flatten(1)),
        scene_N=padded(state.scene_N.int()),
        material_N=padded(state.material_N.int()),
        origin_S3=origin_S3.float().to(where),
        domain_S3=state.domain_S3.float().to(where),
        gravity_S3=state.gravity_S3.float().to(where),
        count=engine.particle_count,
        frame_S=state.frame_S.to(where),
        wall_friction_S3=None if walls_S3 is None else walls_S3.float().to(where),
        parameter_NP=None if state.parameter_NP is None else padded(columns_NP.float()),
        rest_NR=state.rest and padded(state.rest.packed),
    )
    grid.build(particles)
    grid.prepare(particles, scale, obstacles, moving=state.moving and table_of(state.moving, walls_S3 is not None))
    return particles


def table_of(moving, friction):
    """The records of a frame, the second of three instants."""
    instant = torch.ones(1, dtype=torch.int32, device=device())
    table = MovingTable(instant, 3, len(moving.scenes), moving.layers, moving.cell_size)
    table.take(moving.to(device()), friction)
    table.set_poses(1, moving.scenes, moving.frames, moving.frame_s)
    return table


def gradients(engine, network):
    """What `backward` left, shaped as the network's parameters."""
    found = [torch.zeros_like(p, dtype=torch.float32) for p in network.parameters()]
    engine.packed.scatter(engine.totals[: engine.packed.size].cpu(), found)
    return found
