"""The friction angle of sand from its run-out, by gradients through the shipped network."""

import numpy as np
import pytest
import torch

from hgn.runtime.simulator import Simulator
from hgn.scene.scene import Scene

FRAMES = 15


def run_out(simulator, seed, angle_deg):
    """How far a small column spreads on a rough floor: the increase of the mean distance from its axis."""
    cube_N3 = np.argwhere(np.ones((6, 7, 6)))
    place_N3 = (cube_N3 + np.random.default_rng(seed).random(cube_N3.shape)) / 128 + (0.4766, 0.05, 0.4766)
    start = place_N3.astype(np.float32), np.zeros_like(place_N3, np.float32), np.ones(len(place_N3), np.uint8)
    sand = Scene(*start, wall_friction=(0.0, 0.6, 0.0))
    own = {"sand_friction_angle_deg": angle_deg.expand(len(place_N3))}
    distance_TN = (simulator.differentiable(sand, FRAMES, **own)[:, :, [0, 2]] - 0.5).norm(dim=2)
    return distance_TN[-1].mean() - distance_TN[0].mean()


def test_a_run_out_gives_the_friction_angle():
    """Three Newton steps from 33 degrees find an angle of 24 within half a degree. There the gradient, which ignores
    jumps between cells, is that of differences within a fifth."""
    simulator = Simulator.load("own_physics", device="cpu", precision="fp32")
    with torch.no_grad():
        low, target, high = (run_out(simulator, 1, torch.tensor(angle_deg)) for angle_deg in (22.0, 24.0, 26.0))
    angles, slope = [33.0], 0.0
    for _ in range(3):
        angle_deg = torch.tensor(angles[-1], requires_grad=True)
        value = run_out(simulator, 1, angle_deg)
        slope = torch.autograd.grad(value, angle_deg)[0].item()
        angles.append(angles[-1] + float(target - value.detach()) / slope)
    assert angles[-1] == pytest.approx(24.0, abs=0.5), angles
    assert slope == pytest.approx(float(high - low) / 4, rel=0.2)
