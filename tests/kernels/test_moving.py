"""Simulations with moving obstacles on the device against the plain ones; the network's outputs are in test_network."""

from dataclasses import replace

import numpy as np
import pytest
from kernels.cases import swept
from kernels.test_rollout import motion, path_of, scene, thrown
from kernels.test_rollout import unchecked as unchecked

from hgn.runtime import triton_stepper
from hgn.runtime.triton_stepper import TritonStepper

pytestmark = pytest.mark.usefixtures("large_tiles")


@pytest.mark.parametrize("clearance", [None, 2e-3])
def test_moving_obstacles(clearance, monkeypatch):
    """Frames of scenes with two, one and no moving obstacles are those of backend torch, over several blocks. The same
    buffers go on with fewer obstacles in another frame, and with none, to the rounding of a GPU's sums."""
    monkeypatch.setattr(triton_stepper, "LOOK_FRAMES", 2)
    monkeypatch.setattr(triton_stepper, "FEWEST_FRAMES", 2)
    changes = {"inputs": "local", "own_physics": ("friction", "moving"), "wall_clearance": (0.01, 0.01)}
    changes |= {"obstacle_clearance": clearance, "levels": 2, "deviation": 0.01}
    own = [(swept(7), swept(8)), (swept(9),), ()]
    scenes = [scene(count, seed, wall_friction=(0.2, 0.0, 0.1)) for seed, count in enumerate((20, 12, 5))]
    scenes = [replace(each, moving=moving) for each, moving in zip(scenes, own, strict=True)]
    expected_TN3, expected_NM3 = motion(thrown("torch", **changes), scenes, 5)
    fast = thrown("triton", **changes)
    found_TN3, found_NM3 = motion(fast, scenes, 5)
    np.testing.assert_allclose(found_TN3, expected_TN3, rtol=0, atol=5e-6)
    np.testing.assert_allclose(found_NM3, expected_NM3, rtol=0, atol=5e-6)
    still = [replace(each, moving=()) for each in scenes]
    assert abs(motion(thrown("torch", **changes), still, 5)[0] - expected_TN3).max(-1).mean() > 1e-3
    rollout = TritonStepper(fast.network, fast.start(scenes), "fp32")
    path_of(rollout, 3)
    other = fast.start([still[0], scenes[1], still[2]])
    for state in (replace(other, moving=other.moving.at([4] * 3)), fast.start(still)):
        assert rollout.take(state)
        expected = path_of(TritonStepper(fast.network, state, "fp32"), 3)
        np.testing.assert_allclose(path_of(rollout, 3), expected, rtol=0, atol=1e-6)
