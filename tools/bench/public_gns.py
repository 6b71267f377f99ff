"""The public PyTorch Geometric implementation of GNS, from a local copy, with the parameters of our GNS.

The copy is the repository github.com/geoelements/gns, which is not part of this project. Its own simulator class is
timed. Two parts are replaced so that it computes the same function: the neighbour search, whose original needs another
compiled library and keeps any 128 neighbours, and training noise, which is drawn on the device instead of the host.
Shape legend: N particles, H velocity history, W = H + 2 frames, E directed edges.
"""

from __future__ import annotations

import copy
import importlib
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import nn

from hgn.config import MATERIAL_EMBEDDING, NetworkConfig, TrainingConfig
from hgn.data.batch import Batch
from hgn.network.features import WALL_DISTANCE_CELLS
from hgn.network.gns import GraphNetworkSimulator, InteractionStep
from hgn.network.mlp import MLP
from hgn.network.neighbours import neighbour_list
from hgn.runtime.parity import relative_error
from hgn.schema import ConfigError, require
from hgn.training.noise import perturbed_window
from tools.bench.contenders import BOUNDS, Contender, bench_network, reference_output, verdict
from tools.bench.states import Workload, batch_of

MODULE = "gns.learned_simulator"


def load_public(folder: Path) -> ModuleType:
    """Imports the module with the public simulator class, and replaces its neighbour search.

    Raises: ConfigError if the folder is no copy of the repository, or PyTorch Geometric is not installed.
    """
    file = folder / "gns" / "learned_simulator.py"
    remedy = "clone github.com/geoelements/gns to a place outside of this repository"
    require(file.is_file(), "public_gns", "a local copy of the public code", str(folder), remedy)
    sys.path.insert(0, str(folder.resolve()))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of their files and libraries
            module = importlib.import_module(MODULE)
    except ModuleNotFoundError as error:
        raise ConfigError(f"public_gns must find its libraries, got none named {error.name}; install it") from None
    finally:
        sys.path.remove(str(folder.resolve()))
    assert module.__file__ is not None
    imported = Path(module.__file__).resolve()
    require(imported == file.resolve(), "public_gns", "the only package named gns", str(imported))
    module.radius_graph = _radius_graph  # type: ignore[attr-defined]
    return module


def public_simulator(module: ModuleType, network: GraphNetworkSimulator, domain_3: torch.Tensor) -> nn.Module:
    """Returns their simulator with our network's structure and normaliser, in a cubic domain."""
    config, normaliser = network.config, network.normaliser
    statistics = {
        name: {"mean": getattr(normaliser, f"{name}_mean"), "std": getattr(normaliser, f"{name}_std")}
        for name in ("velocity", "acceleration")
    }
    return module.LearnedSimulator(
        particle_dimensions=3,
        nnode_in=3 * config.velocity_history + 6 + MATERIAL_EMBEDDING,
        nedge_in=4,
        latent_dim=config.width,
        nmessage_passing_steps=config.message_passing_steps,
        nmlp_layers=1,
        mlp_hidden_dim=config.width,
        connectivity_radius=config.cell_size,
        boundaries=np.stack([np.zeros(3), domain_3.cpu().numpy()], axis=1),
        normalization_stats=statistics,
        nparticle_types=len(config.materials),
        particle_type_embedding_size=MATERIAL_EMBEDDING,
        boundary_clamp_limit=WALL_DISTANCE_CELLS,
        device=str(domain_3.device),
    ).to(domain_3)


@torch.no_grad()
def copy_weights(simulator: nn.Module, network: GraphNetworkSimulator) -> None:
    """Copies their parameters into our network, which then computes the same function.

    Their velocities start with the oldest, ours with the newest; their wall distances are in radii, ours divided by the
    largest; their edges read the receiver first, their particles the sum. Columns of obstacle normals become zero.
    """
    public: Any = simulator
    config, parts = network.config, network.encode.parts
    network.embedding.weight.copy_(public._particle_type_embedding.weight)
    theirs: Any = public._encode_process_decode
    _copy(theirs._encoder.node_fn, network.encode, same_input=False)
    first = theirs._encoder.node_fn[0][0].weight
    history, width = config.velocity_history, config.width
    velocity, wall, material = first.split([parts[0], parts[2], parts[3]], dim=1)
    velocity = velocity.unflatten(1, (history, 3)).flip(1).flatten(1)
    normal = velocity.new_zeros(len(velocity), parts[1])
    network.encode.first.weight.copy_(torch.cat([velocity, normal, WALL_DISTANCE_CELLS * wall, material], 1))
    _copy(theirs._encoder.edge_fn, network.encode_edges)
    for step, public_step in zip(network.steps, theirs._processor.gnn_stacks, strict=True):
        assert isinstance(step, InteractionStep)
        _copy(public_step.edge_fn, step.edge, same_input=False)
        receiver, sender, edge = public_step.edge_fn[0][0].weight.split(width, dim=1)
        step.edge.first.weight.copy_(torch.cat([sender, receiver, edge], 1))
        _copy(public_step.node_fn, step.node, same_input=False)
        total, own = public_step.node_fn[0][0].weight.split(width, dim=1)
        step.node.first.weight.copy_(torch.cat([own, total], 1))
    _copy([theirs._decoder.node_fn], network.decode)


class PublicGns(Contender):
    """Their simulator on the bench's states, checked against ours with the same parameters."""

    def __init__(
        self, folder: Path, config: NetworkConfig, work: Workload, device: torch.device, precision: str = "fp32"
    ) -> None:
        network = bench_network(config, device)
        assert isinstance(network, GraphNetworkSimulator)
        self.device, self.network = device, network
        self.batch = batch_of(work, config, device)
        module = load_public(folder)
        self.simulator: Any = public_simulator(module, network, self.batch.domain_S3[0])
        copy_weights(self.simulator, network)

    def output(self, window_WN3: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns their normalised acceleration and its target, [N, 3] each; the window contains the noise."""
        sequence_NH3 = window_WN3[:-1].transpose(0, 1).contiguous()
        return self.simulator.predict_accelerations(
            next_positions=window_WN3[-1],
            position_sequence_noise=torch.zeros_like(sequence_NH3),
            position_sequence=sequence_NH3,
            nparticles_per_example=self.batch.particles_S,
            particle_types=self.batch.material_N,
        )

    def expected(self) -> torch.Tensor:
        """Returns our network's normalised acceleration in float64 with the same neighbours, [N, 3]."""
        with torch.no_grad():
            return reference_output(copy.deepcopy(self.network).double(), self.batch.state())


class PublicFrame(PublicGns):
    """One frame of their rollout: features, neighbours, network, integration."""

    def run(self) -> torch.Tensor:
        sequence_NH3 = self.batch.window_WN3[:-1].transpose(0, 1).contiguous()
        with torch.no_grad():
            next_N3 = self.simulator.predict_positions(sequence_NH3, self.batch.particles_S, self.batch.material_N)
        return torch.cat([sequence_NH3[:, 1:], next_N3[:, None]], dim=1)

    @torch.no_grad()
    def check(self, precision: str) -> str:
        """Compares their accelerations with ours."""
        found_N3, _ = self.output(self.batch.window_WN3)
        return verdict("acceleration", relative_error(found_N3.double(), self.expected()), BOUNDS[precision])


class PublicTrain(PublicGns):
    """One of their training steps: noise, forward, backward, Adam."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.optimizer = torch.optim.Adam(self.simulator.parameters(), lr=TrainingConfig.learning_rate)

    def loss(self, batch: Batch) -> torch.Tensor:
        """Returns their loss: the squared error, summed over axes."""
        found_N3, target_N3 = self.output(batch.window_WN3)
        return (found_N3 - target_N3).square().sum(-1).mean()

    def run(self) -> None:
        noisy = replace(self.batch, window_WN3=perturbed_window(self.batch, TrainingConfig.noise_std))
        loss = self.loss(noisy)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    @torch.no_grad()
    def check(self, precision: str) -> str:
        """Compares their loss with ours."""
        normaliser = copy.deepcopy(self.network.normaliser).double()
        target_N3 = normaliser.normalise_acceleration(self.batch.acceleration(self.batch.window_WN3.double()))
        expected = (self.expected() - target_N3).square().sum(-1).mean()
        return verdict("loss", relative_error(self.loss(self.batch).double(), expected), BOUNDS[precision])


def _copy(theirs: Any, ours: MLP, same_input: bool = True) -> None:
    """Copies layers and norm, except for a first layer's matrix whose columns have another order."""
    layers = theirs[0]
    if same_input:
        ours.first.weight.copy_(layers[0].weight)
    ours.first.bias.copy_(layers[0].bias)
    ours.second.weight.copy_(layers[2].weight)
    ours.second.bias.copy_(layers[2].bias)
    if ours.norm is not None:
        ours.norm.weight.copy_(theirs[1].weight)
        ours.norm.bias.copy_(theirs[1].bias)


def _radius_graph(
    position_N3: torch.Tensor, r: float, batch: torch.Tensor, loop: bool, max_num_neighbors: int
) -> torch.Tensor:
    """Returns sender and receiver of each edge, int64 [2, E]: all particles within r, and themselves."""
    neighbours = neighbour_list(position_N3.detach(), batch, r)
    order_N = neighbours.order_N
    return torch.stack([order_N[neighbours.sender_E], order_N[neighbours.receivers.segment_E]])
