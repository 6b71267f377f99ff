"""Choices of the MLS-MPM solver that are not settings: those of a method, and constants.

The identity of a data set contains them under these names (see hgn.renamed).
"""

from typing import NamedTuple


class SolverMethod(NamedTuple):
    """The choices in which the solver's own method and that of Taichi Elements differ."""

    # mohr_coulomb: the friction angle on every stress path; compression: the Drucker-Prager cone that fits compression.
    sand_friction_law: str
    # tampubolon: the correction is added to the strains (Tampubolon et al. 2017); taichi_elements: only to their trace.
    sand_volume_correction: str
    # Bound of the hardening factor exp(hardening * (1 - Jp)). Impacts faster than about 5 m/s reach it; it counts hits.
    snow_maximum_hardening: float
    # trace: J *= 1 + dt tr C; taichi_elements: J *= det(1 + dt C).
    water_volume_update: str
    # Time in seconds in which the volume of water below a free surface approaches its particles' density. Without it
    # water at rest sinks in a random filling.
    water_density_relaxation_s: float | None
    # leapfrog: free fall is exact; symplectic_euler: it is ahead by g t dt / 2.
    time_integration: str
    # Particles and grid exchange velocities every cell_size / this, 32 times a frame of 1/60 s at 64 cells. Between
    # transfers there are as many substeps as the materials need. None: a transfer in every substep. Few transfers
    # smooth velocities less.
    transfer_speed_m_s: float | None
    # Distance in cells from a closed body thinner than a cell. Nodes outside the body within it stop motion. At least
    # one cell is used. A larger distance keeps material farther away.
    collider_band_cells: float


METHODS = {
    "corrected": SolverMethod(
        sand_friction_law="mohr_coulomb",
        sand_volume_correction="tampubolon",
        snow_maximum_hardening=20.0,
        water_volume_update="trace",
        water_density_relaxation_s=1.0,
        time_integration="leapfrog",
        transfer_speed_m_s=30.0,
        collider_band_cells=0.5,
    ),
    "taichi_elements": SolverMethod(
        sand_friction_law="compression",
        sand_volume_correction="taichi_elements",
        snow_maximum_hardening=100.0,
        water_volume_update="taichi_elements",
        water_density_relaxation_s=None,
        time_integration="symplectic_euler",
        transfer_speed_m_s=None,
        collider_band_cells=1.5,
    ),
}

SPEED_FRACTION = 0.3  # of a cell: the fastest particle's longest planned path between two transfers
MINIMUM_SINGULAR_VALUE = 0.05  # lower bound of the singular values of F; hits are counted
WATER_MINIMUM_VOLUME_RATIO = 0.1  # lower bound of J; hits are counted
MAXIMUM_SUBSTEPS = 20_000  # largest number per frame; a scene that needs more is stopped and reported

# Constants that 0.1.0 recorded as settings.
CONSTANTS = {
    "speed_fraction": SPEED_FRACTION,
    "minimum_singular_value": MINIMUM_SINGULAR_VALUE,
    "water_minimum_volume_ratio": WATER_MINIMUM_VOLUME_RATIO,
    "maximum_substeps_per_frame": MAXIMUM_SUBSTEPS,
    "water_equation": "linear",  # pressure lambda (1 - J)
    "wall_contact": "slip",  # the domain's walls are frictionless
    "collider_projection": True,  # particles stop at triangles that the grid would let them cross; counted
}
TAICHI_ELEMENTS_STEP_S = 0.02 / 64  # recorded as the fixed step of data made with adaptive ones
