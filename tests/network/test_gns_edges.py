"""GNS's own gradients by its edges, near float64's in fp16, whatever their size; test_gns.py has them in float64."""

import pytest
import torch
from network.states import gns_of, random_state

from hgn.network.gns_edges import PlainEdges
from hgn.runtime.parity import relative_error


def output_and_gradients(network, edges, state, weight):
    """The network's output, and the gradients of all parameters of a random weighting of it, divided by `weight`."""
    output = network.normalised_acceleration(state, edges=edges)
    factor = torch.randn(output.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(output)
    parameters = list(network.parameters())
    found = torch.autograd.grad((output * factor * weight).sum(), parameters, allow_unused=True)
    flat = [torch.zeros_like(p).flatten() if g is None else g.flatten() for p, g in zip(parameters, found, strict=True)]
    return output.detach().double(), torch.cat(flat).double() / weight


@pytest.mark.parametrize("weight", [1e-9, 1.0, 1e5])
def test_half_precision_is_near_whatever_the_gradients_size(weight):
    """Outputs within 1e-3 and gradients within 1e-2 of float64's: far too small and too large ones for float16 too."""
    state = random_state((80, 20), spread=0.15)
    expected = output_and_gradients(gns_of(message_passing_steps=10), None, state, weight)
    network = gns_of(torch.float32, message_passing_steps=10)
    state = random_state((80, 20), dtype=torch.float32, spread=0.15)
    found = output_and_gradients(network, PlainEdges(torch.float16), state, weight)
    assert relative_error(found[0], expected[0]) < 1e-3 and relative_error(found[1], expected[1]) < 1e-2


def test_a_gradient_of_zero_or_not_finite_stays_that():
    """No error at the output gives zero gradients; a NaN there gives NaN, so that the update is skipped."""
    network = gns_of(torch.float32)
    state = random_state((12,), dtype=torch.float32, spread=0.1)
    edges = PlainEdges(torch.float16)
    weight = network.steps[0].edge.second.weight
    for factor in (0.0, torch.nan):
        network.zero_grad()
        (network.normalised_acceleration(state, edges=edges) * factor).sum().backward()
        assert weight.grad.isnan().all() if factor else weight.grad.eq(0).all()
