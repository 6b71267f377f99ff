"""Positions of numbers in the small arrays that the host passes to the solver's kernels, and the laws' constants.

Kernels take few arrays instead of many scalars, because each argument of a launch takes time.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from hgn.config import MpmConfig
from hgn.scene.material import FLUIDS, MATERIAL_PARAMETERS, MATERIALS
from hgn.scene.scene import Scene

BLOCK = 4  # nodes along the side of a block of the grid
BLOCK_NODES = BLOCK**3
SOLID_FRACTION = 0.6  # volume fraction of grains in sand; the density of grains is that of sand divided by it


class Constant(NamedTuple):
    """Positions of the laws' constants in a row of the array that kernels read."""

    shear: int = 0  # mu, Pa
    bulk: int = 1  # Lamé's lambda, Pa
    density: int = 2
    sand_alpha: int = 3  # slope of the Drucker-Prager cone
    hardening: int = 4
    snow_smallest: int = 5  # smallest and largest singular value of elastic snow
    snow_largest: int = 6
    maximum_hardening: int = 7
    mass: int = 8  # (mass of a particle) / (its mass at the config's density)
    sand_sine: int = 9  # sine of the friction angle
    water_tension: int = 10  # fraction of the tension that stretched water bears
    viscosity: int = 11  # viscosity of water, Pa s
    grain: int = 12  # grains of sand, d sqrt(2 rho_grain), sqrt(kg / m): see constitutive
    length: int = 13


class Count(NamedTuple):
    """Positions in the int64 state of each scene: reported counts, then numbers that control the scene."""

    substeps: int = 0
    transfers: int = 1
    water_volume_floors: int = 2
    singular_value_floors: int = 3
    hardening_caps: int = 4
    plastic_volume_bounds: int = 5
    position_clamps: int = 6
    surface_projections: int = 7
    status: int = 8
    frame_substeps: int = 9  # number of substeps in the present frame
    # Maxima of the last step as bits of a float32 >= 0. Such bits have the order of the numbers. A GPU has no atomic
    # maximum of floats.
    stiffness_bits: int = 10  # bits of (3 lambda + 2 mu) / density, m²/s²
    speed_square_bits: int = 11
    held_stiffness_bits: int = 12  # the same in this interval, of particles with longer steps of their own
    length: int = 13


REPORTED = Count._fields[:8]


class SceneValue(NamedTuple):
    """Positions in the float32 state of each scene."""

    remaining: int = 0  # remaining time of the frame, s
    time_step: int = 1  # time of the present substep, s; 0 while the scene idles
    smallest_time_step: int = 2
    least_stiffness: int = 3  # m²/s²; largest stiffness at rest over materials that never get softer
    gravity: int = 4  # 4, 5, 6
    substeps_ahead: int = 7  # estimated number of substeps after the present one
    largest_speed_square: int = 8  # largest square of speed before the present step
    interval: int = 9  # planned time from the last transfer to the next, s
    interval_elapsed: int = 10  # time of the interval including the present substep, s
    interval_remaining: int = 11  # time after the present substep, s; at 0 particles take velocities from nodes
    begins: int = 12  # 1 if the present substep is the first of its interval, else 0
    stability_fraction: int = 13  # longest substep as a fraction of the stability limit
    gravity_time: int = 14  # time of gravity in the present substep, s: see mls_mpm
    water_density: int = 15  # number of particles per cell at rest; 0 if unknown
    wall_friction: int = 16  # 16, 17, 18: friction of the domain's walls normal to x, y, z
    frame_end: int = 19  # time of the end of the present frame, s
    stiffness: int = 20  # largest stiffness in the step before, m²/s²
    last_interval: int = 21  # length of the interval before, s
    fallen: int = 22  # time of gravity in this interval before the present substep, s
    synchronised: int = 23  # 1 if the interval's first and last substep are half as long as the others, else 0
    whole_step: int = 24  # length of the other substeps, s
    catch_up: int = 25  # time by which strain is behind when an interval begins, s; negative if ahead
    nodes: int = 26  # 26, 27, 28: numbers of nodes along the axes
    high: int = 29  # 29, 30, 31: largest coordinates of a particle
    size: int = 32  # 32, 33, 34: size of the domain
    obstacle_speed: int = 35  # largest speed of obstacles, domain units per second
    length: int = 36


class Status(NamedTuple):
    running: int = 0
    not_finite: int = 1
    left_domain: int = 2
    too_many_substeps: int = 3
    waiting: int = 4  # not a scene, but the row of particles that enter later


class Setting(NamedTuple):
    """Positions in the float32 settings of a launch."""

    cell_size: int = 0
    inverse_cell_size: int = 1
    fixed_time_step: int = 2  # s; 0 for the adaptive rule
    fixed_substeps: int = 3  # number of substeps per frame, with a fixed time step
    density_relaxation: int = 4  # rate of relaxation of water's J to its density, 1/s
    low: int = 5  # smallest coordinate of a particle on each axis
    transfer_interval: int = 6  # s; 0 if every substep is a transfer
    leapfrog: int = 7  # 1 if velocities belong to the middle of an interval, 0 if to its end
    length: int = 8


class Shape(NamedTuple):
    """Positions in the int32 shape of a launch."""

    blocks: int = 0  # 0, 1, 2: along each axis, of the largest domain of the launch
    scene_blocks: int = 3
    all_blocks: int = 4  # number of blocks of all scenes
    wall_cells: int = 5
    maximum_substeps: int = 6
    ghosts: int = 7  # nodes of all scenes that sheets hide from particles near them: see collider
    ghost_begin: int = 8  # first of their second fields in the array of nodes
    bodies: int = 9  # indices in `contact` of the moving obstacles: see body_arrays
    second_fields: int = 10
    part_begin: int = 11  # first of the following: first particle of each (scene, part), and the end


class Variant(NamedTuple):
    """Bits of the variant of a kernel. A launch compiles only the features that its scenes need."""

    water: int = 1
    sand: int = 2
    snow: int = 4
    contact: int = 8
    taichi_elements: int = 16  # laws of sand and water as in Taichi Elements
    atomic: int = 32  # sums with atomics on a GPU; otherwise sums in parts, in order
    several_laws: int = 64  # particles of one material differ in their constants
    sweep: int = 128  # particles are stopped at triangles
    sheets: int = 256  # some nodes have two fields
    moving: int = 512  # obstacles move
    elastic: int = 1024
    rate_of_sand: int = 2048  # friction grows with the rate of flow
    each_step: int = 4096  # of the team kernel: each step is an interval of its own
    moving_sheets: int = 8192  # sheets move, so that all nodes of their scenes have two fields
    parts: int = 16384  # factor of the number of parts; must be the last


class BodyHead(NamedTuple):
    """Positions in the integers of a moving obstacle."""

    closed: int = 0
    state: int = 1  # start of its numbers in the array `pose`: see BodyState
    keys: int = 2  # number of keyframes
    samples: int = 3  # index of the first sample in `contact_normal`
    shape: int = 4  # 4, 5, 6: number of samples along the axes
    lists: int = 7  # index in `contact` of the table of lists of triangles
    cells: int = 8  # 8, 9, 10: shape of this table
    length: int = 11


class BodyState(NamedTuple):
    """Positions in the float32 numbers of a moving obstacle. Lengths are in cells."""

    begin: int = 0  # pose when the present interval began: position of the pivot, then the axes of the frame
    end: int = 12  # pose after the present substep
    turn: int = 24  # 24, 25, 26: angular velocity in the present interval, rad/s
    velocity: int = 27  # 27, 28, 29: of the pivot
    origin: int = 30  # 30, 31, 32: from the frame's origin to the pivot
    friction: int = 33
    cell_mass: int = 34  # mass of a full cell
    bearing: int = 35  # height above a thin closed body up to which nodes stop motion
    key: int = 36  # index of the last keyframe before the end pose
    first_key: int = 37


class Key(NamedTuple):
    """Positions in the float32 numbers of a keyframe. Turn, velocity and speed are those until the next one."""

    time: int = 0
    place: int = 1
    axes: int = 4
    turn: int = 13
    velocity: int = 16
    speed: int = 19  # largest speed of the obstacle's points, domain units per second
    length: int = 20


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
    origin: int = 2  # index of the particle in its scene
    length: int = 3


class Live(NamedTuple):
    """Positions in the int32 state of a scene, which its team shares."""

    blocks: int = 0  # number of touched blocks in this interval
    cursor: int = 1  # number of particles that are already in the order
    copy: int = 2  # which of the two copies of the particles is valid
    frames: int = 3  # number of completed frames
    length: int = 4


CONSTANT, COUNT, VALUE, STATUS = Constant(), Count(), SceneValue(), Status()
SETTING, SHAPE, VARIANT = Setting(), Shape(), Variant()
FIELD, TAG, LIVE = Field(), Tag(), Live()
HEAD, STATE, KEY = BodyHead(), BodyState(), Key()
MATERIAL_VARIANTS: tuple[int, ...] = tuple(getattr(VARIANT, name) for name in MATERIALS)
SOLID_VARIANTS = sum(bit for material, bit in enumerate(MATERIAL_VARIANTS) if material not in FLUIDS)


def has_solid(variant: int) -> bool:
    """Returns whether a kernel of this variant has particles with a deformation gradient."""
    return variant & SOLID_VARIANTS != 0


def is_only_solid(variant: int, kind: int) -> bool:
    """Returns whether the only solid of a kernel of this variant is the material with bit `kind`."""
    return variant & SOLID_VARIANTS == kind


def lame_parameters(config: MpmConfig) -> tuple[float, float]:
    """Returns (mu, lambda) in Pa from Young's modulus and Poisson's ratio."""
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
    """Returns a row of the laws' constants, float32 [Constant.length]. Masses are in units of `unit_density`."""
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
    """Returns the different rows of constants, float32 [rows, K], and each particle's row, int32 [N of all scenes].

    A constant that a scene's material_parameters do not set (a missing name, or NaN) is the config's. The first row is
    the config's. Raises: ConfigError for a value that MpmConfig refuses.
    """
    if not any(scene.material_parameters for scene in scenes):  # sorting a million rows takes seconds
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
