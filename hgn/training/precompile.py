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

import torch

from hgn.config import TrainConfig
from hgn.kernels.grid.op import CellBox
from hgn.kernels.moving import MovingTable
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneTable
from hgn.kernels.triton_compat import Launches, compile_launches, noted_launches, use_target
from hgn.kernels.update.op import Updates
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_stepper import TritonStepper
from hgn.scene.material import INPUT_PARAMETERS
from hgn.schema import from_mapping, to_mapping
from hgn.step_config import StepConfig
from hgn.system.machine import available_cpus
from hgn.system.processes import Program, last_message

MOST_PROCESSES = 12  # largest number of compiling processes
COMMAND = (sys.executable, "-m", "hgn.training.precompile")
NICENESS = 10  # low priority of the compiling processes


def launches_of(
    config: TrainConfig, several_ranks: bool, sizes: tuple[int, tuple[int, ...]], device: str = "meta"
) -> Launches:
    """Returns every kernel of a training with its specialisation, by a key of both. Needs a GPU, or `use_target`.

    `sizes` are approximate numbers of particles, and of cells on each level, in an update.
    """
    training, own, (particles, cells) = config.training, config.network.own_physics, sizes
    with noted_launches() as launches:
        with torch.device(device):
            network = HierarchicalGraphNetwork(config.network)
        network.step = config.step
        sums, counters = torch.zeros(2, device=device), torch.zeros(5, device=device)
        reduce: Callable[[torch.Tensor], None] | None = (lambda _: None) if several_ranks else None
        cell_size, precision = config.scene.cell_size, training.precision
        updates = Updates(network, training, cell_size, precision, loss_sum=sums, counters=counters, reduce=reduce)
        updates.average = torch.zeros_like(updates.values) if training.ema_decay > 0 else None
        updates.allocate(particles, cells)
        updates.launches()
        if "moving" in own:
            updates.allocate_moving(1)
            updates.launches()
        if training.pushforward_fraction > 0:
            scenes = training.pushforward_scenes
            ratio = scenes / training.batch_scenes
            particles, *rest = (round(ratio * count) for count in (particles, *cells))
            step = config.step.in_training
            simulation_launches(network, step, precision, tuple(rest), scenes=scenes, particles=particles)
    return launches


class _Unplaced(TritonStepper):
    """A simulation whose particles have no positions."""

    def _cell_box(self) -> CellBox:
        return CellBox.around((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), self.config.cell_size, self.config.levels)


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
        # one particle per cell, so that no cell is crowded
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


def sizes_of(config: TrainConfig) -> tuple[int, tuple[int, ...]]:
    """Returns the initial numbers of particles, and of cells on each level, in an update, if groups are cubes."""
    scene, scenes = config.scene, config.training.batch_scenes
    edge = scene.group_size / scene.cell_size
    particles = scene.group_count * scene.particles_per_cell * edge**3
    cells, length = [], edge + 2  # neighbours of a particle's cell are active too
    for _ in range(config.network.levels):
        cells.append(scenes * max(1, round(scene.group_count * length**3)))
        length = (length + 1) / 2
    return scenes * max(1, round(particles)), tuple(cells)


class Precompilation(contextlib.AbstractContextManager["Precompilation"]):
    """Processes that compile kernels."""

    def __init__(
        self,
        config: TrainConfig,
        capability: tuple[int, int],
        several_ranks: bool,
        processes: int | None = None,
        command: Sequence[str] = COMMAND,
    ) -> None:
        """Starts `processes` with low priority, by default two fewer than there are cores.

        `capability` is the GPU's, (9, 0) for an H100. `config` names the precision.
        """
        processes = processes or max(1, min(MOST_PROCESSES, available_cpus() - 2))
        self._started = time.monotonic()
        self._files = contextlib.ExitStack()
        outputs = [self._files.enter_context(tempfile.TemporaryFile()) for _ in range(processes)]  # noqa: SIM115
        text, (major, minor) = json.dumps(to_mapping(config)), capability
        common = [*map(str, (processes, 10 * major + minor, int(several_ranks)))]
        self._programs = [Program([*command, str(part), *common], file, text) for part, file in enumerate(outputs)]

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


def main() -> None:
    """Compiles every `parts`-th kernel of the training on standard input, from number `part`. Prints their number."""
    os.nice(NICENESS)
    part, parts, capability, several_ranks = map(int, sys.argv[1:])
    use_target(capability)
    config = from_mapping(TrainConfig, json.load(sys.stdin))
    launches = launches_of(config, bool(several_ranks), sizes_of(config))
    print(len(compile_launches(list(launches.values())[part::parts])))


if __name__ == "__main__":
    main()
