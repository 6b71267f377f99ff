"""python -m tools.studies.flat_set out=data/flat_plain: water in two dimensions, as a foreign program would leave it.

A small MLS-MPM (Hu et al. 2018) in NumPy, with slopes of particles at rest, in the plain layout that
hgn.import_trajectories reads: what flat sets are tried with where no other can be had.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.schema import FrameCount, NonNegative, OneOrMore, from_mapping, require_bounds
from hgn.system.progress import bar

NODES = 64  # of the grid, on each axis
CELL = 1 / NODES
STEP_S = 2.5e-4
STIFFNESS = 400.0  # of water's pressure, density 1
LOW, HIGH = 0.1, 0.9  # the box
SPACING = 0.011  # of particles
RADIUS = 0.03
WATER, KINEMATIC = 5, 3
GRAVITY = -9.8


@dataclass(frozen=True)
class FlatSetConfig:
    """`python -m tools.studies.flat_set`."""

    out: str  # a folder
    training: OneOrMore = 24  # trajectories
    validation: NonNegative[int] = 4
    frames: FrameCount = 120
    steps_per_frame: OneOrMore = 32  # of 0.25 ms
    seed: NonNegative[int] = 0

    def __post_init__(self) -> None:
        require_bounds(self)


def main(mapping: dict[str, Any]) -> int:
    """Writes train.npz, valid.npz and metadata.json; returns the exit code."""
    config = from_mapping(FlatSetConfig, mapping)
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(config.seed)
    with bar("simulating", total=config.training + config.validation, unit="trajectory") as progress:
        for split, count in (("train", config.training), ("valid", config.validation)):
            members: dict[str, Any] = {}
            for number in range(count):
                water_N2, slopes = drawn(generator)
                still_P2 = np.concatenate([slope_particles(slope) for slope in slopes])
                path_TN2 = simulated(water_N2, slopes, config.frames, config.steps_per_frame)
                still_TP2 = np.repeat(still_P2[None].astype(np.float32), config.frames, axis=0)
                types = np.repeat([KINEMATIC, WATER], [len(still_P2), len(water_N2)])
                members[f"{number:05d}/position"] = np.concatenate([still_TP2, path_TN2], axis=1)
                members[f"{number:05d}/particle_type"] = types
                progress.update()
            np.savez(out / f"{split}.npz", **members)
    metadata = {
        "dim": 2,
        "dt": STEP_S * config.steps_per_frame,
        "bounds": [[LOW, HIGH], [LOW, HIGH]],
        "default_connectivity_radius": RADIUS,
    }
    (out / "metadata.json").write_text(json.dumps(metadata))
    return 0


def drawn(generator: np.random.Generator) -> tuple[np.ndarray, list[np.ndarray]]:
    """One or two blocks of water, float64 [N, 2], and one or two slopes below them, each its two ends [2, 2]."""
    blocks = []
    for place in np.linspace(LOW, HIGH, 3)[: generator.integers(1, 3)]:
        side_2 = generator.uniform(0.16, 0.26, 2)
        corner_2 = np.array([place + generator.uniform(0.02, 0.38 - side_2[0]), generator.uniform(0.5, 0.6)])
        axes = [np.arange(0, side, SPACING) for side in side_2]
        grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
        blocks.append(corner_2 + grid + generator.uniform(-0.1, 0.1, grid.shape) * SPACING)
    slopes = []
    for _ in range(generator.integers(1, 3)):
        middle_2, angle = generator.uniform([0.3, 0.22], [0.7, 0.4]), generator.uniform(-0.7, 0.7)
        half_2 = 0.5 * generator.uniform(0.15, 0.3) * np.array([np.cos(angle), np.sin(angle)])
        slopes.append(np.stack([middle_2 - half_2, middle_2 + half_2]))
    return np.clip(np.concatenate(blocks), LOW + SPACING, HIGH - SPACING), slopes


def slope_particles(slope_22: np.ndarray) -> np.ndarray:
    """Particles along a slope, float64 [P, 2]."""
    count = int(np.linalg.norm(slope_22[1] - slope_22[0]) / (0.5 * SPACING)) + 1
    return slope_22[0] + np.linspace(0, 1, count)[:, None] * (slope_22[1] - slope_22[0])


def simulated(water_N2: np.ndarray, slopes: list[np.ndarray], frames: int, steps: int) -> np.ndarray:
    """Positions of water, float32 [frames, N, 2], the first ones included."""
    x, v, C = water_N2.copy(), np.zeros_like(water_N2), np.zeros((len(water_N2), 2, 2))
    J, path = np.ones(len(x)), [x.astype(np.float32)]
    node_G2 = CELL * np.stack(np.meshgrid(np.arange(NODES), np.arange(NODES), indexing="ij"), -1).reshape(-1, 2)
    contacts = [_contact(node_G2, slope_22) for slope_22 in slopes]
    for _ in range(frames - 1):
        for _ in range(steps):
            x, v, C, J = _step(x, v, C, J, node_G2, contacts)
        path.append(x.astype(np.float32))
    return np.stack(path)


def _contact(node_G2: np.ndarray, slope_22: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nodes at a slope, and its normal."""
    along_2 = slope_22[1] - slope_22[0]
    place_G = np.clip((node_G2 - slope_22[0]) @ along_2 / (along_2 @ along_2), 0, 1)
    distance_G = np.linalg.norm(node_G2 - slope_22[0] - place_G[:, None] * along_2, axis=1)
    normal_2 = np.array([-along_2[1], along_2[0]]) / np.linalg.norm(along_2)
    return distance_G < 0.7 * CELL, normal_2


def _step(
    x: np.ndarray,
    v: np.ndarray,
    C: np.ndarray,
    J: np.ndarray,
    node_G2: np.ndarray,
    contacts: list[tuple[np.ndarray, np.ndarray]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Particles to grid, gravity and contacts there, and back: one step of all particles, volume and mass SPACING^2."""
    volume = SPACING**2
    base = np.floor(x / CELL - 0.5).astype(np.int64)
    offset = x / CELL - base
    weights = [0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1) ** 2, 0.5 * (offset - 0.5) ** 2]
    pressure = -STEP_S * volume * 4 / CELL**2 * STIFFNESS * np.minimum(J - 1, 0) * J
    affine = pressure[:, None, None] * np.eye(2) + volume * C
    stencil = []
    mass, momentum = np.zeros(NODES**2), np.zeros((2, NODES**2))
    for i in range(3):
        for j in range(3):
            toward = (np.array([i, j]) - offset) * CELL
            weight = weights[i][:, 0] * weights[j][:, 1]
            index = (base[:, 0] + i) * NODES + base[:, 1] + j
            carried = weight[:, None] * (volume * v + np.einsum("nij,nj->ni", affine, toward))
            mass += np.bincount(index, weight * volume, NODES**2)
            for axis in range(2):
                momentum[axis] += np.bincount(index, carried[:, axis], NODES**2)
            stencil.append((index, weight, toward))
    velocity = (momentum / np.maximum(mass, 1e-12)).T
    velocity[:, 1] += STEP_S * GRAVITY
    for near, normal in contacts:
        velocity[near] -= (velocity[near] @ normal)[:, None] * normal
    velocity = np.where(node_G2 <= LOW, np.maximum(velocity, 0), velocity)
    velocity = np.where(node_G2 >= HIGH, np.minimum(velocity, 0), velocity)
    v, C = np.zeros_like(v), np.zeros_like(C)
    for index, weight, toward in stencil:
        moved = weight[:, None] * velocity[index]
        v += moved
        C += 4 / CELL**2 * moved[:, :, None] * toward[:, None, :]
    J = np.clip(J * (1 + STEP_S * np.trace(C, axis1=1, axis2=2)), 0.6, 1.02)
    return np.clip(x + STEP_S * v, LOW + 1e-3, HIGH - 1e-3), v, C, J


if __name__ == "__main__":
    run_command(main, "flat_set")
