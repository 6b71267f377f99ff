"""The launches of a frame on tensors without memory."""

import torch

from hgn.kernels.triton_compat import noted_launches
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.training.precompile import simulation_launches


def frame_of(config, step, precision, cells, *, scenes=1, particles, device="meta"):
    """Every kernel of a frame with its specialisation, and the stepper."""
    with torch.device(device):
        network = HierarchicalGraphNetwork(config)
    with noted_launches() as launches:
        stepper = simulation_launches(network, step, precision, cells, scenes=scenes, particles=particles)
    return launches, stepper
