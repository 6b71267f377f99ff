"""Rest on the device against hgn.step.reference; the network's outputs and gradients are in test_network."""

from dataclasses import replace

import pytest
import torch
from kernels.cases import RELATIVE, Case, drawn, moving_state
from kernels.engines import engine_of, prepare

from hgn.kernels.step.op import DeviceStep
from hgn.runtime.parity import relative_error
from hgn.step.reference import rested

pytestmark = pytest.mark.usefixtures("large_tiles")


def rested_on_device(network, state, origin_S3):
    """The kernels' output before rest and after it, [N, 3]."""
    engine = engine_of(network, state)
    particles = prepare(engine, network, state, origin_S3)
    engine.forward()
    free_N3 = engine.output[: len(state.position_N3), :3].double().cpu()
    step = DeviceStep(network.step, engine.grid, None, 0.0)
    step.rest(engine.output, particles, network.normaliser.acceleration_std.float().to(engine.device))
    return free_N3, engine.output[: len(state.position_N3), :3].double().cpu()


@pytest.mark.parametrize(
    ("counts", "obstacles", "changes"),
    [
        ((9, 1, 5), True, {"levels": 2}),
        ((1,), False, {"levels": 2}),
        ((30,), False, {"levels": 3, "materials": ("sand", "snow", "water")}),
        ((2, 6), True, {"levels": 1, "materials": ("sand", "snow", "goop")}),
    ],
)
def test_rest(counts, obstacles, changes):
    """Outputs with deformations that are slow, nearly so, and fast, to 1e-3: in cells with few particles the rounding
    of inertia counts, between cells of two sizes twice (PyTorch in float32: 2e-3). Rest changes more, and keeps
    momenta."""
    state = moving_state(counts, obstacles, 0.1)
    network = Case(lambda: state, 1e-3, RELATIVE | changes | {"rest_threshold": 1.0}).network()
    state = replace(state, velocity_NM3=state.velocity_NM3.clamp(-2e-3, 2e-3))
    origin_S3, _ = drawn(network, state)
    free_N3, found_N3 = rested_on_device(network, state, origin_S3)
    change_N3 = found_N3 - free_N3
    assert (float(change_N3.abs().max()) > 0.1) == (len(change_N3) > 1)
    for kept_N3 in (change_N3, torch.linalg.cross(state.position_N3, change_N3)):
        for scene in range(len(counts)):
            assert float(kept_N3[state.scene_N == scene].sum(0).abs().max()) < 1e-5 * float(free_N3.abs().sum())
    expected_N3 = rested(network, state, network.prediction(state, origin_S3))
    assert relative_error(found_N3, expected_N3.detach()) < 1e-3
