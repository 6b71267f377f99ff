"""The network that a configuration names."""

from __future__ import annotations

from hgn.config import NetworkConfig
from hgn.network.base import ParticleNetwork
from hgn.network.gns import GraphNetworkSimulator
from hgn.network.hgn import HierarchicalGraphNetwork


def build_network(config: NetworkConfig) -> ParticleNetwork:
    """A new network with random weights."""
    return HierarchicalGraphNetwork(config) if config.kind == "hgn" else GraphNetworkSimulator(config)
