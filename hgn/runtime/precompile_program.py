"""python -m hgn.runtime.precompile_program: compiles kernels into Triton's cache on disk.

Updates and TritonStepper make their launches on tensors without memory, so no second list of kernels and variants
exists. The tensors' sizes are guesses, on which few variants depend. Other variants are compiled at first use.
"""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass

import torch

from hgn.config import NetworkConfig
from hgn.kernels.grid.op import Window
from hgn.kernels.moving import MovingTable
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneTable
from hgn.kernels.triton_compat import Launches, compile_launches, noted_launches, use_target
from hgn.kernels.update.op import Updates, UpdateSettings
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_stepper import TritonStepper, first_capacities
from hgn.scene.material import INPUT_PARAMETERS
from hgn.schema import from_mapping, to_mapping
from hgn.step_config import UNCONSTRAINED, StepConfig

NICENESS = 10  # low priority of the compiling processes


@dataclass(frozen=True)
class PrecompileJob:
    """A training whose kernels are compiled ahead."""

    network: NetworkConfig
    settings: UpdateSettings
    precision: str
    several_ranks: bool
    averages: bool  # whether the training averages its parameters
    particles: int  # approximate number of particles in an update
    cells: tuple[int, ...]  # approximate number of cells on each level
    capability: int  # capability of the GPU: 90 for an H100
    pushforward_scenes: tuple[int, ...] = ()  # numbers of scenes that the network simulates together in the training
    step: StepConfig = UNCONSTRAINED  # constraints of these simulations


@dataclass(frozen=True)
class FrameJob:
    """Simulations whose kernels are compiled ahead."""

    networks: tuple[tuple[NetworkConfig, StepConfig, str], ...]  # network, constraints, precision
    sizes: tuple[tuple[int, int], ...]  # pairs of particles and finest cells
    capability: int  # capability of the GPU: 90 for an H100


def launches_of(job: PrecompileJob | FrameJob, device: str = "meta") -> Launches:
    """Returns every kernel of a job with its specialisation, by a key of both. Needs a GPU, or `use_target`."""
    with noted_launches() as launches:
        if isinstance(job, PrecompileJob):
            _update_launches(job, device)
        else:
            for config, step, precision in job.networks:
                _frame_launches(config, step, precision, job.sizes, device=device)
    return launches


def _update_launches(job: PrecompileJob, device: str) -> None:
    with torch.device(device):
        network = HierarchicalGraphNetwork(job.network)
    nothing = torch.zeros(5, device=device)
    reduce: Callable[[torch.Tensor], None] | None = (lambda _: None) if job.several_ranks else None
    updates = Updates(network, job.settings, job.precision, nothing[:2], counters=nothing, reduce=reduce)
    updates.average = torch.zeros_like(updates.values) if job.averages else None
    updates.allocate(job.particles, job.cells)
    updates.launches()
    if "moving" in job.network.own_physics:
        updates.allocate_moving(1)
        updates.launches()
    for scenes in job.pushforward_scenes:  # simulations of hgn.training.triton_pushforward and of monitored rollouts
        fraction = scenes / job.settings.scenes
        particles = round(fraction * job.particles)
        capacities = first_capacities([round(fraction * cells) for cells in job.cells], particles)
        for step in dict.fromkeys((job.step.in_training, job.step)):
            _simulation_launches(network, step, job.precision, capacities, scenes=scenes, particles=particles)


def _frame_launches(
    config: NetworkConfig, step: StepConfig, precision: str, sizes: tuple[tuple[int, int], ...], device: str
) -> None:
    """Makes the launches of hgn.runtime.simulator. Each level has a quarter of the cells of the next finer one."""
    with torch.device(device):
        network = HierarchicalGraphNetwork(config)
    for particles, cells in sizes:
        capacities = tuple(max(1, cells >> 2 * level) for level in range(config.levels))
        _simulation_launches(network, step, precision, capacities, scenes=1, particles=particles)


class _Unplaced(TritonStepper):
    """A simulation whose particles have no positions."""

    def _window(self) -> Window:
        return Window.around((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), self.config.cell_size, self.config.levels)


def _simulation_launches(
    network: HierarchicalGraphNetwork,
    step: StepConfig,
    precision: str,
    capacities: tuple[int, ...],
    *,
    scenes: int,
    particles: int,
) -> None:
    """Makes the launches of a frame."""
    config, obstacles, device = network.config, None, network.normaliser.acceleration_std.device
    if config.obstacle_features:
        obstacles = SceneTable([None] * scenes, OBSTACLE_COLUMNS, device, cell_size=1.0)
    state = ParticleState(
        # one particle a cell, so that no cell is crowded
        position_N3=config.cell_size * torch.arange(particles, device=device)[:, None].expand(-1, 3),
        velocity_NM3=torch.zeros(particles, config.velocity_history, 3, device=device),
        material_N=torch.zeros(particles, dtype=torch.int32, device=device),
        scene_N=torch.zeros(particles, dtype=torch.int64, device=device),
        domain_S3=torch.zeros(scenes, 3, device=device),
        gravity_S3=torch.zeros(scenes, 3, device=device),
        obstacles=None,
        wall_friction_S3=torch.zeros(scenes, 3, device=device) if "friction" in config.own_physics else None,
        parameter_NP=torch.zeros(particles, len(INPUT_PARAMETERS), device=device)
        if "parameters" in config.own_physics
        else None,
        rest=RestShape.none(torch.zeros(particles, 3, device=device)) if "elastic" in config.own_physics else None,
    )
    stepper = _Unplaced(network, state, precision, capacities, obstacles=obstacles, step=step)
    stepper.frame_launches()
    if "moving" in config.own_physics:
        stepper.moving = MovingTable(stepper.frame, 1, scenes, layers=1, cell_size=1.0)
        stepper.frame_launches()


def compile_part(job: PrecompileJob | FrameJob, part: int, parts: int) -> int:
    """Compiles every `parts`-th kernel, starting with number `part`. Returns the number of these kernels."""
    mine = list(launches_of(job).values())[part::parts]
    return len(compile_launches(mine))


def job_text(job: PrecompileJob | FrameJob) -> str:
    return json.dumps(to_mapping(job))


def job_of(text: str) -> PrecompileJob | FrameJob:
    mapping = json.loads(text)
    return from_mapping(FrameJob, mapping) if "networks" in mapping else from_mapping(PrecompileJob, mapping)


def main() -> None:
    os.nice(NICENESS)
    part, parts = map(int, sys.argv[1:])
    job = job_of(sys.stdin.read())
    use_target(job.capability)
    print(compile_part(job, part, parts))


if __name__ == "__main__":
    main()
