"""Where the solver's kernels find what the host sends them: positions in small arrays, and the constants.

Kernels take few arrays rather than many scalars, since each argument of a launch costs time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hgn.config import MpmConfig

BLOCK = 4  # nodes along the side of a block of the grid
BLOCK_NODES = BLOCK**3


class Constant(NamedTuple):
    """Positions of the laws' constants in the array that kernels read."""

    shear: int = 0  # mu, Pa
    bulk: int = 1  # Lamé's lambda, Pa
    density: int = 2
    sand_alpha: int = 3  # slope of the Drucker-Prager cone
    hardening: int = 4
    snow_smallest: int = 5  # singular values that snow bears elastically
    snow_largest: int = 6
    maximum_hardening: int = 7
    water_smallest_volume: int = 8
    smallest_singular_value: int = 9
    length: int = 10


class Count(NamedTuple):
    """Positions in the int64 state of each scene: what is counted and reported, then what runs the scene."""

    substeps: int = 0
    water_volume_floors: int = 1
    singular_value_floors: int = 2
    hardening_caps: int = 3
    plastic_volume_bounds: int = 4
    position_clamps: int = 5
    status: int = 6
    frame_substeps: int = 7  # taken in the present frame
    length: int = 8


REPORTED = Count._fields[:6]


class SceneValue(NamedTuple):
    """Positions in the float32 state of each scene."""

    remaining: int = 0  # of the frame, s
    time_step: int = 1  # of the present substep, s; 0 while the scene idles
    smallest_time_step: int = 2
    stiffness: int = 3  # largest 3 lambda + 2 mu that changes from step to step, Pa
    least_stiffness: int = 4  # of the materials whose stiffness is constant, Pa
    speed_square: int = 5  # largest
    gravity: int = 6  # 6, 7, 8
    substeps_ahead: int = 9  # estimated, after the present one
    largest_speed_square: int = 10
    length: int = 11


class Status(NamedTuple):
    running: int = 0
    not_finite: int = 1
    left_domain: int = 2
    too_many_substeps: int = 3


class Setting(NamedTuple):
    """Positions in the float32 settings of a launch, after those of Constant."""

    cell_size: int = 10
    inverse_cell_size: int = 11
    fixed_time_step: int = 12  # s; 0 for the adaptive rule
    fixed_substeps: int = 13  # a frame, where the time step is fixed
    stability_fraction: int = 14
    speed_fraction: int = 15
    friction: int = 16
    low: int = 17  # 17, 18, 19: smallest coordinates of a particle
    high: int = 20  # 20, 21, 22: largest
    size: int = 23  # 23, 24, 25: of the domain
    length: int = 26


class Shape(NamedTuple):
    """Positions in the int32 shape of a launch."""

    nodes: int = 0  # 0, 1, 2: along each axis
    blocks: int = 3  # 3, 4, 5: along each axis
    scene_blocks: int = 6
    all_blocks: int = 7  # of all scenes
    wall_cells: int = 8
    sticky_walls: int = 9
    maximum_substeps: int = 10
    part_begin: int = 11  # from here on: first particle of each (scene, part), and the end


class Variant(NamedTuple):
    """Bits of the number that a kernel is compiled for, so that a launch does only what its scenes need."""

    water: int = 1
    sand: int = 2
    snow: int = 4
    contact: int = 8
    taichi_elements_sand: int = 16
    atomic: int = 32  # a GPU's way to add up; else in parts, one after another
    parts: int = 64  # times the number of parts


CONSTANT, COUNT, VALUE, STATUS = Constant(), Count(), SceneValue(), Status()
SETTING, SHAPE, VARIANT = Setting(), Shape(), Variant()


def lame_parameters(config: MpmConfig) -> tuple[float, float]:
    """(mu, lambda) in Pa from Young's modulus and Poisson's ratio."""
    modulus, ratio = config.youngs_modulus_pa, config.poisson_ratio
    return modulus / (2 * (1 + ratio)), modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))


def sand_alpha(config: MpmConfig) -> float:
    """The Drucker-Prager slope, matched to Mohr-Coulomb in compression (Taichi Elements) or in plane strain."""
    sine = np.sin(np.deg2rad(config.sand_friction_angle_deg))
    if config.sand_friction_law == "plane_strain":
        return float(np.sqrt(2.0) * sine / 3)
    return float(np.sqrt(2 / 3) * 2 * sine / (3 - sine))


def constants(config: MpmConfig) -> np.ndarray:
    """The array that the laws read, float32 [Constant.length]."""
    shear, bulk = lame_parameters(config)
    out = np.zeros(CONSTANT.length, np.float32)
    out[CONSTANT.shear] = shear
    out[CONSTANT.bulk] = bulk
    out[CONSTANT.density] = config.density_kg_m3
    out[CONSTANT.sand_alpha] = sand_alpha(config)
    out[CONSTANT.hardening] = config.snow_hardening
    out[CONSTANT.snow_smallest] = 1 - config.snow_critical_compression
    out[CONSTANT.snow_largest] = 1 + config.snow_critical_stretch
    out[CONSTANT.maximum_hardening] = config.snow_maximum_hardening
    out[CONSTANT.water_smallest_volume] = config.water_minimum_volume_ratio
    out[CONSTANT.smallest_singular_value] = config.minimum_singular_value
    return out
