"""The network: parameter counts, the literal definition, batches, translation, obstacles."""

from __future__ import annotations

import functools
from dataclasses import replace

import pytest
import torch
from network.comparison import assert_same_function
from network.naive import naive_normalised_acceleration
from network.states import network_of, random_grid, random_state, scene_of

from hgn.config import NetworkConfig
from hgn.cpu.rows import Rows
from hgn.network.features import wall_distances
from hgn.network.grid import build_hierarchy
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.network.mlp import MLP
from hgn.network.obstacles import ObstacleCells
from hgn.step.reference import rested


@pytest.mark.parametrize(
    ("changes", "millions"), [({}, 3.50), ({"message_passing_steps": 2}, 1.88), ({"obstacle_features": False}, 3.50)]
)
def test_parameter_counts_are_the_papers(changes, millions):
    """3.50 million at M = 4 and 1.88 million at M = 2, width 128."""
    count = HierarchicalGraphNetwork(NetworkConfig(**changes)).parameter_count
    assert round(count / 1e6, 2) == millions


def test_fcn_halves_equal_the_definition():
    """Projecting parts where they live and summing equals the MLP of the concatenation."""
    torch.manual_seed(0)
    network = MLP((5, 3, 2), 8, 4).double()
    parts = [torch.randn(7, width, dtype=torch.float64) for width in network.parts]
    hidden = sum(network.project(i, part) for i, part in enumerate(parts)) + network.first.bias
    torch.testing.assert_close(network.finish(hidden), network(*parts), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("counts", "changes"),
    [
        ((12, 5), {}),
        ((1,), {}),
        ((1, 17, 3), {"levels": 1}),
        ((12,), {"levels": 4, "message_passing_steps": 1, "width": 7}),
        ((15,), {"obstacle_features": False, "velocity_history": 5}),
        ((9, 4), {"inputs": "relative"}),
        ((14, 4), {"inputs": "relative", "levels": 2, "obstacle_features": False}),
        ((1, 12), {"inputs": "relative", "levels": 1}),
        ((14, 4), {"inputs": "relative", "rest_threshold": 2.0}),
        ((14, 4), {"inputs": "relative", "levels": 1, "rest_threshold": 2.0}),
        ((14, 4), {"inputs": "relative", "levels": 1, "rest_threshold": 2.0, "materials": ("snow", "sand", "goop")}),
    ],
)
def test_network_equals_the_literal_definition(counts, changes):
    """Outputs and all parameter gradients equal the naive network's, in float64."""
    network = network_of(**changes)
    state = random_state(counts, obstacles=changes.get("obstacle_features", True))
    origin = -network.config.cell_size * torch.rand(len(counts), 3, dtype=torch.float64)
    expected = naive_normalised_acceleration(network, state, origin)
    assert_same_function(network, rested(network, state, network.prediction(state, origin)), expected)


def test_particles_on_centres_and_faces():
    """Particles exactly on cell centres, faces and one another obey the definition too."""
    network = network_of(cell_size=0.25, levels=2)
    state = random_state((5,), obstacles=False)
    places = [[0.125, 0.125, 0.125], [0.25, 0.25, 0.25], [0.25, 0.125, 0.3], [0.25, 0.125, 0.3], [0.5, 0.5, 0.125]]
    state = replace(state, position_N3=torch.tensor(places, dtype=torch.float64))
    origin = torch.zeros(1, 3, dtype=torch.float64)
    expected = naive_normalised_acceleration(network, state, origin)
    torch.testing.assert_close(network.normalised_acceleration(state, origin), expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("spread", "changes"), [(0.3, {}), (0.05, {"width": 128, "levels": 4})])
def test_batch_equals_single_scenes(spread, changes):
    """A batch's outputs are bitwise those of its scenes alone; gradients of the mean loss agree to 1e-6."""
    counts = (40, 7, 1, 25)
    network = network_of(dtype=torch.float32, **changes)
    state = random_state(counts, dtype=torch.float32, spread=spread)
    origin = -network.config.cell_size * torch.rand(len(counts), 3)
    together = network.normalised_acceleration(state, origin)
    loss = torch.stack([together[state.scene_N == s].square().mean() for s in range(len(counts))]).mean()
    batch_gradients = torch.autograd.grad(loss, list(network.parameters()))
    total = [torch.zeros_like(parameter) for parameter in network.parameters()]
    for scene in range(len(counts)):
        alone = scene_of(state, scene, ObstacleCells.of([random_grid(scene, 4_000)]))
        output = network.normalised_acceleration(alone, origin[scene : scene + 1])
        assert torch.equal(output, together[state.scene_N == scene]), scene
        gradients = torch.autograd.grad(output.square().mean(), list(network.parameters()))
        total = [a + b / len(counts) for a, b in zip(total, gradients, strict=True)]
    for found, expected in zip(batch_gradients, total, strict=True):
        scale = max(1.0, float(expected.abs().max()))
        assert float((found - expected).abs().max()) / scale < 1e-6


KINDS = [(torch.float64, 1e-12, Rows), (torch.float32, 1e-5, Rows), (torch.float32, 1e-5, None)]
# two squares of Latin letters: each two of counts, rows, kind and threads meet
BLOCKS = [
    (counts, rows, KINDS[(i + j) % 3], 1 + (i + 2 * j) % 3, "absolute")
    for i, counts in enumerate([(70, 1, 30), (1,), (150,)])
    for j, rows in enumerate([20, 300, 4096])
]


@functools.cache
def output_with_gradients(counts: tuple[int, ...], inputs: str) -> torch.Tensor:
    network = network_of(width=128, levels=4, inputs=inputs).train()
    return network.normalised_acceleration(random_state(counts, spread=0.15)).detach()


@pytest.mark.parametrize(
    ("counts", "rows", "kind", "threads", "inputs"), [*BLOCKS, *((*case[:3], 2, "relative") for case in BLOCKS[:3])]
)
def test_blocks_change_nothing(monkeypatch, counts, rows, kind, threads, inputs):
    """Frames on a CPU, in blocks on several threads, equal the float64 output with gradients, the same every time."""
    dtype, tolerance, row_class = kind
    network = network_of(width=128, levels=4, inputs=inputs).train()
    state = random_state(counts, spread=0.15)
    expected = output_with_gradients(counts, inputs)
    monkeypatch.setattr("hgn.cpu.network.ROWS_AT_ONCE", rows)
    if row_class is not None:  # none: compiled, where there is a compiler
        monkeypatch.setattr("hgn.cpu.network.rows_class", lambda *_: row_class)
    state = replace(state, position_N3=state.position_N3.to(dtype), velocity_NM3=state.velocity_NM3.to(dtype))
    state = replace(state, domain_S3=state.domain_S3.to(dtype), gravity_S3=state.gravity_S3.to(dtype))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.inference_mode():
            found = network.to(dtype).normalised_acceleration(state)
            again = network.normalised_acceleration(state)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert float((found.double() - expected).norm() / expected.norm()) < tolerance
    assert torch.equal(found, again)


@pytest.mark.parametrize("steps", [1, 2])
@pytest.mark.parametrize("lone", [False, True])
def test_frames_without_earlier_steps_or_edges(steps, lone):
    """One step of message passing and a scene of one cell without edges equal the output with gradients; weights that
    change between frames are seen."""
    network = network_of(cell_size=0.25, levels=2, message_passing_steps=steps)
    state = random_state((1,) if lone else (21,), obstacles=False)
    if lone:
        state = replace(state, position_N3=torch.full((1, 3), 0.125, dtype=torch.float64))
        grid = build_hierarchy(state.position_N3, state.scene_N, torch.zeros(1, 3), 0.25, 2)
        assert all(level.cell_count == 1 and len(level.sender_E) == 0 for level in grid.levels)
    for _ in range(2):
        expected = network.normalised_acceleration(state).detach()
        with torch.no_grad():
            torch.testing.assert_close(network.normalised_acceleration(state), expected, rtol=1e-12, atol=1e-12)
            for parameter in network.parameters():
                parameter.data.mul_(1.5)


@pytest.mark.parametrize("kind", [Rows, None])
def test_frames_of_batches_equal_single_scenes(monkeypatch, kind):
    """What shares a batch with a scene, and with it the blocks, changes no bit of a frame's output on a CPU."""
    if kind is not None:  # none: compiled, where there is a compiler
        monkeypatch.setattr("hgn.cpu.network.rows_class", lambda *_: kind)
    counts = (40, 7, 1, 325)
    network = network_of(dtype=torch.float32, width=128, levels=4)
    state = random_state(counts, dtype=torch.float32, spread=0.2)
    with torch.inference_mode():
        together = network.normalised_acceleration(state)
        for scene in range(len(counts)):
            alone = scene_of(state, scene, ObstacleCells.of([random_grid(scene, 4_000)]))
            assert torch.equal(network.normalised_acceleration(alone), together[state.scene_N == scene]), scene


def test_translation_by_coarsest_cells_changes_nothing():
    """Moving particles by whole coarsest cells, latent features held fixed, leaves every output bitwise as it was."""
    network = network_of(cell_size=1 / 32, levels=4)
    state = random_state((60,), obstacles=False, spread=0.5)
    # Multiples of 2^-20, so that the shifted positions are exact.
    position = torch.round(state.position_N3 * 2**20) / 2**20
    origin = torch.zeros(1, 3, dtype=torch.float64)
    latent = network.encode_particles(state)
    shift = torch.tensor([3, -5, 2]) * 8 / 32
    outputs = [
        network.propagate(latent, build_hierarchy(p, state.scene_N, origin, 1 / 32, 4))
        for p in (position, position + shift)
    ]
    assert torch.equal(*outputs)


def test_scene_without_obstacles_equals_zero_normals():
    """Leaving the normal columns out is exact: normals given as zeros change nothing, bitwise."""
    network = network_of()
    state = random_state((30,), obstacles=False)
    far = random_grid(0, 50)
    far = ObstacleCells.of([replace(far, cell_K3=far.cell_K3 + 1000, normal_K3=far.normal_K3)])
    assert far is not None and not far.normals(state.position_N3, state.scene_N).any()
    assert torch.equal(network(state), network(replace(state, obstacles=far)))


def test_obstacles_matter():
    """A network with obstacle features feels them."""
    network = network_of()
    state = random_state((30,))
    assert not torch.equal(network(state), network(replace(state, obstacles=None)))


def test_obstacle_lookup():
    """A particle gets the normal of its own cell in its own scene, and zero elsewhere."""
    grid = random_grid(1, 30)
    empty = replace(grid, cell_K3=grid.cell_K3[:0], normal_K3=grid.normal_K3[:0])
    cells = ObstacleCells.of([empty, grid])
    assert cells is not None
    centre = torch.from_numpy((grid.cell_K3 + 0.5) * grid.cell_size)
    scene = torch.ones(len(centre), dtype=torch.long)
    assert torch.equal(cells.normals(centre, scene), torch.from_numpy(grid.normal_K3).double())
    assert not cells.normals(centre, torch.zeros_like(scene)).any()
    assert ObstacleCells.of([empty, empty]) is None


def test_wall_distances():
    """Distances to the six planes are clamped to d_max and divided by it, negative outside."""
    position = torch.tensor([[0.07, 0.5, -0.035]])
    found = wall_distances(position, torch.ones(1, 3), 0.28)
    torch.testing.assert_close(found, torch.tensor([[0.25, 1.0, -0.125, 1.0, 1.0, 1.0]]))


def test_acceleration_is_denormalised():
    """forward() returns frame units: the raw output times the standard deviation plus the mean."""
    network = network_of()
    state = random_state((9,))
    raw = network.normalised_acceleration(state)
    expected = raw * network.normaliser.acceleration_std + network.normaliser.acceleration_mean
    torch.testing.assert_close(network(state), expected)


def test_noise_enters_the_normaliser_in_quadrature():
    """The stored standard deviation is the root of the sum of squares; an axis without spread stays usable."""
    network = network_of(dtype=torch.float32)
    network.normaliser.set("velocity", torch.zeros(3), torch.tensor([3e-3, 0.0, 0.0]), 4e-3)
    torch.testing.assert_close(network.normaliser.velocity_std, torch.tensor([5e-3, 4e-3, 4e-3]))
    network.normaliser.set("velocity", torch.zeros(3), torch.zeros(3), 0.0)
    assert bool((network.normaliser.velocity_std > 0).all())
