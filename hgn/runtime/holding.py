"""What walls and obstacles that nothing passes let a frame's motion be.

Shape legend: N particles of all scenes, S scenes.
"""

from __future__ import annotations

import torch
from torch.compiler import is_exporting

from hgn.config import NetworkConfig
from hgn.network.barriers import Barriers
from hgn.network.features import ParticleState
from hgn.runtime.divergence import within_range

SURFACES = 3  # that stop a way one after the other; what others are then in the way of stays where it was


def held(
    state: ParticleState, position_N3: torch.Tensor, velocity_N3: torch.Tensor, config: NetworkConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """The next positions and velocities as walls and obstacles let them be; `state` is that of before the frame.

    With `wall_clearance` positions are no nearer to the planes at 0 and at the domain's size than the clearances, or
    than they were: so what is between two walls that leave no room stays. Axes from `dimensions` on have no walls. With
    `obstacle_clearance` no particle passes a triangle (hgn.network.barriers). Where a position changes, the velocity is
    what was moved. What is not `within_range` is not held, so that divergence is seen by positions.
    """
    free_N3 = position_N3
    if config.wall_clearance is not None:
        position_N3 = _walled(state, position_N3, config)
    if config.obstacle_clearance is not None and state.barriers is not None:
        position_N3 = _kept_apart(state, position_N3, config, state.barriers)
    changed_N3 = position_N3 != free_N3
    return position_N3, torch.where(changed_N3, position_N3 - state.position_N3, velocity_N3)


def _walled(state: ParticleState, position_N3: torch.Tensor, config: NetworkConfig) -> torch.Tensor:
    assert config.wall_clearance is not None
    near, far = config.wall_clearance
    before_N3, domain_N3 = state.position_N3, state.domain_S3[state.scene_N]
    low_N3 = torch.where(before_N3 < near, before_N3, near)
    high_N3 = torch.where(before_N3 > domain_N3 - far, before_N3, domain_N3 - far)
    walled_3 = torch.arange(3, device=position_N3.device) < config.dimensions
    stopped_N3 = ((position_N3 < low_N3) | (position_N3 > high_N3)) & within_range(position_N3, domain_N3) & walled_3
    limit_N3 = torch.where(position_N3 < low_N3, low_N3, high_N3)
    return torch.where(stopped_N3, limit_N3, position_N3)


def _kept_apart(
    state: ParticleState, position_N3: torch.Tensor, config: NetworkConfig, barriers: Barriers
) -> torch.Tensor:
    """The straight way of a frame is stopped by up to SURFACES triangles one after the other, and by walls again."""
    before_N3, domain_N3 = state.position_N3, state.domain_S3[state.scene_N]
    lost_N1 = ~within_range(position_N3, domain_N3).all(-1, keepdim=True)
    end_N3 = torch.where(lost_N1, before_N3, position_N3)
    for surface in range(SURFACES + 1):
        hit_N, moved_N3 = barriers.stopped(before_N3, end_N3, state.scene_N)
        if not is_exporting() and not bool(hit_N.any()):
            break
        if surface == SURFACES:
            moved_N3 = before_N3
        elif config.wall_clearance is not None:
            moved_N3 = _walled(state, moved_N3, config)
        end_N3 = torch.where(hit_N[:, None], moved_N3, end_N3)
    return torch.where(lost_N1, position_N3, end_N3)
