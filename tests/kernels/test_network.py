"""The kernels' network against the plain one in float64: outputs and all gradients."""

from dataclasses import replace

import pytest
import torch
from kernels.engines import device, engine_of, gradients, inference_of, run_forward
from kernels.rounded import rounded, rounding
from network.states import network_of, random_state

from hgn.kernels.packing import rounded_to_tf32
from hgn.runtime.parity import OUTPUT_BOUND, relative_error

SEVERAL = (5, 1, 3)  # particles of three scenes
gpu = pytest.mark.skipif(device().type != "cuda", reason="needs a CUDA device")


def reference(network, state, origin_S3, weight_N3):
    """Output and gradients of the sum of outputs times `weight_N3`."""
    output = network.normalised_acceleration(state, origin_S3)
    found = torch.autograd.grad((output * weight_N3).sum(), list(network.parameters()), allow_unused=True)
    pairs = zip(network.parameters(), found, strict=True)
    return output.detach(), [torch.zeros_like(p) if gradient is None else gradient for p, gradient in pairs]


def flat(tensors):
    return torch.cat([tensor.double().cpu().flatten() for tensor in tensors])


def float32_state(counts, obstacles=True, spread=0.3, seed=3):
    """A state whose numbers float32 holds exactly, in float64."""
    state = random_state(counts, seed, torch.float32, obstacles, spread)
    doubled = {name: getattr(state, name).double() for name in ("position_N3", "velocity_NM3", "domain_S3")}
    return replace(state, **doubled)


def drawn(network, state):
    """Origins of the scenes' grids, and weights of the outputs."""
    generator = torch.Generator().manual_seed(1)
    origin_S3 = (-network.config.cell_size * torch.rand(state.scene_count, 3, generator=generator)).double()
    return origin_S3, torch.randn(state.position_N3.shape, generator=generator, dtype=torch.float64)


def compare(network, state, precision, loss_scale, room):
    """Relative errors of the output, of all gradients together, of each gradient."""
    origin_S3, weight_N3 = drawn(network, state)
    output, expected = reference(network, state, origin_S3, weight_N3)
    engine = engine_of(network, state, precision, (room,) * network.config.levels, loss_scale=loss_scale)
    found = run_forward(engine, network, state, origin_S3)
    assert int(engine.grid.status) == 0
    engine.output_gradient[: len(weight_N3), :3] = (loss_scale * weight_N3).float()
    engine.backward()
    each = gradients(engine, network)
    pairs = zip(each, expected, strict=True)
    return (
        relative_error(found, output),
        relative_error(flat(each), flat(expected)),
        [relative_error(a, b) for a, b in pairs],
    )


@pytest.mark.parametrize(
    ("counts", "spread", "changes"),
    [
        (SEVERAL, 0.2, {"levels": 2, "message_passing_steps": 2}),
        ((1,), 0.3, {"levels": 3, "message_passing_steps": 1, "obstacle_features": False}),
        ((5,), 0.1, {"levels": 1, "message_passing_steps": 1, "materials": ("water", "snow", "sand")}),
    ],
)
def test_outputs_and_gradients(counts, spread, changes, monkeypatch):
    """In float32 several scenes in one batch, a single particle, and a single level, with odd numbers of particles and
    cells, give the outputs and every gradient of the reference to 1e-5. So few programs run that each takes several
    tiles, and the last has one fewer."""
    monkeypatch.setattr("hgn.kernels.tuning.RESIDENT_PROGRAMS", 2)
    if len(counts) > 1:
        monkeypatch.setattr("hgn.kernels.tuning.PROCESSORS", 2)
        monkeypatch.setattr("hgn.kernels.tuning.FEW_ROWS", 0)  # every level is one of many rows
    network = network_of(width=16, **changes)
    state = float32_state(counts, network.config.obstacle_features, spread)
    precision = "fp32"
    output, together, each = compare(network, state, precision, 1.0, 128)
    assert output < 1e-5 and together < 1e-5 and max(each) < 2e-5


def test_half_precision_keeps_small_gradients():
    """Operands rounded to float16 change the output by less than 5e-3, and with a loss scale no gradient is lost."""
    network = network_of(width=16, levels=1, message_passing_steps=1)
    state = float32_state((5,), spread=0.1)
    weight = 2.0**-14
    output, _, _ = compare(network, state, "fp16", 1.0, 64)
    assert output < 5e-3
    origin_S3 = torch.zeros(1, 3, dtype=torch.float64)
    engine = engine_of(network, state, "fp16", (64,), loss_scale=1 / weight)
    run_forward(engine, network, state, origin_S3)
    engine.output_gradient[:5, :3] = 1.0
    engine.backward()
    _, expected = reference(network, state, origin_S3, torch.full((5, 3), weight, dtype=torch.float64))
    assert relative_error(flat(gradients(engine, network)), flat(expected)) < 5e-2


@pytest.mark.parametrize(
    ("precision", "half_cells", "half_sums", "few_rows"),
    [("tf32", False, False, None), ("fp16", False, False, None), ("fp16", True, False, 0), ("fp16", True, True, 0)],
)
def test_inference_alone(precision, half_cells, half_sums, few_rows, monkeypatch):
    """Where nothing is kept for gradients, operands of TF32 and float16 change the output by less than 5e-3, also with
    the cells in float16 between kernels and so summed, and with the kernels for many rows."""
    if few_rows is not None:
        monkeypatch.setattr("hgn.kernels.tuning.FEW_ROWS", few_rows)
    network = network_of(width=16, levels=1, message_passing_steps=2)
    state = float32_state((5, 2), spread=0.1)
    origin_S3 = torch.zeros(2, 3, dtype=torch.float64)
    engine = inference_of(engine_of(network, state, precision, (64,)), network, half_cells, half_sums)
    found = run_forward(engine, network, state, origin_S3)
    assert relative_error(found, network.normalised_acceleration(state, origin_S3).detach()) < 5e-3


def test_cells_on_the_border_of_the_grid():
    """Particles exactly at cell centres and cell faces activate the cells that the plain grid activates."""
    network = network_of(width=16, levels=2, message_passing_steps=1, cell_size=0.0625)
    state = float32_state((4,), spread=0.2)
    position = torch.tensor([[0.0, 0.0, 0.0], [0.03125, 0.09375, 0.0625], [0.125, 0.125, 0.125], [0.28125, 0.25, 0.0]])
    state = replace(state, position_N3=position.double())
    origin_S3 = torch.zeros(1, 3, dtype=torch.float64)
    engine = engine_of(network, state, "fp32", (64, 32))
    found = run_forward(engine, network, state, origin_S3)
    assert relative_error(found, network.normalised_acceleration(state, origin_S3).detach()) < 1e-5


def test_without_obstacles_nothing_is_looked_up():
    """A network with obstacle features gives in a scene without obstacles exactly what it gives when all normals are
    looked up and none is found."""
    network = network_of(width=16, levels=1, message_passing_steps=1)
    state = float32_state((6,), spread=0.1)
    assert state.obstacles is not None
    far = replace(state.obstacles, key_K=state.obstacles.key_K[:1] * 0, normal_K3=state.obstacles.normal_K3[:1])
    origin_S3 = torch.zeros(1, 3, dtype=torch.float64)
    outputs = []
    for obstacles in (None, far):
        engine = engine_of(network, state, "fp32" if device().type == "cpu" else "tf32", (64,))
        outputs.append(run_forward(engine, network, replace(state, obstacles=obstacles), origin_S3).clone())
    assert torch.equal(*outputs)


def test_rounded_reference():
    """What the reference for rounded operands rounds to are TF32's numbers and float16's, halves aside; a network's
    output and gradients then move by as much as such operands move them, not by nothing and not by far more."""
    x = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(rounded(x.double()), rounded_to_tf32(x).double(), rtol=0, atol=0)
    torch.testing.assert_close(rounded(x.double()), x.half().double(), rtol=0, atol=2.0**-14)
    network = network_of(width=16, levels=2, message_passing_steps=1)
    state = float32_state((5,), spread=0.1)
    for stored in (False, True):
        output, together = rounding_errors(network, state, stored)
        assert 1e-5 < output < 5e-3 and 1e-5 < together < 5e-2


@gpu
@pytest.mark.gpu
@pytest.mark.parametrize(
    ("precision", "counts", "draws"), [("tf32", (300, 131, 77), 5), ("fp16", (300, 131, 77), 5), ("tf32", (1,), 9)]
)
def test_whole_networks_on_a_gpu(precision, counts, draws):
    """With all levels and steps, in TF32 and float16, the median error of several states is at most 1.5 times that of
    the reference in float64 with operands so rounded (and what float16 keeps rounded): that is what rounding does,
    most of it by activations next to their kink, and how much is chance for each state."""
    network = network_of(width=128, levels=4, message_passing_steps=4)
    found, explained = [], []
    for seed in range(3, 3 + draws):
        state = float32_state(counts, seed=seed)
        output, together, _ = compare(network, state, precision, 256.0 if precision == "fp16" else 1.0, 8192)
        origin_S3, _ = drawn(network, state)
        engine = inference_of(engine_of(network, state, precision, (8192,) * 4), network)
        alone = run_forward(engine, network, state, origin_S3)
        expected = network.normalised_acceleration(state, origin_S3).detach()
        found.append((output, relative_error(alone, expected), together))
        rounded_output, rounded_together = rounding_errors(network, state, precision == "fp16")
        explained.append((rounded_output, rounded_output, rounded_together))
    assert all(output < OUTPUT_BOUND and alone < OUTPUT_BOUND for output, alone, _ in found)
    middle = torch.tensor(found).median(0).values
    bounds = 1.5 * torch.tensor(explained).median(0).values
    assert (middle < bounds).all(), (middle, bounds)


def rounding_errors(network, state, stored):
    """Relative errors of output and gradients that rounded operands make in the reference network."""
    origin_S3, weight_N3 = drawn(network, state)
    output, expected = reference(network, state, origin_S3, weight_N3)
    with rounding(stored):
        near, found = reference(network, state, origin_S3, weight_N3)
    return relative_error(near, output), relative_error(flat(found), flat(expected))
