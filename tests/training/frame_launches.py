"""The launches of a frame on tensors without memory."""

import torch

from hgn.kernels.grid.op import Window
from hgn.kernels.moving import MovingTable
from hgn.kernels.scene_tables import OBSTACLE_COLUMNS, SceneTable
from hgn.kernels.triton_compat import noted_launches
from hgn.network.elastic import RestShape
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.triton_stepper import TritonStepper, first_capacities
from hgn.scene.material import INPUT_PARAMETERS


class Unplaced(TritonStepper):
    """A simulation whose particles have no positions."""

    def _window(self):
        return Window.around((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), self.config.cell_size, self.config.levels)


def frame_of(config, step, precision, cells, *, scenes=1, particles, device="meta"):
    """Every kernel of a frame with its specialisation, and the stepper."""
    with torch.device(device), noted_launches() as launches:
        network = HierarchicalGraphNetwork(config)
        own, seen = config.own_physics, config.obstacle_features
        state = ParticleState(
            # one particle a cell, so that no cell is crowded
            position_N3=config.cell_size * torch.arange(particles)[:, None].expand(-1, 3),
            velocity_NM3=torch.zeros(particles, config.velocity_history, 3),
            material_N=torch.zeros(particles, dtype=torch.int32),
            scene_N=torch.zeros(particles, dtype=torch.int64),
            domain_S3=torch.zeros(scenes, 3),
            gravity_S3=torch.zeros(scenes, 3),
            obstacles=None,
            wall_friction_S3=torch.zeros(scenes, 3) if "friction" in own else None,
            parameter_NP=torch.zeros(particles, len(INPUT_PARAMETERS)) if "parameters" in own else None,
            rest=RestShape.none(torch.zeros(particles, 3)) if "elastic" in own else None,
        )
        where = state.position_N3.device
        obstacles = SceneTable([None] * scenes, OBSTACLE_COLUMNS, where, cell_size=1.0) if seen else None
        capacities = first_capacities(cells, particles)
        stepper = Unplaced(network, state, precision, capacities, obstacles=obstacles, step=step)
        stepper.frame_launches()
        if "moving" in own:
            stepper.moving = MovingTable(stepper.frame, 1, scenes, layers=1, cell_size=1.0)
            stepper.frame_launches()
    return launches, stepper
