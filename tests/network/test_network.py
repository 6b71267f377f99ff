"""The network: parameter counts, the literal definition, batches, frames on a CPU, obstacles."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from network.comparison import assert_same_function
from network.naive import naive_normalised_acceleration
from network.states import airborne, in_flight, network_of, random_grid, random_state, scene_of

from hgn.config import NetworkConfig
from hgn.cpu import network as cpu_network
from hgn.cpu.rows import Rows
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.obstacles import ObstacleCells
from hgn.step.reference import rested


@pytest.mark.parametrize(
    ("changes", "millions"), [({}, 3.50), ({"message_passing_steps": 2}, 1.88), ({"obstacle_features": False}, 3.50)]
)
def test_parameter_counts_are_the_papers(changes, millions):
    """3.50 million at M = 4 and 1.88 million at M = 2, width 128."""
    count = HierarchicalGraphNetwork(NetworkConfig(**changes)).parameter_count
    assert round(count / 1e6, 2) == millions


PLACES = [*([x, 0.125, 0.125] for x in (0.125, 0.25, -0.1)), [0.25, 0.125, 0.3], [0.25, 0.125, 0.3], [0.5, 0.5, 0.125]]


def on_borders():
    """Particles on cell centres, faces and one another, and outside of the domain."""
    return replace(random_state((len(PLACES),)), position_N3=torch.tensor(PLACES, dtype=torch.float64))


def fast():
    """Particles that see obstacles ahead of them, one of them far beyond two walls."""
    state = random_state((6, 3), spread=0.3)
    state.position_N3[0] = torch.tensor([-0.3, 0.1, 1.4])
    return replace(state, velocity_NM3=20 * state.velocity_NM3)


def drifting():
    """Particles in free flight, one of which is hardly slower than the others."""
    state = in_flight(airborne((5, 4)), (1e-2, 0.0, 0.0), torch.zeros(3, dtype=torch.float64))
    velocity_NH3 = state.velocity_NM3.clone()
    velocity_NH3[2, :, 0] -= 4e-6
    return replace(state, velocity_NM3=velocity_NH3)


def on_a_floor():
    """A particle within reach of a floor in a pile that reaches above the next coarsest cells."""
    state = airborne((8,))
    height_N = 0.035 * torch.tensor([0.7, 3.1, 3.3, 5.2, 6.8, 7.4, 8.6, 12.1], dtype=torch.float64)
    return replace(state, position_N3=torch.stack([0 * height_N + 0.5, height_N, 0 * height_N + 0.5], 1))


def case_of(given, changes):
    """A network, a state, and origins of its grids."""
    network = network_of(**changes)
    obstacles = changes.get("obstacle_features", True)
    state = given() if callable(given) else random_state(given, obstacles=obstacles, spread=0.12)
    generator = torch.Generator().manual_seed(1)
    random_S3 = torch.rand(state.scene_count, 3, generator=generator, dtype=torch.float64)
    return network, state, -network.config.cell_size * random_S3


@pytest.mark.parametrize(
    ("given", "changes"),
    [
        ((4, 1), {}),
        ((1,), {}),
        ((1, 5, 2), {"levels": 1}),
        ((6,), {"levels": 4, "message_passing_steps": 1, "width": 7}),
        ((8,), {"obstacle_features": False, "velocity_history": 5}),
        (on_borders, {"cell_size": 0.25, "levels": 2}),
    ],
)
def test_network_equals_the_literal_definition(given, changes):
    """Outputs and all parameter gradients equal the naive network's, in float64."""
    network, state, origin_S3 = case_of(given, changes)
    if given is on_borders:
        origin_S3 = 0 * origin_S3
    expected = naive_normalised_acceleration(network, state, origin_S3)
    assert_same_function(network, network.normalised_acceleration(state, origin_S3), expected)


@pytest.mark.parametrize(
    ("given", "changes", "expected"),
    [
        (fast, {}, 2.1235012450090185),
        (drifting, {}, -0.004471441378793817),
        (on_a_floor, {}, -0.5635802959014364),
        ((7, 2), {"levels": 2, "obstacle_features": False}, 1.1330245403184032),
        ((1, 7), {"levels": 1}, -0.8592312746167745),
        ((6, 2), {"rest_threshold": 2.0}, -0.8560388855948935),
        ((6, 2), {"levels": 1, "rest_threshold": 2.0, "materials": ("snow", "sand", "goop")}, 0.8321850628598952),
    ],
)
def test_relative_inputs_and_rest_stay_what_they_were(given, changes, expected):
    """A weighted sum of the outputs is the one that the shipped weights were trained with, in float64. It depends on
    every constant of hgn.network.relative and of rest; hgn.kernels implements their rules a second time."""
    network, state, origin_S3 = case_of(given, changes | {"inputs": "relative"})
    output_N3 = rested(network, state, network.prediction(state, origin_S3)).detach()
    weight_N3 = torch.arange(1.0, output_N3.numel() + 1, dtype=torch.float64).cos().view_as(output_N3)
    assert float((output_N3 * weight_N3).sum()) == pytest.approx(expected, rel=1e-9)


# how frames are computed: precision, its tolerance, and the rows of the CPU backend, None where there is a compiler
KINDS = [(torch.float64, 1e-12, Rows), (torch.float32, 1e-5, Rows), (torch.float32, 1e-5, None)]


def frame_on_a_cpu(network, state, origin_S3=None):
    """The CPU backend's raw output."""
    return cpu_network.prediction(network, state, origin_S3).acceleration_N3


def use_rows(monkeypatch, row_class):
    if row_class is not None:
        monkeypatch.setattr("hgn.cpu.network.rows_class", lambda *_: row_class)


@pytest.mark.parametrize("way", ["gradients", Rows, None])
def test_batch_equals_single_scenes(monkeypatch, way):
    """A batch's outputs are bitwise those of its scenes alone, of the network and of the CPU backend; gradients of the
    mean loss agree to 1e-6."""
    use_rows(monkeypatch, None if way == "gradients" else way)
    counts = (40, 7, 1, 25) if way == "gradients" else (40, 7, 1, 325)
    network = network_of(dtype=torch.float32, width=128, levels=4)
    state = random_state(counts, dtype=torch.float32, spread=0.15)
    origin = -network.config.cell_size * torch.rand(len(counts), 3)
    output_of = network.normalised_acceleration if way == "gradients" else partial(frame_on_a_cpu, network)
    with torch.inference_mode(way != "gradients"):
        together = output_of(state, origin)
        outputs = []
        for scene in range(len(counts)):
            alone = scene_of(state, scene, ObstacleCells.of([random_grid(scene, 4_000)]))
            outputs.append(output_of(alone, origin[scene : scene + 1]))
            assert torch.equal(outputs[-1], together[state.scene_N == scene]), scene
    if way == "gradients":
        loss = torch.stack([together[state.scene_N == s].square().mean() for s in range(len(counts))]).mean()
        of_scenes = torch.stack([output.square().mean() for output in outputs]).mean()
        pairs = (torch.autograd.grad(x, list(network.parameters())) for x in (loss, of_scenes))
        for found, expected in zip(*pairs, strict=True):
            assert float((found - expected).abs().max()) < 1e-6 * max(1.0, float(expected.abs().max()))


def test_second_derivatives():
    """They exist on a CPU too: their products with two directions are symmetric."""
    network, state = network_of(inputs="relative"), random_state((12,), spread=0.1)
    start_N3, directions = state.position_N3.clone().requires_grad_(), torch.randn(2, 12, 3, dtype=torch.float64)
    mean = network.normalised_acceleration(replace(state, position_N3=start_N3)).square().mean()
    (slope_N3,) = torch.autograd.grad(mean, start_N3, create_graph=True)
    bent = [torch.autograd.grad((slope_N3 * v).sum(), start_N3, retain_graph=True)[0] for v in directions]
    assert float(bent[0].norm()) > 0
    torch.testing.assert_close((bent[0] * directions[1]).sum(), (bent[1] * directions[0]).sum())


@pytest.mark.parametrize(
    ("counts", "rows", "kind", "threads", "changes"),
    [
        ((40, 1, 30), 20, KINDS[0], 2, {}),
        ((40, 1, 30), 300, KINDS[1], 3, {}),
        ((40, 1, 30), 4096, KINDS[2], 1, {"width": 128, "levels": 4}),
        ((1,), 20, KINDS[2], 3, {}),
        ((70,), 20, KINDS[2], 2, {}),
        ((40, 1, 30), 20, KINDS[1], 2, {"inputs": "relative"}),
        ((70,), 300, KINDS[2], 3, {"inputs": "relative"}),
        ((21,), 4096, KINDS[0], 1, {"message_passing_steps": 1}),
        (None, 4096, KINDS[0], 1, {"cell_size": 0.25, "levels": 2, "message_passing_steps": 1}),
    ],
)
def test_frames_on_a_cpu(monkeypatch, counts, rows, kind, threads, changes):
    """In blocks on several threads they equal the float64 output with gradients, the same every time, also of a scene
    of one cell without edges; weights that change between frames are seen."""
    dtype, tolerance, row_class = kind
    use_rows(monkeypatch, row_class)
    monkeypatch.setattr("hgn.cpu.network.ROWS_AT_ONCE", rows)
    network, state = network_of(**{"width": 48} | changes).train(), random_state(counts or (1,), spread=0.15)
    if counts is None:
        state = replace(state, position_N3=torch.full((1, 3), 0.125, dtype=torch.float64))
        levels = network.grid(state).levels
        assert all(level.cell_count == 1 and len(level.sender_E) == 0 for level in levels)
    names = ("position_N3", "velocity_NM3", "domain_S3", "gravity_S3")
    given = replace(state, **{name: getattr(state, name).to(dtype) for name in names})
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        for _ in range(2):
            expected = network.double().normalised_acceleration(state).detach()
            with torch.inference_mode():
                found, again = (frame_on_a_cpu(network.to(dtype), given) for _ in range(2))
            assert torch.get_num_threads() == threads and torch.equal(found, again)
            assert float((found.double() - expected).norm() / expected.norm()) < tolerance
            for parameter in network.parameters():
                parameter.data.mul_(1.5)
    finally:
        torch.set_num_threads(before)


def test_the_normaliser():
    """forward() returns frame units: the raw output times the standard deviation plus the mean. The noise enters the
    stored deviation in quadrature; an axis without spread stays usable."""
    network, state = network_of(dtype=torch.float32), random_state((9,), dtype=torch.float32)
    raw, normaliser = network.normalised_acceleration(state), network.normaliser
    torch.testing.assert_close(network(state), raw * normaliser.acceleration_std + normaliser.acceleration_mean)
    normaliser.set("velocity", torch.zeros(3), torch.tensor([3e-3, 0.0, 0.0]), 4e-3)
    torch.testing.assert_close(normaliser.velocity_std, torch.tensor([5e-3, 4e-3, 4e-3]))
    normaliser.set("velocity", torch.zeros(3), torch.zeros(3), 0.0)
    assert bool((normaliser.velocity_std > 0).all())
