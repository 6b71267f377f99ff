"""GNS's fused kernels against the reference network: in Triton's interpreter on a CPU, natively on a GPU."""

from dataclasses import replace

import pytest
import torch
from kernels.engines import device
from network.states import gns_of, on_device, random_state
from network.test_gns_edges import output_and_gradients

from hgn.kernels.gns.op import FusedEdges, Tuning, fits
from hgn.network.gns_edges import PlainEdges
from hgn.runtime.backend import triton_unsupported_reason
from hgn.runtime.gns_graph import padded
from hgn.runtime.parity import relative_error
from hgn.runtime.torch_backend import GnsBackend
from hgn.runtime.triton_backend import TritonGnsBackend
from hgn.schema import ConfigError

SMALL = Tuning(block=16, backward_block=16, product_rows=16)
NATIVE = torch.cuda.is_available()


@pytest.mark.parametrize(
    ("counts", "width", "precision", "output_bound", "gradient_bound"),
    [
        ((23, 9), 16, "fp16", 2e-3, 2e-2),
        ((1,), 32, "fp16", 2e-3, 2e-2),
        ((19,), 16, "tf32", 2e-3, 2e-2),
        pytest.param((23, 9), 16, "fp32", 1e-5, 1e-3, marks=pytest.mark.skipif(NATIVE, reason="the interpreter's")),
        *(
            pytest.param(
                (300, 1, 80), 128, precision, 2e-3, 5e-2, marks=pytest.mark.skipif(not NATIVE, reason="needs a GPU")
            )
            for precision in ("fp16", "tf32")
        ),
    ],
)
def test_fused_edges_equal_the_plain_network(counts, width, precision, output_bound, gradient_bound):
    """Outputs, with gradients wanted and without, and the gradients of all parameters agree with float64."""
    steps = 2 if width < 128 else 10
    plain, state = gns_of(width=width, message_passing_steps=steps), random_state(counts, spread=0.1)
    expected = output_and_gradients(plain, None, state, 1e-5)
    network = gns_of(torch.float32, width=width, message_passing_steps=steps).to(device())
    state = on_device(random_state(counts, spread=0.1, dtype=torch.float32), device())
    tuning = FusedEdges.in_tf32().tuning if precision == "tf32" else Tuning()
    edges = FusedEdges(precision, tuning if NATIVE else SMALL)
    found = output_and_gradients(network, edges, state, 1e-5)
    with torch.no_grad():
        again = network.normalised_acceleration(state, edges=edges)
    assert relative_error(found[0].cpu(), expected[0]) < output_bound
    assert relative_error(again.cpu().double(), expected[0]) < output_bound
    assert relative_error(found[1].cpu(), expected[1]) < gradient_bound


def test_room_to_spare_changes_nothing():
    """Rows of edges beyond the last offset, as CUDA graphs have them, leave the output as it is."""
    network = gns_of(torch.float32, message_passing_steps=1).to(device())
    edges = FusedEdges(tuning=SMALL)
    state = on_device(random_state((19, 4), spread=0.1, dtype=torch.float32), device())
    neighbours = network.neighbours(state)
    with torch.no_grad():
        expected = network.propagate(state, neighbours, edges)
        inputs = padded(state, neighbours, 23, neighbours.edge_count + 70)
        assert torch.equal(network.propagate(inputs.state, inputs.neighbours, edges), expected)


def test_wrong_kernels_are_refused(monkeypatch):
    """What differs from plain autograd in outputs or gradients is refused, saying what to set; what is right passes."""
    network = gns_of(torch.float32, message_passing_steps=1).to(device())
    state = on_device(random_state((9, 4), spread=0.05, dtype=torch.float32), device())
    backend = TritonGnsBackend(network, "fp16")
    backend.edges = FusedEdges(tuning=SMALL)
    backend.require_parity(state, gradients=True)
    step, backward = FusedEdges.step, FusedEdges.encode_backward

    def wrong_step(*arguments, **named):
        total, out = step(*arguments, **named)
        return 2 * total, out

    def wrong_backward(*arguments):
        bias, weights = backward(*arguments)
        return bias, weights._replace(second=weights.second + 100)

    for name, wrong, gradients, what in (
        ("step", wrong_step, False, "outputs"),
        ("encode_backward", wrong_backward, True, "gradients"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(FusedEdges, name, wrong)
            with pytest.raises(ConfigError, match=f"precision must be tf32 on this machine, got fp16: its {what}"):
                backend.require_parity(state, gradients)


def test_what_works_where():
    """Kernels take widths of matrix units; PyTorch works in blocks on a CPU and in fp16, and by autograd else."""
    assert fits(64) and not fits(24) and not fits(8)
    network = gns_of(torch.float32)
    assert GnsBackend(network, "tf32").edges == PlainEdges()
    assert GnsBackend(network, "fp16").edges == PlainEdges(torch.float16)
    assert TritonGnsBackend(network, "fp16").edges == FusedEdges()
    config = replace(network.config, width=24)
    assert "not 24" in triton_unsupported_reason(torch.device("cuda"), config, "fp16")
