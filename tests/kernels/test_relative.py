"""The kernels of relative inputs against hgn.network.relative: features, outputs, gradients, updates, rollouts."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from kernels.engines import engine_of, inference_of, prepare, run_forward
from kernels.test_network import compare, drawn, float32_state
from network.states import network_of

from hgn.kernels.step.op import DeviceStep
from hgn.network.cell_keys import unpack
from hgn.network.features import ParticleState
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.runtime.parity import relative_error
from hgn.step.reference import rested

pytestmark = pytest.mark.usefixtures("large_tiles")

EVERYWHERE = (17, 1, 6)  # particles of three scenes
MATERIALS = ("water", "sand", "snow")
PRECISIONS = {"fp32": 1e-5, "tf32": 2e-3, "fp16": 2e-3}


def relative_network(**changes: object) -> HierarchicalGraphNetwork:
    config = {"width": 16, "levels": 3, "message_passing_steps": 1}
    network = network_of(inputs="relative", **{**config, **changes})
    network.normaliser.velocity_std.fill_(7.0)  # which nothing depends on
    return network


def moving_state(counts: tuple[int, ...], obstacles: bool = True, spread: float = 0.3) -> ParticleState:
    """Scenes of different gravity, some of whose particles fly through several cells in a frame, out of the domain or
    lie on a cell's corner."""
    state = float32_state(counts, obstacles, spread)
    generator = torch.Generator().manual_seed(2)
    gravity_S3 = torch.randn(len(counts), 3, generator=generator) * 3e-3
    fast_N = torch.rand(len(state.position_N3), generator=generator) < 0.5
    state.velocity_NM3[fast_N] *= 32.0
    state.position_N3[0] = torch.tensor([0.0625, 0.125, -0.0009765625])
    return replace(state, gravity_S3=gravity_S3.double())


def features_of(network: HierarchicalGraphNetwork, state: ParticleState, origin_S3: torch.Tensor) -> torch.Tensor:
    """The kernels' columns, [N, FEATURES]."""
    engine = engine_of(network, state)
    prepare(engine, network, state, origin_S3)
    assert int(engine.grid.status) == 0
    return engine.grid.feature_NF[: len(state.position_N3)].cpu().double()


@pytest.mark.parametrize(
    ("counts", "obstacles", "changes"),
    [
        (EVERYWHERE, True, {}),
        (EVERYWHERE, False, {"velocity_history": 2}),
        ((1,), True, {"levels": 1}),
        ((7, 2), False, {"obstacle_features": False, "levels": 4, "materials": ("water", "snow", "sand")}),
        ((150, 9), False, {"levels": 1}),
    ],
)
def test_every_column(counts: tuple[int, ...], obstacles: bool, changes: dict) -> None:
    """Each column is that of hgn.network.relative in float64, the material one-hot behind them, and zeros behind that;
    among the particles are some within a surface's reach and some beyond."""
    network, state = relative_network(**changes), moving_state(counts, obstacles, 0.6)
    state = replace(state, velocity_NM3=state.velocity_NM3[:, : network.config.velocity_history])
    origin_S3, _ = drawn(network, state)
    found = features_of(network, state, origin_S3)
    expected = network.relative_features(state, network.grid(state, origin_S3))[0].double()
    width, materials = expected.shape[1], len(network.config.materials)
    for column in range(width):
        assert float((found[:, column] - expected[:, column]).abs().max()) < 2e-5, column
    assert torch.equal(found[:, width : width + materials].argmax(-1), state.material_N)
    assert torch.equal(found[:, width:].sum(-1), torch.ones(len(found)).double())
    contact = 3 * (network.config.velocity_history - 1) + 3 * network.config.levels
    assert len(found) == 1 or (found[:, contact].eq(0).any() and found[:, contact].ne(0).any())
    assert found.shape[1] == (32 if width + materials <= 32 else 64)


@pytest.mark.parametrize(
    ("counts", "obstacles", "levels"), [(EVERYWHERE, True, 2), ((9, 33), False, 1), ((1,), False, 2), ((40,), False, 3)]
)
def test_outputs_and_gradients(counts: tuple[int, ...], obstacles: bool, levels: int) -> None:
    """In float32 outputs and every gradient are those of the reference network in float64 to 4e-5, among walls within
    reach and beyond, with one coarsest cell a particle and with few for all: in the weights of normals the rounding of
    distances counts tenfold (FEW)."""
    network = relative_network(levels=levels)
    state = moving_state(counts, obstacles)
    output, together, each = compare(network, state, "fp32", 1.0, 512)
    assert max(output, together, *each) < 4e-5


def rested_on_device(
    network: HierarchicalGraphNetwork, state: ParticleState, origin_S3: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """The kernels' output before rest and after it, [N, 3]."""
    engine = engine_of(network, state)
    particles = prepare(engine, network, state, origin_S3)
    engine.forward()
    outputs = [engine.output[: len(state.position_N3), :3].double().cpu()]
    step = DeviceStep(network.step, network.config, engine.grid, None)
    step.rest(engine.output, particles, network.normaliser.acceleration_std.float().to(engine.device))
    return outputs[0], engine.output[: len(state.position_N3), :3].double().cpu()


@pytest.mark.parametrize(
    ("counts", "obstacles", "levels", "materials"),
    [
        (EVERYWHERE, True, 2, MATERIALS),
        ((1,), False, 2, MATERIALS),
        ((40,), False, 3, ("sand", "snow", "water")),
        ((9, 33), True, 1, ("sand", "snow", "goop")),
    ],
)
def test_rest(counts, obstacles, levels, materials):
    """Outputs with deformations that are slow, nearly so, and fast, to 1e-3: of cells that hold few
    particles the rounding of inertia counts, between cells of two sizes twice (PyTorch in float32: 2e-3). What rest
    changes is more, and keeps momenta."""
    network = relative_network(levels=levels, materials=materials, rest_threshold=1.0)
    state = moving_state(counts, obstacles, 0.1)
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


@pytest.mark.parametrize("precision", list(PRECISIONS))
@pytest.mark.parametrize("counts", [(70, 23, 1), (30,)])
def test_momentum_is_kept_where_nothing_touches(counts: tuple[int, ...], precision: str) -> None:
    """Away from surfaces what inference adds to gravity sums to 0 in each scene, to float32's rounding; and so do its
    moments."""
    network = relative_network(levels=2)
    state = moving_state(counts, obstacles=False)
    state = replace(state, position_N3=state.position_N3 + 0.4, velocity_NM3=state.velocity_NM3.clamp(-5e-3, 5e-3))
    origin_S3, _ = drawn(network, state)
    engine = inference_of(engine_of(network, state, precision), network)
    output_N3 = run_forward(engine, network, state, origin_S3).double()
    assert float(output_N3[state.scene_N == 0].abs().max()) > 1e-2
    for scene in range(len(counts)):
        mine_N3 = output_N3[state.scene_N == scene]
        moment_N3 = torch.linalg.cross(state.position_N3[state.scene_N == scene] - 0.55, mine_N3)
        for kept_N3 in (mine_N3, moment_N3):
            assert float(kept_N3.sum(0).abs().max()) < 1e-5 * float(mine_N3.abs().sum()) + 1e-7


def test_what_flies_in_one_piece() -> None:
    """How disturbed coarsest cells are: not at all in free flight, in part where a neighbour hardly moves, whole in
    other scenes; and outputs and gradients with it."""
    network, state = relative_network(levels=2), moving_state((30, 30, 30), obstacles=False, spread=0.15)
    velocity_NH3, gravity_N3 = state.velocity_NM3.clone(), state.gravity_S3[state.scene_N]
    age_1H1 = torch.arange(velocity_NH3.shape[1], dtype=torch.float64)[None, :, None]
    quiet_N = state.scene_N < 2
    velocity_NH3[quiet_N] = (torch.tensor([1e-2, 2e-2, 0.0]) - age_1H1 * gravity_N3[:, None])[quiet_N]
    velocity_NH3[35, 0] += 2e-3 * float(network.normaliser.acceleration_std[0])
    state = replace(state, position_N3=state.position_N3 + 0.4, velocity_NM3=velocity_NH3)
    origin_S3, _ = drawn(network, state)
    grid = network.grid(state, origin_S3)
    contacts = network.relative_features(state, grid)[1]
    expected_C2 = torch.stack([contacts.disturbed_C, contacts.touched_C], 1)
    scene_C = unpack(grid.levels[-1].key_C)[0]
    most = [float(expected_C2[scene_C == scene, 0].max()) for scene in range(3)]
    assert most[0] < 1e-3 < most[1] < 0.5 < most[2] and not expected_C2[:, 1].any()
    engine = engine_of(network, state)
    run_forward(engine, network, state, origin_S3)
    found_C2 = engine.grid.felt_C2[: len(expected_C2)].cpu().double()
    torch.testing.assert_close(found_C2, expected_C2, rtol=0, atol=1e-3)
    output, together, each = compare(network, state, "fp32", 1.0, 512)
    assert max(output, together, *each) < 2e-4


@pytest.mark.parametrize("precision", list(PRECISIONS))
def test_a_boost_changes_nothing(precision: str) -> None:
    """Away from surfaces 3 m/s more for all, in any direction, and another gravity in free flight, leave the output of
    inference as it was to the rounding of velocities in float32."""
    network = relative_network()
    state = moving_state((23, 5), obstacles=False, spread=0.1)
    state = replace(state, position_N3=state.position_N3 + 0.4, velocity_NM3=state.velocity_NM3.clamp(-5e-3, 5e-3))
    origin_S3, _ = drawn(network, state)
    engine = inference_of(engine_of(network, state, precision), network)
    outputs = []
    for boost in ((0.0, 0.0, 0.0), (5e-2, 0.0, 0.0), (-1e-2, 3e-2, 2e-2)):
        faster = replace(state, velocity_NM3=state.velocity_NM3 + torch.tensor(boost, dtype=torch.float64))
        outputs.append(run_forward(engine, network, faster, origin_S3).clone())
    assert float(outputs[0].norm()) > 0
    for output in outputs[1:]:
        assert relative_error(output, outputs[0]) < {"fp32": 1e-4, "tf32": 2e-3, "fp16": 2e-3}[precision]
