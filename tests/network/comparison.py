"""A network against the literal definition."""

import torch


def assert_same_function(network, found, expected):
    """Float64 outputs agree, and so do the gradients, of a random weighting of them, by each of the parameters."""
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
    weight, parameters = torch.randn_like(expected), list(network.parameters())
    expected_gradients = torch.autograd.grad((expected * weight).sum(), parameters, allow_unused=True)
    found_gradients = torch.autograd.grad((found * weight).sum(), parameters, allow_unused=True)
    for name, a, b in zip(dict(network.named_parameters()), found_gradients, expected_gradients, strict=True):
        assert (a is None or not a.any()) == (b is None or not b.any()), name
        if a is not None and b is not None:
            torch.testing.assert_close(a, b, rtol=1e-8, atol=1e-9, msg=name)
