"""Moving surfaces: what a network sees and does depends only on velocities relative to them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from network.states import airborne, network_of

from hgn.network.barriers import Barriers
from hgn.network.moving import MovingObstacles
from hgn.network.obstacles import ObstacleCells
from hgn.scene.motion import Motion
from hgn.scene.moving import moving_obstacles
from hgn.scene.rotation import euler_rotation
from hgn.scene.shapes import shape_obstacle
from hgn.step.reference import accelerations, advanced

OWN = ("friction", "moving")
CELL, FRAME_S, CLEARANCE = 1 / 64, 1 / 60, 0.006
COMMON = (0.035, -0.07, 0.035)  # domain units per frame: whole coarsest cells of a network with one level


def plates(velocities, turns=None, friction=0.4):
    """Two plates about the particles of `struck`, each with its motion; velocity 0 of both: at rest."""
    found = []
    for i, velocity in enumerate(velocities):
        position = (0.9 + 0.05 * i, 0.86 + 0.1 * i, 0.9)
        plate = shape_obstacle("square", 0.2, position, euler_rotation((10.0, 0.0, 20.0 * i)), f"plate_{i}")
        time_T = np.array([0.0, 100 * FRAME_S])
        turn = np.eye(3) if turns is None else euler_rotation(turns[i])
        motion = Motion(
            time_T, np.array([np.zeros(3), 100 * np.array(velocity)]), np.stack([np.eye(3), turn]), position
        )
        found.append(replace(plate, friction=friction, motion=motion))
    return found


def moving_of(obstacles, frame=0, network=None):
    return MovingObstacles.of([moving_obstacles(obstacles, CELL)], [frame], FRAME_S, network, clearance=CLEARANCE)


def struck(velocity=(0.0, 0.0, 0.0), count=60):
    """A cloud between the plates, far from walls, that moves at random about a velocity."""
    generator = torch.Generator().manual_seed(3)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    velocity_N3 = torch.tensor(velocity, dtype=torch.float64) + 6e-3 * (draw(count, 3) - 0.5)
    age_H1 = torch.arange(5, dtype=torch.float64)[:, None]
    state = airborne((count,))
    history_NM3 = velocity_N3[:, None] - age_H1 * state.gravity_S3 + 1e-4 * draw(count, 5, 3)
    place_N3 = torch.tensor([0.82, 0.86, 0.82]) + 0.16 * draw(count, 3) * torch.tensor([1.0, 0.6, 1.0])
    return replace(state, position_N3=place_N3, velocity_NM3=history_NM3, domain_S3=torch.full((1, 3), 4.0).double())


def at_rest(state, obstacles, distances=False):
    """The state with the obstacles at rest as a network without `moving` gets them."""
    still = [moving_obstacles([obstacle], CELL)[0] for obstacle in obstacles]
    cells = ObstacleCells.of([still[0].grid], distances)
    return replace(state, obstacles=cells, barriers=Barriers.of([still[0].barrier(CLEARANCE)]))


def network_for(**changes):
    values = {"inputs": "local", "own_physics": OWN, "obstacle_clearance": CLEARANCE, "levels": 1} | changes
    return network_of(**values)


def rolled(network, state, frames):
    """Positions of the next frames, [T, N, 3]."""
    positions = []
    with torch.no_grad():
        for _ in range(frames):
            acceleration_N3 = accelerations(network, state, network.prediction(state))
            state = advanced(state, acceleration_N3, network.step, 3)
            positions.append(state.position_N3)
    return torch.stack(positions)


@pytest.mark.parametrize(("frames", "distances"), [(1, False), (10, False), (1, True), (10, True)])
def test_a_common_velocity_changes_nothing(frames, distances):
    """Particles and an obstacle with one velocity move as they do about the obstacle at rest, which is a scene without
    moving obstacles: ten frames with contacts and friction."""
    network, obstacles = network_for(obstacle_distances=distances), plates([COMMON])
    still = rolled(network, at_rest(struck(), obstacles, distances), frames)
    moved = rolled(network, replace(struck(COMMON), moving=moving_of(obstacles, 0, network.config)), frames)
    shift_T13 = torch.arange(1, frames + 1)[:, None, None] * torch.tensor(COMMON, dtype=torch.float64)
    torch.testing.assert_close(moved - shift_T13, still, rtol=0, atol=1e-11)
    free = rolled(network, struck(), frames)
    assert float((still - free).abs().max()) > 1e-4 and torch.unique((still - free)[-1].norm(dim=-1) > 1e-9).sum() > 0
    blind = rolled(network, at_rest(struck(COMMON), obstacles, distances), 1)
    assert float((blind[0] - shift_T13[0] - still[0]).abs().max()) > 1e-4


def test_several_motions_and_a_boost():
    """Two plates that move and turn: adding one velocity to them and to the particles changes no acceleration."""
    network, turns = network_for(levels=3), [(0.0, 90.0, 30.0), (-60.0, 0.0, 0.0)]
    slow = [(2e-3, 5e-3, 0.0), (0.0, -4e-3, 1e-3)]
    fast = [tuple(np.add(velocity, COMMON)) for velocity in slow]
    states = [
        replace(struck(common), moving=moving_of(plates(velocities, turns)))
        for common, velocities in (((0.0, 0.0, 0.0), slow), (COMMON, fast))
    ]
    first, second = (network(state).detach() for state in states)
    torch.testing.assert_close(first, second, rtol=0, atol=1e-13)
    still = network(replace(states[0], moving=moving_of(plates([(0.0, 0.0, 0.0)] * 2)))).detach()
    assert float((first - still).abs().max()) > 1e-5
