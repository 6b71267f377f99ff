"""Compares the constraint at moving obstacles, as compiled for this machine, with PyTorch.

A particle rarely meets a moving obstacle in the first frame. So paths through points of its triangles are compared: a
path starts at the pose of this frame and ends at that of the next one.
Shape legend: P paths, at most one for each row of the buffers, S scenes.
"""

import numpy as np
import torch

from hgn.kernels.buffers import OUT
from hgn.kernels.grid.op import DeviceGrid, DeviceParticles
from hgn.kernels.moving import MovingTable
from hgn.kernels.scene_tables import SceneTable
from hgn.kernels.step.op import DeviceStep
from hgn.network.features import ParticleState
from hgn.network.moving import MovingObstacles
from hgn.runtime.parity import Quantity, require_parity
from hgn.step.reference import advanced
from hgn.step_config import StepConfig

WAYS = 1024  # largest number of paths
# Shifts of the ends of paths, each relative to its size. Rounding changes most of them by 1e-5, far from 0 by 1e-3.
# In a few it chooses between two triangles, so the worst tenth is left out. Wrong poses change them by their size.
SHIFTS = Quantity("shifts at moving obstacles", 0.05)


def require_moving_parity(
    moving: MovingObstacles,
    table: MovingTable,
    domain_S3: torch.Tensor,
    *,
    grid: DeviceGrid,
    step: StepConfig,
    precision: str,
    section: str = "",
) -> None:
    """Compares moving obstacles with the present poses in `table`, without obstacles at rest. Changes grid.status.

    Raises: ParityError if the shifts differ.
    """
    state = _ways(moving, domain_S3, min(WAYS, grid.particles), grid.config.velocity_history)
    still_P3, device = torch.zeros_like(state.position_N3), domain_S3.device
    expected_P3 = advanced(state, still_P3, step, grid.config.dimensions).position_N3
    particles = DeviceParticles(
        position_N3=state.position_N3.clone(), velocity_NV=state.velocity_NM3.flatten(1), scene_N=state.scene_N.int(),
        material_N=state.material_N.int(), origin_S3=torch.zeros_like(domain_S3), domain_S3=domain_S3,
        gravity_S3=state.gravity_S3, count=torch.tensor([len(still_P3)], dtype=torch.int32, device=device),
        frame_S=state.frame_S,
    )  # fmt: skip
    lost, frame = (torch.zeros(1, dtype=torch.int32, device=device) for _ in range(2))
    barriers = SceneTable.of_barriers(None, len(domain_S3), device)
    free_P3 = state.position_N3 + state.velocity_NM3[:, 0]
    grid.status.zero_()
    DeviceStep(step, grid, barriers, 0.0).integrate(
        still_P3.new_zeros(len(still_P3), OUT), particles, (domain_S3.new_zeros(3), domain_S3.new_ones(3)),
        lost=lost, frame=frame, path_TN3=torch.zeros_like(still_P3)[None], moving=table,
    )  # fmt: skip
    grid.status.zero_()
    size_P1 = (expected_P3 - free_P3).norm(dim=-1, keepdim=True).clamp(min=torch.finfo(torch.float32).eps)
    found_P3, shift_P3 = ((end_P3 - free_P3) / size_P1 for end_P3 in (particles.position_N3, expected_P3))
    error_P = (found_P3 - shift_P3).norm(dim=-1).nan_to_num(torch.inf)
    better = error_P.argsort()[: len(error_P) - len(error_P) // 10]
    require_parity(found_P3[better], shift_P3[better], SHIFTS, precision, section=section)


def _ways(moving: MovingObstacles, domain_S3: torch.Tensor, count: int, history: int) -> ParticleState:
    """Returns particles whose paths in the next frame pass triangles of the obstacles, of one after the other."""
    rng, scenes = np.random.default_rng(0), len(moving.scenes)
    own = [(j * scenes + s, obstacle) for s, scene in enumerate(moving.scenes) for j, obstacle in enumerate(scene)]
    chosen = [own[i % len(own)] for i in range(count)]
    corner_P33 = np.stack([rng.choice(obstacle.corner_F33) for _, obstacle in chosen])
    at_P3 = (rng.dirichlet(np.ones(3), count)[..., None] * corner_P33).sum(1)
    half_P3 = moving.cell_size * 10 ** rng.uniform(-1.5, -0.3, (count, 1)) * rng.normal(size=(count, 3))
    device = domain_S3.device
    row_P = torch.tensor([row for row, _ in chosen], device=device)
    poses = moving.poses.map(lambda tensor: tensor.to(device)[row_P])
    ends = (torch.from_numpy(x).to(device) for x in (at_P3 - half_P3, at_P3 + half_P3))
    begin_P3, end_P3 = (pose.put(x).float() for pose, x in zip((poses, poses.later), ends, strict=True))
    velocity_PM3 = torch.zeros(count, history, 3, device=device)
    velocity_PM3[:, 0] = end_P3 - begin_P3
    scene_P = row_P % scenes
    return ParticleState(
        position_N3=begin_P3, velocity_NM3=velocity_PM3, material_N=0 * scene_P, scene_N=scene_P,
        domain_S3=domain_S3, gravity_S3=torch.zeros_like(domain_S3), obstacles=None, moving=moving,
    )  # fmt: skip
