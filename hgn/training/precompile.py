"""Compiles the kernels of a training's updates before they are needed, in child processes.

Triton compiles a kernel at its first launch, one kernel after the other, in a second or more each. This takes a minute
before a training's first update. The children run this module and fill Triton's cache on disk. Updates, and pushforward
simulations before the first update, make their launches on tensors without memory, so no second list of kernels and
variants exists. The tensors' sizes are guesses, on which few variants depend. Other variants are compiled at their
first launch. Other simulations compile their kernels in threads (hgn.kernels.triton_compat) before their first frame.
"""

import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import torch

from hgn.config import NetworkConfig, SceneConfig, TrainConfig
from hgn.kernels.grid.op import Window
from hgn.kernels.moving import MovingTable
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneTable
from hgn.kernels.triton_compat import Launches, compile_launches, noted_launches, use_target
from hgn.kernels.update.op import Updates, UpdateSettings
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_stepper import TritonStepper
from hgn.scene.material import INPUT_PARAMETERS
from hgn.schema import from_mapping, to_mapping
from hgn.step_config import UNCONSTRAINED, StepConfig
from hgn.system.machine import available_cpus
from hgn.system.processes import Program, last_message

MOST_PROCESSES = 12  # largest number of compiling processes
COMMAND = (sys.executable, "-m", "hgn.training.precompile")
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
    pushforward_scenes: int = 0  # number of scenes that pushforward simulates together; 0: none
    step: StepConfig = UNCONSTRAINED  # constraints of these simulations


def launches_of(job: PrecompileJob, device: str = "meta") -> Launches:
    """Returns every kernel of a job with its specialisation, by a key of both. Needs a GPU, or `use_target`."""
    with noted_launches() as launches:
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
        if job.pushforward_scenes > 0:
            ratio = job.pushforward_scenes / job.settings.scenes
            particles, *cells = (round(ratio * count) for count in (job.particles, *job.cells))
            simulation_launches(
                network, job.step, job.precision, tuple(cells), scenes=job.pushforward_scenes, particles=particles
            )
    return launches


class _Unplaced(TritonStepper):
    """A simulation whose particles have no positions."""

    def _window(self) -> Window:
        return Window.around((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), self.config.cell_size, self.config.levels)


def simulation_launches(
    network: HierarchicalGraphNetwork,
    step: StepConfig,
    precision: str,
    cells: tuple[int, ...],
    *,
    scenes: int,
    particles: int,
) -> TritonStepper:
    """Makes the launches of a simulation's frame, first without moving obstacles. Returns the simulation."""
    config, own, device = network.config, network.config.own_physics, network.normaliser.acceleration_std.device
    with device:
        # one particle a cell, so that no cell is crowded
        position_N3 = config.cell_size * torch.arange(particles)[:, None].expand(-1, 3)
        state = ParticleState(
            position_N3=position_N3,
            velocity_NM3=torch.zeros(particles, config.velocity_history, 3),
            material_N=torch.zeros(particles, dtype=torch.int32),
            scene_N=torch.zeros(particles, dtype=torch.int64),
            domain_S3=torch.zeros(scenes, 3),
            gravity_S3=torch.zeros(scenes, 3),
            obstacles=None,
            wall_friction_S3=torch.zeros(scenes, 3) if "friction" in own else None,
            parameter_NP=torch.zeros(particles, len(INPUT_PARAMETERS)) if "parameters" in own else None,
            rest=RestShape.none(position_N3) if "elastic" in own else None,
        )
    obstacles = SceneTable([None] * scenes, OBSTACLE_COLUMNS, device, 1.0) if config.obstacle_features else None
    stepper = _Unplaced(network, state, precision, cells, obstacles=obstacles, step=step)
    stepper.frame_launches()
    if "moving" in own:
        stepper.moving = MovingTable(stepper.frame, 1, scenes, layers=1, cell_size=1.0)
        stepper.frame_launches()
    return stepper


def job_of_training(config: TrainConfig, capability: tuple[int, int], several_ranks: bool) -> PrecompileJob:
    """Returns the kernels that a training on such a GPU needs. The distribution of scenes determines their sizes."""
    training, network = config.training, config.network
    particles, cells = _sizes(config.scene, network.levels)
    return PrecompileJob(
        network,
        UpdateSettings.of(training, config.scene.cell_size),
        training.precision,
        several_ranks,
        averages=training.ema_decay > 0,
        particles=training.batch_scenes * particles,
        cells=tuple(training.batch_scenes * count for count in cells),
        capability=10 * capability[0] + capability[1],
        pushforward_scenes=training.pushforward_scenes if training.pushforward_fraction > 0 else 0,
        step=config.step.in_training,
    )


def _sizes(scene: SceneConfig, levels: int) -> tuple[int, list[int]]:
    """Returns the numbers of initial particles and of cells on each level, for a scene whose groups are cubes."""
    edge = scene.group_size / scene.cell_size
    particles = scene.group_count * scene.particles_per_cell * edge**3
    cells, length = [], edge + 2  # neighbours of a particle's cell are active too
    for _ in range(levels):
        cells.append(max(1, round(scene.group_count * length**3)))
        length = (length + 1) / 2
    return max(1, round(particles)), cells


class Precompilation:
    """Processes that compile kernels."""

    def __init__(self, job: PrecompileJob, processes: int | None = None, command: Sequence[str] = COMMAND) -> None:
        """Starts `processes` with low priority, by default two fewer than there are cores."""
        processes = processes or max(1, min(MOST_PROCESSES, available_cpus() - 2))
        self._started = time.monotonic()
        self._files = contextlib.ExitStack()
        outputs = [self._files.enter_context(tempfile.TemporaryFile()) for _ in range(processes)]  # noqa: SIM115
        text = json.dumps(to_mapping(job))
        self._programs = [
            Program([*command, str(part), str(processes)], output, text) for part, output in enumerate(outputs)
        ]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()

    @property
    def running(self) -> bool:
        return any(program.exit_code is None for program in self._programs)

    def wait(self, interrupted: Callable[[], bool] = lambda: False) -> str:
        """Waits until all have ended or `interrupted` returns True. Returns a message for the user."""
        while self.running:
            if interrupted():
                self.stop()
                return "backend triton: compiling was interrupted"
            time.sleep(0.05)
        seconds = time.monotonic() - self._started
        failed = [program for program in self._programs if program.exit_code != 0]
        if failed:
            return (
                f"backend triton: {len(failed)} of {len(self._programs)} processes that compile kernels ahead failed "
                f"(exit code {failed[0].exit_code}: {last_message(failed[0].output)}); "
                "missing kernels are compiled at their first launch"
            )
        count = sum(int(last_message(program.output)) for program in self._programs)
        return f"backend triton: {count} kernels ready {seconds:.0f} s after the start"

    def stop(self) -> None:
        """Ends those that still run. The cache contains only complete kernels."""
        for program in self._programs:
            program.stop()
        self._files.close()


def compile_part(job: PrecompileJob, part: int, parts: int) -> int:
    """Compiles every `parts`-th kernel, starting with number `part`. Returns the number of these kernels."""
    return len(compile_launches(list(launches_of(job).values())[part::parts]))


def main() -> None:
    """Compiles a part of the kernels of the job on standard input."""
    os.nice(NICENESS)
    job = from_mapping(PrecompileJob, json.load(sys.stdin))
    use_target(job.capability)
    print(compile_part(job, *map(int, sys.argv[1:])))


if __name__ == "__main__":
    main()
