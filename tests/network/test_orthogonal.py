"""Square blocks of the weights and their orthogonalisation, against the singular value decomposition."""

import torch
from network.states import network_of

from hgn.network.orthogonal import normalised, orthogonalised, square_blocks


def test_singular_values_come_near_one():
    """Random matrices of any size: singular vectors stay, singular values end within [0.65, 1.25]."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(3, 32, 32, generator=generator, dtype=torch.float64)
    matrix *= torch.tensor([1e-8, 1.0, 1e8])[:, None, None]
    left, _, right = torch.linalg.svd(matrix)
    found = left.mT @ orthogonalised(normalised(matrix)) @ right.mT
    assert (found - torch.diag_embed(found.diagonal(dim1=1, dim2=2))).abs().max() < 1e-6
    values = found.diagonal(dim1=1, dim2=2)[:, :-2]  # the smallest of a random matrix may not have come up yet
    assert values.min() > 0.65 and values.max() < 1.25


def test_blocks_are_the_maps_between_latents():
    """Every part of width columns, every second layer of width rows; not the encoder's first layer, no offset."""
    network = network_of(width=16, levels=2, message_passing_steps=2, cell_size=0.1)
    flat = torch.cat([parameter.detach().flatten() for parameter in network.parameters()])
    blocks = square_blocks(network)
    assert blocks.unique().numel() == blocks.numel()
    # a message step: two parts of edges, one more after the first step, their second layer; two and one of cells
    passing = 3 * (2 + 1 + 2 + 1 + 3 + 1 + 2 + 1)
    # pairs: into cells, up, and out of them; encoder and decoder
    assert len(blocks) == passing + (1 + 1) + (1 + 1) + (2 + 1) + (2 + 1) + 1 + 1
    edge = network.passing_down[0].edge[1]
    held = [block for block in flat[blocks] if torch.equal(block, edge.first.weight[:, 16:32])]
    assert len(held) == 1
