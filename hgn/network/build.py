"""Builds the network of a configuration."""

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.hgn import HierarchicalGraphNetwork
from hgn.step_config import UNCONSTRAINED, StepConfig


def build_network(config: NetworkConfig, step: StepConfig = UNCONSTRAINED) -> ParticleNetwork:
    """Returns a new network with random parameters and with the constraints `step`.

    Raises: ConfigError if the network does not support these constraints.
    """
    step.require_fits(config.relative, config.dimensions)
    network: ParticleNetwork = (HierarchicalGraphNetwork if config.kind == "hgn" else GraphNetworkSimulator)(config)
    network.step = step
    return network
