"""Converts trajectories to episodes.

Lengths keep the set's unit, and the box starts at the origin. Network cells have the width of the set's radius, and
obstacle cells are in proportion (`obstacle_cell_size`). A 2D set lies in a plane of constant z through cell centres. So
each level of the hierarchy has one layer of cells, and the walls in z are out of reach.
Shape legend: T frames, N particles, P particles of the boundary, K obstacle cells, H frames before frame 0.
"""

from dataclasses import dataclass, field

import numpy as np

from hgn.config import NetworkConfig
from hgn.data.foreign.boundary import boundary_grid, spacing
from hgn.data.foreign.trajectory import SetInfo, Trajectory, require_fine, require_inside
from hgn.scene.episode import Episode
from hgn.scene.material import MATERIALS
from hgn.scene.obstacle_grid import ObstacleGrid
from hgn.schema import ConfigError, Vector, require

CELL_OF_RADIUS = 1 / 64 / NetworkConfig.cell_size  # ratio of the paper's obstacle cells to its networks' cells
AT_REST = 1e-3  # largest motion of a boundary's particles, in radii


@dataclass(eq=False)
class Converter:
    """Converts the trajectories of a set, and records their content."""

    info: SetInfo
    gravity: tuple[float, ...]  # length per second squared, for trajectories without their own
    history: int
    obstacle_cell_size: float
    present: set[str] = field(default_factory=set)  # names of the materials that occur
    gravities: set[Vector] = field(default_factory=set)
    maximum_initial_speed: float = 0.0  # length per second
    with_obstacles: bool = False
    # for each trajectory that leaves the bounds by more than a radius: how far, and where
    outside: list[tuple[float, str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        names = self.info.materials.values()
        self.materials = (*MATERIALS, *sorted({name for name in names if name not in MATERIALS}))
        low_D, high_D = np.array(self.info.bounds).T
        self.offset = (*(float(value) for value in low_D), 0.0)[:3]
        size = [float(value) for value in high_D - low_D]
        self.plane = 0.0
        if self.info.dimensions == 2:
            self.plane = flat_plane(self.info.radius, self.obstacle_cell_size)
            size.append(2 * self.plane)
        x, y, z = size
        self.domain_size = x, y, z

    def episode(self, trajectory: Trajectory, key: str, index: int) -> Episode:
        """Converts a trajectory to an episode.

        Raises: ConfigError naming the trajectory, for unknown types, moving boundaries, too few frames, and particles
        outside the box or at a periodic side of it.
        """
        info, name = self.info, trajectory.name
        frames, first = len(trajectory.position_TND), self.history
        require(frames >= first + 2, f"{name}: position", f"of at least {first} + 2 frames for history={first}", frames)
        fixed_N = info.obstacles(trajectory.type_N)
        require_inside(trajectory, info)
        require_fine(name, trajectory.position_TND, info.radius)
        position_TN3 = self._placed(trajectory.position_TND)
        still_TP3, free_TN3 = position_TN3[:, fixed_N], position_TN3[:, ~fixed_N]
        moved = float(np.abs(still_TP3 - still_TP3[:1]).max(initial=0))
        if moved > AT_REST * info.radius:
            raise ConfigError(
                f"{name}: particles of types {sorted(info.boundary_types)} must be at rest, got a displacement of "
                f"{moved:.3g}: imported obstacles cannot move; set the types of obstacles with boundary_types=[...]"
            )
        self._require_not_across(name, free_TN3)
        self._note_outside(name, trajectory.position_TND[:, ~fixed_N])
        boundary_P3 = still_TP3[0]
        if trajectory.boundary_PD is not None:
            require_fine(f"{name}: boundary", trajectory.boundary_PD[None], info.radius)
            boundary_P3 = np.concatenate([boundary_P3, self._placed(trajectory.boundary_PD)])
        grid = self._grid(trajectory, boundary_P3)
        gravity = trajectory.gravity or self.gravity
        most = max(self.domain_size) / info.frame_dt_s**2
        rule, largest = f"at most {most:.3g}, one box per frame", max(map(abs, (*gravity, *self.gravity)))
        require(largest <= most, f"{name}: gravity", rule, largest, "check dt")
        x, y, z = (*gravity, 0.0)[:3]
        # the velocity at frame 0 of a free flight from frame -1
        velocity_N3 = (free_TN3[first].astype(np.float64) - free_TN3[first - 1]) / info.frame_dt_s
        velocity_N3 += 0.5 * info.frame_dt_s * np.array((x, y, z))
        material_N = self._materials(name, trajectory.type_N[~fixed_N])
        self.present |= {self.materials[i] for i in np.unique(material_N)}
        self.gravities.add((x, y, z))
        speed = float(np.linalg.norm(velocity_N3, axis=-1).max(initial=0))
        self.maximum_initial_speed = max(self.maximum_initial_speed, speed)
        self.with_obstacles |= len(grid.cell_K3) > 0
        properties: dict[str, np.ndarray] = {}
        if trajectory.property_NK is not None:
            columns = np.ascontiguousarray(trajectory.property_NK[~fixed_N].T)
            properties = {"material_property" + (f"_{k}" if k else ""): column for k, column in enumerate(columns)}
        return Episode(
            key=key,
            position_TN3=free_TN3[first:],
            initial_velocity_N3=velocity_N3.astype(np.float32),
            material_N=material_N,
            obstacle_grid=grid,
            domain_size=self.domain_size,
            gravity=(x, y, z),
            frame_rate_hz=1 / info.frame_dt_s,
            seed=index,
            specification={
                "kind": "imported",
                "format": info.format,
                "trajectory": name,
                "dimensions": info.dimensions,
                "offset": list(self.offset),  # subtracted from positions
            },
            solver={},
            material_parameters=properties,
            materials=self.materials if set(self.materials) != set(MATERIALS) else MATERIALS,
            past_HN3=free_TN3[:first],
            boundary_P3=boundary_P3 if len(boundary_P3) else None,
        )

    def _placed(self, position_xD: np.ndarray) -> np.ndarray:
        """Returns positions relative to the box's corner, float32 [..., 3]."""
        offset_D = np.array(self.offset[: self.info.dimensions])
        placed = np.empty((*position_xD.shape[:-1], 3), np.float32)
        placed[..., 2] = self.plane
        placed[..., : self.info.dimensions] = position_xD - offset_D if offset_D.any() else position_xD
        return placed

    def _note_outside(self, name: str, position_TND: np.ndarray) -> None:
        """Records a trajectory that leaves its bounds. A set is not refused for one splash over an edge."""
        low_D, high_D = np.array(self.info.bounds).T
        excess_2D = np.stack([low_D - position_TND.min((0, 1)), position_TND.max((0, 1)) - high_D])
        above, axis = (int(index) for index in np.unravel_index(excess_2D.argmax(), excess_2D.shape))
        excess, path_TN = float(excess_2D[above, axis]), position_TND[..., axis]
        if excess > self.info.radius:
            place = int(path_TN.argmax() if above else path_TN.argmin())
            low, high = self.info.bounds[axis]
            where = f"{'xyz'[axis]} = {float(path_TN.flat[place]):.4g} in frame {place // path_TN.shape[1]} of {name} "
            where += f"with bounds [{low}, {high}]"
            self.outside.append((excess, where))

    def note_on_bounds(self, converted: int) -> str | None:
        """Returns a warning about the trajectories that left their bounds, or None."""
        if not self.outside:
            return None
        return (
            f"bounds: particles of {len(self.outside)} of {converted} trajectories leave them by more than a radius "
            f"({self.info.radius:g}), for example to {max(self.outside)[1]}; networks treat bounds as walls: give "
            "bounds=… around all particles, or leave these trajectories out"
        )

    def _require_not_across(self, name: str, free_TN3: np.ndarray) -> None:
        """Refuses particles near a periodic side. It has no effect farther away (as in LagrangeBench's dam break)."""
        for axis, periodic in enumerate(self.info.periodic):
            path_TN, high = free_TN3[..., axis], self.domain_size[axis]
            if periodic and path_TN.size and min(path_TN.min(), high - path_TN.max()) < self.info.radius:
                raise ConfigError(
                    f"metadata.json: periodic_boundary_conditions must be false on axis {'xyz'[axis]}, because "
                    f"particles of {name} come within a radius ({self.info.radius:g}) of the box's side, and networks "
                    "do not support periodic boundaries"
                )

    def _grid(self, trajectory: Trajectory, boundary_P3: np.ndarray) -> ObstacleGrid:
        cell_size, cell_K3 = self.obstacle_cell_size, trajectory.obstacle_cell_K3
        if cell_K3 is not None:
            assert trajectory.obstacle_normal_K3 is not None
            order = np.lexsort(np.asarray(cell_K3).T[::-1])
            normal_K3 = trajectory.obstacle_normal_K3[order].astype(np.float32)
            return ObstacleGrid(cell_size, np.asarray(cell_K3)[order].astype(np.int32), normal_K3)
        if not len(boundary_P3):
            return ObstacleGrid(cell_size, np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        return boundary_grid(boundary_P3, self.info.dimensions, cell_size)

    def _materials(self, name: str, type_N: np.ndarray) -> np.ndarray:
        names = self.info.materials
        unknown = sorted({int(number) for number in np.unique(type_N)} - set(names))
        if unknown:
            remedy = f"add one, as in materials={{{unknown[0]}: clay}}"
            raise ConfigError(f"{name}: particle_type must have a name for each number, got {unknown}; {remedy}")
        index = {number: self.materials.index(value) for number, value in names.items()}
        types, of_type_N = np.unique(type_N, return_inverse=True)
        return np.array([index[int(number)] for number in types], np.uint8)[of_type_N]


def obstacle_cell_size(info: SetInfo, boundaries: list[np.ndarray]) -> float:
    """Returns the width of obstacle cells: in proportion to the radius, and at least the boundary particles' spacing.

    The box along x is a whole number of these cells wide, so that mirrors map cells to cells.
    """
    if info.obstacle_cell_size is not None:
        return float(info.obstacle_cell_size)
    apart = max((spacing(points) for points in boundaries), default=0.0)
    wanted = max(CELL_OF_RADIUS * info.radius, 1.001 * apart)
    low, high = info.bounds[0]
    return (high - low) / max(1, int((high - low) / wanted + 1e-6))


def flat_plane(radius: float, obstacle_cell: float) -> float:
    """Returns a z at the centre of a network cell and not near a face of an obstacle cell.

    In float32 (z / radius - 1/2) is exactly a whole number for a division and for a product with the reciprocal, with
    and without rounding before the subtraction. z is at least 16 radii, so walls are out of reach.
    """
    cell = np.float32(radius)
    inverse = np.float32(1) / cell
    for layer in range(16, 4096):
        z, wanted = np.float32((layer + 0.5) * radius), np.float32(layer + 0.5)
        unrounded = np.float32(np.float64(z) * np.float64(inverse) - 0.5)
        middle = 0.1 < float(z) / obstacle_cell % 1 < 0.9
        if z / cell == wanted and z * inverse == wanted and unrounded == layer and middle:
            return float(z)
    raise ConfigError(f"radius must divide exactly in float32, got {radius}; give radius=… with fewer digits")
