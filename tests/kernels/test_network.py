"""The kernels' network against the plain one in float64: outputs and all gradients."""

from dataclasses import replace

import pytest
import torch
from kernels.cases import CASES, CROWD, Case, compare, drawn, flat, float32_state, moving_state, reference, rough_state
from kernels.conftest import use_large_tiles
from kernels.engines import device, engine_of, gradients, inference_of, run_forward
from network.states import network_of

from hgn.network.cell_keys import unpack
from hgn.network.own_physics import physics_columns, physics_widths
from hgn.runtime.parity import OUTPUTS, relative_error

gpu = pytest.mark.skipif(device().type != "cuda", reason="needs a CUDA device")


@pytest.mark.parametrize("name", CASES)
def test_outputs_and_gradients(name, monkeypatch):
    """In float32 outputs, every gradient and every feature are those of the reference network in float64: absolute and
    relative inputs, several scenes of odd numbers of particles, one particle, particles on borders."""
    case = CASES[name]
    monkeypatch.setattr("hgn.kernels.tuning.RESIDENT_PROGRAMS", 2)
    if case.many_rows:
        monkeypatch.setattr("hgn.kernels.tuning.PROCESSORS", 2)
        monkeypatch.setattr("hgn.kernels.tuning.FEW_ROWS", 0)
    else:
        use_large_tiles(monkeypatch)
    network, state = case.network(), case.state()
    state = replace(state, velocity_NM3=state.velocity_NM3[:, : network.config.velocity_history])
    found = compare(network, state, "fp32", 1.0, 512 if network.config.relative else 128)
    assert max(found.output, found.together, *found.each) < case.bound, (found.output, found.together, found.each)
    if network.config.relative:
        assert_features(network, state, found)


def assert_features(network, state, found):
    """Each column is that of hgn.network.relative, behind them the material one-hot, columns of own physics, and zeros;
    and coarsest cells are disturbed and in contact as there."""
    grid = network.grid(state, found.origin_S3)
    expected, contacts = network.relative_features(state, grid)
    feature_NF = found.engine.grid.feature_NF[: len(state.position_N3)].cpu().double()
    width, materials = expected.shape[1], len(network.config.materials)
    assert float((feature_NF[:, :width] - expected.double()).abs().max()) < 2e-5
    assert torch.equal(feature_NF[:, width : width + materials].argmax(-1), state.material_N)
    own = width + materials
    assert torch.equal(feature_NF[:, width:own].sum(-1), torch.ones(len(feature_NF)).double())
    for physics_NK in physics_columns(state, network.config, contacts.friction, network.normaliser.acceleration_std[0]):
        assert float((feature_NF[:, own : own + physics_NK.shape[1]] - physics_NK).abs().max()) < 2e-5
        own += physics_NK.shape[1]
    assert not feature_NF[:, own:].any()
    assert feature_NF.shape[1] == (32 if width + materials + sum(physics_widths(network.config)) <= 32 else 64)
    expected_C2 = torch.stack([contacts.disturbed_C, contacts.contact_C], 1)
    # Cells that bodies divide have other numbers there.
    coarsest_N8 = found.engine.grid.coarsest_N8[: len(state.position_N3)].cpu().long()
    listed_N8 = coarsest_N8 >= 0
    most_C2, cell_K = (
        found.engine.grid.spread_C2.cpu().double(),
        grid.coarsest.centre_G8[grid.groups.group_N][listed_N8],
    )
    torch.testing.assert_close(most_C2[coarsest_N8[listed_N8]], expected_C2[cell_K], rtol=0, atol=1e-3)
    assert len(cell_K.unique()) == len(expected_C2)


def test_without_friction_no_bit_changes():
    """In a scene without friction and parameters a network with these inputs computes what it does without them: with
    the kernels of other networks, and with those of friction of 0; on a GPU to the order of sums."""
    state, network, outputs = moving_state(CROWD), CASES["friction and parameters"].network(), []
    origin_S3, zero = drawn(network, state)[0], rough_state(CROWD, 0.0, 0.0)
    bare = Case(lambda: state, 0.0, {"inputs": "local"}).network()
    values = network.state_dict()
    values["encode.first.weight"] = values["encode.first.weight"][:, : bare.config.feature_width]
    bare.load_state_dict(values)
    for same, shown in ((bare, state), (network, state), (network, replace(zero, parameter_NP=0 * zero.parameter_NP))):
        outputs.append(run_forward(engine_of(same, shown), same, shown, origin_S3))
    for found in outputs[1:]:
        assert relative_error(found, outputs[0]) < 1e-5 if device().type == "cuda" else torch.equal(found, outputs[0])


def test_cases_are_what_they_say():
    """Some particles are in contact with a wall and some are not; of the three scenes in free flight one is not
    disturbed, one in part and one wholly."""
    network, state = CASES["relative, four levels"].network(), CASES["relative, four levels"].state()
    columns = network.relative_features(state, network.grid(state, drawn(network, state)[0]))[0]
    contact = columns[:, 3 * (network.config.velocity_history - 1) + 3 * network.config.levels]
    assert contact.eq(0).any() and contact.ne(0).any()
    network, state = CASES["relative, free flight"].network(), CASES["relative, free flight"].state()
    grid = network.grid(state, drawn(network, state)[0])
    contacts = network.relative_features(state, grid)[1]
    scene_C = unpack(grid.levels[-1].key_C)[0]
    most = [float(contacts.disturbed_C[scene_C == scene].max()) for scene in range(3)]
    assert most[0] < 1e-3 < most[1] < 0.5 < most[2] and not contacts.contact_C.any()


@pytest.mark.parametrize("precision", ["fp32", "fp16"] if device().type == "cpu" else ["fp32", "tf32", "fp16"])
@pytest.mark.usefixtures("large_tiles")
def test_free_motion_is_exact(precision):
    """Away from surfaces the accelerations minus gravity conserve momentum and angular momentum of each scene up to the
    rounding of float32. A common velocity of 3 m/s changes them only by the rounding of velocities."""
    network = CASES["relative"].network()
    state = moving_state((9, 3), obstacles=False, spread=0.06)
    state = replace(state, position_N3=state.position_N3 + 0.4, velocity_NM3=state.velocity_NM3.clamp(-5e-3, 5e-3))
    origin_S3, _ = drawn(network, state)
    engine = inference_of(engine_of(network, state, precision), network)
    outputs = []
    for boost in ((0.0, 0.0, 0.0), (5e-2, -3e-2, 2e-2)):
        faster = replace(state, velocity_NM3=state.velocity_NM3 + torch.tensor(boost, dtype=torch.float64))
        outputs.append(run_forward(engine, network, faster, origin_S3).double())
    assert float(outputs[0].abs().max()) > 1e-2
    assert relative_error(outputs[1], outputs[0]) < {"fp32": 1e-4, "tf32": 2e-3, "fp16": 2e-3}[precision]
    for scene in range(2):
        here_N = state.scene_N == scene
        for kept_N3 in (outputs[0], torch.linalg.cross(state.position_N3 - 0.55, outputs[0])):
            assert float(kept_N3[here_N].sum(0).abs().max()) < 1e-5 * float(outputs[0][here_N].abs().sum()) + 1e-7


def test_half_precision_keeps_small_gradients():
    """Operands rounded to float16 change the output by less than 5e-3, and with a loss scale no gradient is lost."""
    network = network_of(width=16, levels=1, message_passing_steps=1)
    state = float32_state((5,), spread=0.1)
    weight = 2.0**-14
    assert compare(network, state, "fp16", 1.0, 64).output < 5e-3
    origin_S3 = torch.zeros(1, 3, dtype=torch.float64)
    engine = engine_of(network, state, "fp16", (64,), loss_scale=1 / weight)
    run_forward(engine, network, state, origin_S3)
    engine.output_gradient[:5, :3] = 1.0
    engine.backward()
    _, expected = reference(network, state, origin_S3, torch.full((5, 3), weight, dtype=torch.float64))
    assert relative_error(flat(gradients(engine, network)), flat(expected)) < 5e-2


@gpu
@pytest.mark.gpu
@pytest.mark.parametrize(("precision", "counts"), [("tf32", (300, 131, 77)), ("fp16", (300, 131, 77)), ("tf32", (1,))])
def test_whole_networks_on_a_gpu(precision, counts):
    """With all levels and steps, in TF32 and float16, outputs are within the bound of a start on backend triton, in
    training and in inference; test_kernels_alone has the bounds of each gradient."""
    network, state = network_of(width=128, levels=4, message_passing_steps=4), float32_state(counts)
    compared = compare(network, state, precision, 256.0 if precision == "fp16" else 1.0, 8192)
    origin_S3, _ = drawn(network, state)
    engine = inference_of(engine_of(network, state, precision, (8192,) * 4), network)
    alone = run_forward(engine, network, state, origin_S3)
    expected = network.normalised_acceleration(state, origin_S3).detach()
    assert max(compared.output, relative_error(alone, expected)) < OUTPUTS.bound
