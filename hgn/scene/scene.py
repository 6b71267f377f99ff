"""Scenes: particles in their initial state, and obstacles as triangle meshes.

A scene is immutable. Lengths are in domain units (the paper's domain is 1 x 1 x 1). y points up.
Shape legend: N particles, V vertices, F triangles.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from hgn.config import MpmConfig
from hgn.scene.kinds import require_few_cells
from hgn.scene.material import MATERIAL_PARAMETERS, MATERIALS, require_materials
from hgn.scene.motion import Motion
from hgn.schema import ConfigError, Vector, require, require_vector

CELL_TOLERANCE = 1e-3  # largest difference of a domain's length from whole cells, in cells


def whole_cells(domain_size: Vector, cell_size: float) -> tuple[int, int, int]:
    """Returns the number of solver cells along each side of a domain.

    Raises: ConfigError if a side is not a whole number of cells.
    """
    require(0 < cell_size < math.inf, "cell_size", "a finite number > 0", cell_size)
    counts = [length / cell_size for length in domain_size]
    for axis, length, cells in zip("xyz", domain_size, counts, strict=True):
        whole = math.isfinite(cells) and abs(cells - max(1, round(cells))) <= CELL_TOLERANCE
        near = max(1, round(cells)) * cell_size if math.isfinite(cells) else 1.0
        remedy = f"for example {near:.6g}"
        require(whole, f"domain_size ({axis})", f"a whole number of cells of {cell_size:.6g}", length, remedy)
    require_few_cells(domain_size, cell_size)
    x, y, z = (round(cells) for cells in counts)
    return x, y, z


@dataclass(frozen=True, eq=False)
class Obstacle:
    """A triangle mesh, at rest or in motion.

    `closed` marks a watertight solid. The solver treats solids and sheets differently.
    """

    name: str
    vertex_V3: np.ndarray  # float64, domain units
    triangle_F3: np.ndarray  # int32, indices into vertex_V3
    closed: bool
    friction: float = 0.0  # Coulomb coefficient
    motion: Motion | None = None  # None: at rest

    @property
    def corners(self) -> np.ndarray:
        """Returns the corners of the obstacle's triangles, float64 [F, 3, 3]."""
        return np.asarray(self.vertex_V3, np.float64)[self.triangle_F3]

    def at(self, time_s: float) -> Obstacle:
        """Returns the obstacle in its pose at a time."""
        if self.motion is None:
            return self
        return replace(self, vertex_V3=self.motion.place(self.vertex_V3, time_s))


def all_corners(obstacles: Sequence[Obstacle]) -> np.ndarray:
    """Returns the triangle corners of several obstacles, float64 [F, 3, 3]."""
    return np.concatenate([np.zeros((0, 3, 3)), *(obstacle.corners for obstacle in obstacles)])


def require_particles(
    position_N3: np.ndarray, velocity_N3: np.ndarray, material_N: np.ndarray, materials: Sequence[str] = MATERIALS
) -> None:
    """Checks arrays of particles. Raises: ConfigError for a wrong type, shape or material."""
    count = len(position_N3) if isinstance(position_N3, np.ndarray) and position_N3.ndim else 0
    for name, array, shape in (
        ("position_N3", position_N3, (count, 3)),
        ("velocity_N3", velocity_N3, (count, 3)),
        ("material_N", material_N, (count,)),
    ):
        require(isinstance(array, np.ndarray), name, "a NumPy array", type(array).__name__)
        require(array.dtype.kind in "iuf", name, "of real numbers", str(array.dtype))
        if array.shape != shape:
            raise ConfigError(f"{name} must have shape {shape}, got {array.shape}")
    require_materials("material_N", material_N, materials)


def require_vectors(owner: Any) -> None:
    """Checks gravity, the domain's size and friction of walls. Raises: ConfigError unless they are three numbers."""
    for name, least in (("gravity", -1e9), ("domain_size", 0), ("wall_friction", 0)):
        require_vector(name, getattr(owner, name), least, 1e9)


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene: the input of the solver and of a network's rollout.

    Unlike a scene file, it accepts particles inside closed obstacles and near walls. The solver refuses those at walls.
    """

    position_N3: np.ndarray  # float32, domain units
    velocity_N3: np.ndarray  # float32, domain units per second
    material_N: np.ndarray  # uint8, index into MATERIALS
    obstacles: tuple[Obstacle, ...] = ()
    domain_size: Vector = (1.0, 1.0, 1.0)
    cell_size: float = 1 / 64  # edge of the cells of the solver's grid and of obstacle cells
    gravity: Vector = (0.0, -9.8, 0.0)  # domain units per second squared
    seed: int = 0  # seed of the obstacles' surface samples
    specification: dict[str, Any] = field(default_factory=dict)  # plain JSON types: all choices that made the scene
    # float32 [N] by name (hgn.scene.material.MATERIAL_PARAMETERS); they replace the solver's settings, except for NaN
    material_parameters: dict[str, np.ndarray] = field(default_factory=dict)
    # density of the initial filling, if known; the solver then relaxes the density of water towards it
    particles_per_cell: float | None = None
    # Coulomb coefficients of the domain's walls normal to x, y (floor and ceiling) and z
    wall_friction: Vector = (0.0, 0.0, 0.0)
    # float64 [N], seconds, sorted: the time at which each particle enters at its position and velocity; 0: it is
    # present from the start. None: all are
    entry_s_N: np.ndarray | None = None

    def __post_init__(self) -> None:
        require_particles(self.position_N3, self.velocity_N3, self.material_N)
        count = len(self.position_N3)
        for name in ("position_N3", "velocity_N3"):
            bad = np.flatnonzero(~np.isfinite(getattr(self, name)).all(axis=1))
            if len(bad):
                raise ConfigError(f"{name} must be finite, got {getattr(self, name)[bad[0]]} for particle {bad[0]}")
        require_vectors(self)
        for i, obstacle in enumerate(self.obstacles):
            require(0 <= obstacle.friction < math.inf, f"obstacles[{i}].friction", "finite and >= 0", obstacle.friction)
        for name, value in self.material_parameters.items():
            if name not in MATERIAL_PARAMETERS:
                raise ConfigError(f"material_parameters must be among {', '.join(MATERIAL_PARAMETERS)}, got {name!r}")
            shape = value.shape if isinstance(value, np.ndarray) else value
            require(shape == (count,), f"material_parameters[{name}]", f"an array of shape {(count,)}", shape)
            known = value[~np.isnan(value)]
            for constant in (known.min(), known.max()) if len(known) else ():
                own: dict[str, Any] = {name: float(constant)}
                MpmConfig(**own)  # validates the constant
        if self.entry_s_N is not None:
            require(self.entry_s_N.shape == (count,), "entry_s_N", f"of shape {(count,)}", self.entry_s_N.shape)
            ordered = bool((np.diff(self.entry_s_N, prepend=0.0) >= 0).all()) and np.isfinite(self.entry_s_N).all()
            require(bool(ordered), "entry_s_N", "finite, >= 0 and in order", self.entry_s_N)

    @property
    def moves(self) -> bool:
        """Returns whether any obstacle moves."""
        return any(obstacle.motion is not None for obstacle in self.obstacles)

    @property
    def emits(self) -> bool:
        """Returns whether particles enter after the start."""
        return self.entry_s_N is not None and bool((self.entry_s_N > 0).any())

    @property
    def particle_count(self) -> int:
        return len(self.position_N3)

    def selected(self, chosen: np.ndarray | slice) -> Scene:
        """Returns the scene with these of its particles."""
        return replace(
            self,
            position_N3=self.position_N3[chosen],
            velocity_N3=self.velocity_N3[chosen],
            material_N=self.material_N[chosen],
            material_parameters={name: value_N[chosen] for name, value_N in self.material_parameters.items()},
            entry_s_N=None if self.entry_s_N is None else self.entry_s_N[chosen],
        )
