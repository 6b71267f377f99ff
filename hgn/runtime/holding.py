"""What walls and the rigid surfaces of obstacles let a frame's motion be.

Shape legend: N particles of all scenes, S scenes.
"""

from __future__ import annotations

import torch
from torch.compiler import is_exporting

from hgn.config import NetworkConfig
from hgn.network.barriers import Barriers
from hgn.network.features import ParticleState
from hgn.runtime.divergence import within_range

SURFACES = 3  # that stop a way one after the other; what a further one stops ends where it meets that
LEAST_CREASE = 1e-4  # squared sine of the angle between two planes, below which they are one


def held(
    state: ParticleState, position_N3: torch.Tensor, velocity_N3: torch.Tensor, config: NetworkConfig
) -> tuple[torch.Tensor, torch.Tensor]:
    """The next positions and velocities as walls and obstacles let them be; `state` is that of before the frame.

    With `wall_clearance` positions are no nearer to the planes at 0 and at the domain's size than the clearances, or
    than they were: so what is between two walls that leave no room stays. Axes from `dimensions` on have no walls. With
    `obstacle_clearance` no particle passes a triangle of an obstacle (hgn.network.barriers). Where a position changes,
    the velocity is what was moved. What is not `within_range` is not held, so that divergence is seen by positions.
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
    """Up to SURFACES triangles stop the straight way of a frame one after the other, and walls again.

    Each shifts its end. Where that shift would bring the end nearer to the plane of the shift before, the end moves
    along the crease of both planes instead, for from plane to plane a narrow gutter would take more shifts than these.
    """
    before_N3, domain_N3 = state.position_N3, state.domain_S3[state.scene_N]
    lost_N1 = ~within_range(position_N3, domain_N3).all(-1, keepdim=True)
    end_N3 = torch.where(lost_N1, before_N3, position_N3)
    last_N3 = torch.zeros_like(end_N3)
    for surface in range(SURFACES + 1):
        hit_N, shift_N1, normal_N3, free_N1 = barriers.stopped(before_N3, end_N3, state.scene_N)
        if not is_exporting() and not bool(hit_N.any()):
            break
        if surface == SURFACES:
            moved_N3 = before_N3 + free_N1 * (end_N3 - before_N3)
        else:
            moved_N3 = end_N3 + shift_N1 * _direction(normal_N3, last_N3)
            if config.wall_clearance is not None:
                moved_N3 = _walled(state, moved_N3, config)
        end_N3 = torch.where(hit_N[:, None], moved_N3, end_N3)
        last_N3 = torch.where(hit_N[:, None], normal_N3, last_N3)
    return torch.where(lost_N1, position_N3, end_N3)


def _direction(normal_N3: torch.Tensor, last_N3: torch.Tensor) -> torch.Tensor:
    """Along the normals, or where that leads back across the last ones, along the last planes and by so much farther
    that the distance from the new ones is the same.
    """
    cosine_N1 = (normal_N3 * last_N3).sum(-1, keepdim=True)
    along_N3 = normal_N3 - cosine_N1 * last_N3
    square_N1 = (along_N3 * along_N3).sum(-1, keepdim=True)
    crease_N1 = (cosine_N1 < 0) & (square_N1 > LEAST_CREASE)
    return torch.where(crease_N1, along_N3 / square_N1.clamp(min=LEAST_CREASE), normal_N3)
