"""Where the solver's kernels find what the host sends them: positions in small arrays, and the constants.

Kernels take few arrays rather than many scalars, since each argument of a launch costs time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hgn.config import MpmConfig
from hgn.scene.material import FLUIDS, MATERIAL_PARAMETERS, MATERIALS
from hgn.scene.scene import Scene

BLOCK = 4  # nodes along the side of a block of the grid
BLOCK_NODES = BLOCK**3
SOLID_FRACTION = 0.6  # of sand: grains are denser by as much


class Constant(NamedTuple):
    """Positions of the laws' constants in a row of the array that kernels read."""

    shear: int = 0  # mu, Pa
    bulk: int = 1  # Lamé's lambda, Pa
    density: int = 2
    sand_alpha: int = 3  # slope of the Drucker-Prager cone
    hardening: int = 4
    snow_smallest: int = 5  # singular values that snow bears elastically
    snow_largest: int = 6
    maximum_hardening: int = 7
    mass: int = 8  # of a particle, in units of the config's
    sand_sine: int = 9  # sine of the friction angle
    water_tension: int = 10  # fraction of the tension that stretched water bears
    viscosity: int = 11  # of water, Pa s
    grain: int = 12  # of sand, d sqrt(2 rho_grain), sqrt(kg / m): see constitutive
    length: int = 13


class Count(NamedTuple):
    """Positions in the int64 state of each scene: what is counted and reported, then what runs the scene."""

    substeps: int = 0
    transfers: int = 1
    water_volume_floors: int = 2
    singular_value_floors: int = 3
    hardening_caps: int = 4
    plastic_volume_bounds: int = 5
    position_clamps: int = 6
    surface_projections: int = 7
    status: int = 8
    frame_substeps: int = 9  # taken in the present frame
    # Maxima of the last step, the bits of a float32 that is not negative: such bits are ordered like the numbers, and
    # a GPU has no maximum of floats that many threads may take at once.
    stiffness_bits: int = 10  # of (3 lambda + 2 mu) / density, m²/s²
    speed_square_bits: int = 11
    held_stiffness_bits: int = 12  # the same of particles that take longer steps of their own, in this interval
    length: int = 13


REPORTED = Count._fields[:8]


class SceneValue(NamedTuple):
    """Positions in the float32 state of each scene."""

    remaining: int = 0  # of the frame, s
    time_step: int = 1  # of the present substep, s; 0 while the scene idles
    smallest_time_step: int = 2
    least_stiffness: int = 3  # of the materials at rest whose stiffness never falls below, m²/s²
    gravity: int = 4  # 4, 5, 6
    substeps_ahead: int = 7  # estimated, after the present one
    largest_speed_square: int = 8  # of the steps before the present one
    interval: int = 9  # as planned, from the last transfer to the next, s
    interval_elapsed: int = 10  # with the present substep, s
    interval_remaining: int = 11  # after the present substep, s; at 0 velocities go back to the particles
    begins: int = 12  # 1 where the present substep is the first of its interval, else 0
    stability_fraction: int = 13  # of the limit of stability: the longest step of stress
    gravity_time: int = 14  # for which gravity acts in the present substep, s: see mls_mpm
    water_density: int = 15  # at rest, in masses of a particle a cell; 0 where it is not known
    wall_friction: int = 16  # 16, 17, 18: of the domain's walls across x, y, z
    part: int = 19  # length of the present part of a frame, s: of all of it where nothing moves
    stiffness: int = 20  # largest in the step before, m²/s²
    last_interval: int = 21  # how long the interval before was, s
    fallen: int = 22  # for which gravity has acted in this interval before the present substep, s
    synchronised: int = 23  # 1 where the interval's first and last substep are half as long as others, else 0
    whole_step: int = 24  # of the others, s
    catch_up: int = 25  # by how much strain is behind where an interval begins, s, less than 0 where ahead
    length: int = 26


class Status(NamedTuple):
    running: int = 0
    not_finite: int = 1
    left_domain: int = 2
    too_many_substeps: int = 3
    waiting: int = 4  # no scene, but the row of particles that enter later


class Setting(NamedTuple):
    """Positions in the float32 settings of a launch."""

    cell_size: int = 0
    inverse_cell_size: int = 1
    fixed_time_step: int = 2  # s; 0 for the adaptive rule
    fixed_substeps: int = 3  # a frame, where the time step is fixed
    density_relaxation: int = 4  # of water's J to its density, 1/s
    low: int = 5  # 5, 6, 7: smallest coordinates of a particle
    high: int = 8  # 8, 9, 10: largest
    size: int = 11  # 11, 12, 13: of the domain
    transfer_interval: int = 14  # s; 0 where every substep is a transfer
    leapfrog: int = 15  # 1 where velocities belong to the middle of an interval, 0 to its end
    length: int = 16


class Shape(NamedTuple):
    """Positions in the int32 shape of a launch."""

    nodes: int = 0  # 0, 1, 2: along each axis
    blocks: int = 3  # 3, 4, 5: along each axis
    scene_blocks: int = 6
    all_blocks: int = 7  # of all scenes
    wall_cells: int = 8
    maximum_substeps: int = 9
    ghosts: int = 10  # nodes that sheets hide from particles near them, of all scenes: see mls_mpm
    ghost_begin: int = 11  # the first of their second fields in the array of nodes
    part_begin: int = 12  # from here on: first particle of each (scene, part), and the end


class Variant(NamedTuple):
    """Bits of the number that a kernel is compiled for, so that a launch does only what its scenes need."""

    water: int = 1
    sand: int = 2
    snow: int = 4
    contact: int = 8
    taichi_elements: int = 16  # laws of sand and water as in Taichi Elements
    atomic: int = 32  # sums with atomics, on a GPU; else in parts, one after another
    several_laws: int = 64  # particles of one kind differ in their constants
    sweep: int = 128  # particles are stopped at triangles
    sheets: int = 256  # some nodes have two fields
    moving: int = 512  # obstacles move
    elastic: int = 1024
    rate_of_sand: int = 2048  # friction grows with the rate of flow
    each_step: int = 4096  # is an interval of its own
    parts: int = 8192  # times the number of parts; must be the last


class Field(NamedTuple):
    """Positions of a particle's numbers in the state of the team kernel, stored field by field."""

    position: int = 0
    velocity: int = 3
    affine: int = 6
    volume: int = 15
    fluid: int = 16  # fields of particles without a deformation gradient
    deformation: int = 16
    stretch: int = 25  # xx, yy, zz, xy, xz, yz: see mls_mpm.respond
    solid: int = 31  # fields of particles with a deformation gradient


class Tag(NamedTuple):
    """Positions of a particle's integers in the team kernel."""

    material: int = 0
    law_row: int = 1
    origin: int = 2  # its index within the scene as given
    length: int = 3


class Live(NamedTuple):
    """Positions in the int32 state of a scene that its team shares."""

    blocks: int = 0  # touched, in this interval
    cursor: int = 1  # particles that have a place in the order
    copy: int = 2  # which of the two copies of the particles is the present one
    frames: int = 3  # completed
    length: int = 4


CONSTANT, COUNT, VALUE, STATUS = Constant(), Count(), SceneValue(), Status()
SETTING, SHAPE, VARIANT = Setting(), Shape(), Variant()
FIELD, TAG, LIVE = Field(), Tag(), Live()
MATERIAL_VARIANTS: tuple[int, ...] = tuple(getattr(VARIANT, name) for name in MATERIALS)
SOLID_VARIANTS = sum(bit for material, bit in enumerate(MATERIAL_VARIANTS) if material not in FLUIDS)


def has_solid(variant: int) -> bool:
    """Returns whether a kernel of this variant (bits of `Variant`) has particles with a deformation gradient."""
    return variant & SOLID_VARIANTS != 0


def is_only_solid(variant: int, kind: int) -> bool:
    """Returns whether the only solid of a kernel of this variant is that of bit `kind`."""
    return variant & SOLID_VARIANTS == kind


def lame_parameters(config: MpmConfig) -> tuple[float, float]:
    """(mu, lambda) in Pa from Young's modulus and Poisson's ratio."""
    modulus, ratio = config.youngs_modulus_pa, config.poisson_ratio
    return modulus / (2 * (1 + ratio)), modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))


def sand_sine(config: MpmConfig) -> float:
    """Returns the sine of the friction angle."""
    return float(np.sin(np.deg2rad(config.sand_friction_angle_deg)))


def sand_alpha(config: MpmConfig) -> float:
    """Returns the slope of the Drucker-Prager cone that matches Mohr-Coulomb in triaxial compression."""
    sine = np.sin(np.deg2rad(config.sand_friction_angle_deg))
    return float(np.sqrt(2 / 3) * 2 * sine / (3 - sine))


def constants(config: MpmConfig, unit_density: float | None = None) -> np.ndarray:
    """A row of what the laws read, float32 [Constant.length]; masses are in units of `unit_density`."""
    shear, bulk = lame_parameters(config)
    out = np.zeros(CONSTANT.length, np.float32)
    out[CONSTANT.shear] = shear
    out[CONSTANT.bulk] = bulk
    out[CONSTANT.density] = config.density_kg_m3
    out[CONSTANT.mass] = config.density_kg_m3 / (unit_density or config.density_kg_m3)
    out[CONSTANT.sand_alpha] = sand_alpha(config)
    out[CONSTANT.sand_sine] = sand_sine(config)
    out[CONSTANT.hardening] = config.snow_hardening
    out[CONSTANT.snow_smallest] = 1 - config.snow_critical_compression
    out[CONSTANT.snow_largest] = 1 + config.snow_critical_stretch
    out[CONSTANT.maximum_hardening] = config.choices.snow_maximum_hardening
    out[CONSTANT.water_tension] = config.water_tension
    out[CONSTANT.viscosity] = config.water_viscosity_pa_s
    out[CONSTANT.grain] = config.sand_grain_diameter_m * np.sqrt(2 * config.density_kg_m3 / SOLID_FRACTION)
    return out


def material_laws(scenes: Sequence[Scene], config: MpmConfig) -> tuple[np.ndarray, np.ndarray]:
    """The different rows of constants, float32 [rows, K], and the row of each particle, int32 [N of all scenes].

    What a scene's material_parameters leave open (a name, or NaN for a particle) is the config's. The first row is
    the config's own.
    Raises: ConfigError for a value that MpmConfig refuses.
    """
    if not any(scene.material_parameters for scene in scenes):  # to sort a million rows takes seconds
        return constants(config, config.density_kg_m3)[None], np.zeros(sum(s.particle_count for s in scenes), np.int32)
    own = {name: np.float32(getattr(config, name)) for name in MATERIAL_PARAMETERS}
    columns = [
        np.concatenate(
            [
                np.asarray(scene.material_parameters.get(name, np.full(scene.particle_count, own[name])), np.float32)
                for scene in scenes
            ]
        )
        for name in MATERIAL_PARAMETERS
    ]
    values = np.stack(columns, axis=1)
    values = np.where(np.isnan(values), np.array([own[name] for name in MATERIAL_PARAMETERS], np.float32), values)
    given, row = np.unique(values, axis=0, return_inverse=True)
    laws = [constants(config, config.density_kg_m3)]
    rows = np.zeros(len(given), np.int32)
    for index, values in enumerate(given):
        changed: dict[str, Any] = {
            name: float(value) for name, value in zip(MATERIAL_PARAMETERS, values, strict=True) if value != own[name]
        }
        if changed:
            rows[index] = len(laws)
            laws.append(constants(dataclasses.replace(config, **changed), config.density_kg_m3))
    return np.stack(laws), rows[row.reshape(-1)]
