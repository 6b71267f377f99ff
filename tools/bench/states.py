"""States that are timed: a fixed mixture of clumps and spray, with the neighbours and cells of real frames.

A tile is similar to the middle of the 300 frames of the paper's obstacle-free scene: 4,296 particles, about 97
neighbours of each within R, and 1,200 active cells of size R (the tile: 97 and 1,307). More particles are more tiles.
Shape legend: N particles of all scenes, S scenes, W window frames.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from hgn.config import NetworkConfig
from hgn.data.batch import Batch
from hgn.network.features import ParticleState
from hgn.scene.scene import Scene

TILE_PARTICLES = 4_296
TILE_SIZE = 0.5  # domain units
CLUMPED = 2_120 / TILE_PARTICLES  # fraction of the particles in four cubes, 8 a cell of the solver; others are spray
SPRAY_SIZE = 0.31
MARGIN = 0.04  # empty margin of a tile, for the solver's walls
BORDER = 1e-3  # empty margin of a grid cell, so that rounding does not change a particle's cells
SPEED = 2e-3  # domain units a frame


@dataclass(frozen=True)
class Workload:
    """The number of scenes, and of particles in each."""

    particles: int  # number in each scene
    scenes: int

    @property
    def domain_size(self) -> float:
        """Returns the side of the cubic domain that the tiles fill, domain units."""
        return TILE_SIZE * max(2, math.ceil((self.particles / TILE_PARTICLES) ** (1 / 3) - 1e-9))


def positions(workload: Workload, seed: int, cell_size: float) -> np.ndarray:
    """Returns a scene's particles, float32 [particles, 3]; a partial last tile has fewer of each kind."""
    generator = np.random.default_rng(seed)
    side = round(workload.domain_size / TILE_SIZE)
    parts = []
    for tile, first in enumerate(range(0, workload.particles, TILE_PARTICLES)):
        corner = TILE_SIZE * np.array(np.unravel_index(tile, (side, side, side)))
        parts.append(corner + _tile(min(TILE_PARTICLES, workload.particles - first), generator))
    position_N3 = np.concatenate(parts)
    cell_N3 = position_N3 / cell_size - 0.5
    fraction_N3 = cell_N3 - np.floor(cell_N3)
    cell_N3 += np.where(fraction_N3 < BORDER, BORDER, 0) - np.where(fraction_N3 > 1 - BORDER, BORDER, 0)
    return ((cell_N3 + 0.5) * cell_size).astype(np.float32)


def scene_of(workload: Workload, seed: int, cell_size: float) -> Scene:
    """Returns the same particles at rest, for the solver."""
    position_N3 = positions(workload, seed, cell_size)
    size = workload.domain_size
    return Scene(
        position_N3=position_N3,
        velocity_N3=np.zeros_like(position_N3),
        material_N=_materials(len(position_N3), seed),
        domain_size=(size, size, size),
        seed=seed,
    )


def batch_of(workload: Workload, network: NetworkConfig, device: torch.device) -> Batch:
    """Returns a window of frames, scene s from seed s."""
    return batch_of_scenes([Workload(workload.particles, 1)] * workload.scenes, network, device)


def batch_of_scenes(
    scenes: Sequence[Workload], network: NetworkConfig, device: torch.device, first_seed: int = 0
) -> Batch:
    """Returns windows of scenes of different sizes, from consecutive seeds, with small velocities and accelerations."""
    parts, materials = [], []
    for seed, scene in enumerate(scenes, first_seed):
        last_N3 = positions(scene, seed, network.cell_size)
        generator = np.random.default_rng([seed, 1])
        velocity_N3 = generator.normal(0, SPEED, last_N3.shape)
        change_HN3 = generator.normal(0, 0.3 * SPEED, (network.velocity_history + 1, *last_N3.shape))
        velocity_HN3 = velocity_N3 + change_HN3  # oldest first; the last is the target
        after_N3 = last_N3 + velocity_HN3[-1]
        before_HN3 = last_N3 - velocity_HN3[-2::-1].cumsum(0)
        parts.append(np.concatenate([before_HN3[::-1], last_N3[None], after_N3[None]]))
        materials.append(_materials(len(last_N3), seed).astype(np.int64))
    particles = tuple(scene.particles for scene in scenes)
    return Batch(
        window_WN3=torch.from_numpy(np.concatenate(parts, axis=1).astype(np.float32)),
        material_N=torch.from_numpy(np.concatenate(materials)),
        scene_N=torch.arange(len(scenes)).repeat_interleave(torch.tensor(particles)),
        particles_S=particles,
        domain_S3=torch.tensor([[scene.domain_size] * 3 for scene in scenes]),
        gravity_S3=torch.tensor([[0.0, -9.8 / 60**2, 0.0]]).repeat(len(scenes), 1),
        obstacles=None,
        seeds_S=tuple(range(first_seed + 1, first_seed + len(scenes) + 1)),
    ).to(device)


def state_of(workload: Workload, network: NetworkConfig, device: torch.device) -> ParticleState:
    """Returns the state of a simulation at the last frame of `batch_of`'s window."""
    state = batch_of(workload, network, device).state()
    return replace(state, position_N3=state.position_N3.clone(), velocity_NM3=state.velocity_NM3.contiguous())


def _tile(count: int, generator: np.random.Generator) -> np.ndarray:
    clump = round(CLUMPED * count / 4)
    side = (clump / 8) ** (1 / 3) / 64
    corners = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 0], [0, 1, 1]])
    free = TILE_SIZE - 2 * MARGIN - side
    clumps = [MARGIN + free * corner + side * generator.random((clump, 3)) for corner in corners]
    spray = 0.5 * (TILE_SIZE - SPRAY_SIZE) + SPRAY_SIZE * generator.random((count - 4 * clump, 3))
    return np.concatenate([*clumps, spray])


def _materials(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng([seed, 2]).integers(0, 3, count).astype(np.uint8)
