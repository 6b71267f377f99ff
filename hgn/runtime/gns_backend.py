"""What works on the edges of a GNS: fused kernels in fp16 on a GPU, else PyTorch."""

from __future__ import annotations

from dataclasses import replace

import torch

from hgn.network.base import ParticleNetwork
from hgn.network.features import ParticleState
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.gns_edges import Edges, PlainEdges
from hgn.runtime.parity import GRADIENT_BOUND, OUTPUT_BOUND, relative_error
from hgn.runtime.triton_host import why_no_triton
from hgn.schema import ConfigError

CHECKED_PARTICLES = 10_000  # of the first scene; autograd needs memory


def use_edges(network: ParticleNetwork, precision: str) -> None:
    """Chooses for a GNS, by the device that it is on and the precision; others are left alone."""
    if isinstance(network, GraphNetworkSimulator):
        network.edges = edges_for(next(network.parameters()).device, network.config.width, precision)


def edges_for(device: torch.device, width: int, precision: str) -> Edges | None:
    """None: plain autograd, which passes over edges less often than blocks that compute their hidden layer twice.

    On a CPU such blocks are twice as fast, for they stay in its caches.
    """
    if precision == "fp16" and device.type == "cuda" and why_no_triton() is None:
        # Triton, which nothing else here needs, is loaded here.
        from hgn.kernels.gns.op import FusedEdges, fits

        if fits(width):
            return FusedEdges()
    if precision == "fp16":
        return PlainEdges(torch.float16)
    return PlainEdges() if device.type == "cpu" else None


def require_agreement(
    network: ParticleNetwork, state: ParticleState, gradients: bool, field: str = "precision"
) -> None:
    """Compares a GNS in fused kernels with plain autograd on a state's first scene, for Triton compiles them anew on
    each machine: outputs and, if wanted, the gradients of a random weighting of them. Any other network passes.

    Both round; kernels that are wrong differ by far more. Raises: ConfigError.
    """
    if not isinstance(network, GraphNetworkSimulator) or network.edges is None or isinstance(network.edges, PlainEdges):
        return
    first = torch.nonzero(state.scene_N == 0).flatten()[:CHECKED_PARTICLES]
    names = ("position_N3", "velocity_NM3", "material_N", "scene_N")
    state = replace(state, **{name: getattr(state, name)[first] for name in names})
    fused = network.edges
    try:
        found = _output_and_gradients(network, state, gradients)
        network.edges = None
        expected = _output_and_gradients(network, state, gradients)
    finally:
        network.edges = fused
    bounds = (OUTPUT_BOUND, GRADIENT_BOUND)
    for name, bound, a, b in zip(("outputs", "gradients"), bounds, found, expected, strict=False):
        if not relative_error(a, b) <= bound:  # NaN fails
            raise ConfigError(
                f"{field} must be tf32 on this machine, got fp16: its {name} differ by {relative_error(a, b):.1e} from "
                f"the plain network's (at most {bound}); set {field}=tf32, and report device and versions"
            )


def _output_and_gradients(network: GraphNetworkSimulator, state: ParticleState, gradients: bool) -> list[torch.Tensor]:
    with torch.set_grad_enabled(gradients):
        output_N3 = network.normalised_acceleration(state)
    if not gradients:
        return [output_N3]
    generator = torch.Generator().manual_seed(0)
    weight_N3 = torch.randn(output_N3.shape, generator=generator).to(output_N3) / len(output_N3)
    found = torch.autograd.grad((output_N3 * weight_N3).sum(), list(network.parameters()), allow_unused=True)
    return [output_N3.detach(), torch.cat([gradient.flatten() for gradient in found if gradient is not None])]
