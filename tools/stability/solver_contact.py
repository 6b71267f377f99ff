"""Contact with obstacles against closed forms: what leaves a surface leaves as in free flight, what slides is braked by
Coulomb's law, at any offset of the surface from the grid's nodes and in any orientation.

Each case is a block of particles at a wide sheet or a flat face of a closed body, turned as a whole together with
gravity. Lengths are in cells, times in seconds.
Shape legend: T frames, N particles.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, PAPER_MATERIALS, SAND, SNOW
from hgn.scene.rotation import euler_rotation, rotate
from hgn.scene.scene import Obstacle, Scene
from tools.scenes import filled, random_places
from tools.stability.row import Row, within
from tools.stability.solver_scenes import ORIENTATIONS, positions

DOMAIN_CELLS = 32
GRAVITY = 9.8  # m/s²
FRAME_RATE_HZ = 120.0
OFFSETS = (0.0, 0.1, 0.2, 0.3, 0.36, 0.41, 0.5, 0.7, 0.8, 0.9)  # of a surface above a node, in cells
GAPS = (0.25, 0.5, 0.85, 1.2)  # between a sheet and the block below it
LEAVING_SPEEDS = (0.3, 1.0, 3.0)  # m/s
LEAVING_CELLS = 8  # that the fastest go at most
FRICTIONS = (0.1, 0.3, 0.5)
SLOPE_DEG = 35.0
FLIGHT_ERROR = 0.02  # of the way of free flight, at most
FRICTION_ERRORS = {SAND: 0.05, SNOW: 0.10}
FLYING_CELLS, SLIDING_CELLS, FALLING_CELLS = (3.0, 2.0, 3.0), (5.0, 2.0, 5.0), (7.0, 3.0, 7.0)  # of blocks
START_CELLS = -9.0  # up the slope from the middle, where sliding blocks begin
SETTLING_S, SLIDING_S = 0.3, 0.2  # until a block that came to lie on a surface slides steadily; then
# at first down the slope: friction opposes each particle's own motion, and what spreads across the slope is not braked
# along it
SLIDING_SPEED = 0.5  # m/s
FALLING_S = 0.6
HANGING_S = 0.2  # in which what is free falls three cells more
BELOW_CELLS = 2.0  # a sheet: what hangs there
RIM_CELLS = 0.5  # snow that hangs over the rim of a sheet reaches so far below it
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


@dataclass(frozen=True)
class Setting:
    """Where a surface lies: `offset` cells above the node in the middle of the domain, turned about it."""

    offset: float
    turn: str = "aligned"
    cell_size: float = 1 / 16  # with which blocks slide 0.9 m and fall 0.3 m within the domain

    def place(self, place_N3: np.ndarray) -> np.ndarray:
        """From cells beside, above and before the middle of the surface to domain units."""
        turned = rotate(np.asarray(place_N3, np.float64) + np.array([0, self.offset, 0]), self.rotation)
        return np.asarray((turned + DOMAIN_CELLS / 2) * self.cell_size)

    @property
    def rotation(self) -> np.ndarray:
        return euler_rotation(ORIENTATIONS[self.turn])


def sheet(setting: Setting, half: float = 40.0) -> Obstacle:
    """A square sheet; without `half` it reaches beyond the domain."""
    corner = np.array([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]])
    return Obstacle("sheet", setting.place(corner), QUAD, False)


def body(setting: Setting) -> Obstacle:
    """A closed box whose upper face is the surface."""
    box = trimesh.creation.box(bounds=[(-40, -40, -40), (40, 0, 40)])
    return Obstacle("body", setting.place(box.vertices), np.asarray(box.faces, np.int32), True)


def block(
    setting: Setting,
    material: int,
    low: tuple[float, float, float],
    size: tuple[float, float, float],
    obstacles: tuple[Obstacle, ...],
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Scene:
    """A block from `low` on, in cells about the middle of the surface, eight particles a cell; vectors turn with it."""
    turned_velocity, turned_gravity = rotate(np.array([velocity, gravity]), setting.rotation)
    domain_size = (DOMAIN_CELLS * setting.cell_size,) * 3
    return filled(
        material, setting.place(random_places(size) + np.array(low)), turned_velocity, obstacles=obstacles,
        domain_size=domain_size, cell_size=setting.cell_size, gravity=tuple(turned_gravity.tolist()),
    )  # fmt: skip


def centres(setting: Setting, outcome: Simulated | SceneFailure) -> np.ndarray:
    """The block's centre along the surface's own axes at each frame, m, float64 [T, 3]."""
    return np.asarray(rotate(positions(outcome).astype(np.float64).mean(axis=1), setting.rotation.T))


def flight_errors(
    cases: Sequence[tuple[Setting, int]], config: MpmConfig, seconds: float = 0.25
) -> list[dict[str, float]]:
    """Of each setting and material the largest error of the way, as a fraction of that of free flight: of what is
    `below` a sheet under gravity, over all GAPS, and of what is `leaving` it at LEAVING_SPEEDS without gravity.
    """
    frames = 1 + round(seconds * FRAME_RATE_HZ)
    scenes, ways = [], []
    width, height, depth = FLYING_CELLS
    worst = [{"below": 0.0, "leaving": 0.0} for _ in cases]
    for errors, (setting, material) in zip(worst, cases, strict=True):
        surface = (sheet(setting),)
        for gap in GAPS:
            low = (-width / 2, -gap - height, -depth / 2)
            scenes.append(block(setting, material, low, FLYING_CELLS, surface, gravity=(0.0, -GRAVITY, 0.0)))
            ways.append((errors, setting, "below", frames - 1, -GRAVITY * seconds**2 / 2))
        for speed in LEAVING_SPEEDS:
            low = (-width / 2, 0.3, -depth / 2)
            scenes.append(block(setting, material, low, FLYING_CELLS, surface, (0.0, speed, 0.0)))
            last = min(frames - 1, int(FRAME_RATE_HZ * LEAVING_CELLS * setting.cell_size / speed))
            ways.append((errors, setting, "leaving", last, speed * last / FRAME_RATE_HZ))
    outcomes = simulate(scenes, config, frames, FRAME_RATE_HZ)
    for outcome, (errors, setting, kind, last, way) in zip(outcomes, ways, strict=True):
        centre = centres(setting, outcome)[:, 1]
        errors[kind] = max(errors[kind], abs(float(centre[last] - centre[0]) / way - 1))
    return worst


def glued_below(cases: Sequence[tuple[Setting, int]], config: MpmConfig) -> list[float]:
    """Of a block of each material that falls onto a sheet smaller than itself, the fraction that is just below it
    FALLING_S later and still there after HANGING_S: pieces that swing in below its rim fall on.
    """
    width, _, depth = FALLING_CELLS
    low, half, down = (-width / 2, 1.5, -depth / 2), width / 3, (0.0, -GRAVITY, 0.0)
    scenes = [block(at, kind, low, FALLING_CELLS, (sheet(at, half),), gravity=down) for at, kind in cases]
    looks = [round(FALLING_S * FRAME_RATE_HZ), round((FALLING_S + HANGING_S) * FRAME_RATE_HZ)]
    fractions = []
    for (setting, _), outcome in zip(cases, simulate(scenes, config, 1 + looks[1], FRAME_RATE_HZ), strict=True):
        middle = rotate(setting.place(np.zeros((1, 3))), setting.rotation.T)
        hangs = []
        for position_N3 in positions(outcome)[looks].astype(np.float64):
            x_N, y_N, z_N = ((rotate(position_N3, setting.rotation.T) - middle) / setting.cell_size).T
            beside_N = np.maximum(np.abs(x_N), np.abs(z_N))
            hangs.append((beside_N < half - RIM_CELLS) & (y_N < 0) & (y_N > -BELOW_CELLS))
        fractions.append(float(np.all(hangs, axis=0).mean()))
    return fractions


def acting_frictions(cases: Sequence[tuple[Setting, str, int]], friction: float, config: MpmConfig) -> list[float]:
    """The Coulomb coefficient that acts on a block of a material that slides on a sheet, a body or the domain's floor
    (which lies as the grid does), as gravity points down a slope: what its centre's acceleration lacks, over the force
    that presses it on.
    """
    sine, cosine = math.sin(math.radians(SLOPE_DEG)), math.cos(math.radians(SLOPE_DEG))
    gravity = (GRAVITY * sine, -GRAVITY * cosine, 0.0)
    scenes = []
    for setting, surface, material in cases:
        obstacles = {"sheet": (sheet(setting),), "body": (body(setting),), "floor": ()}[surface]
        up = 0.5 if obstacles else 0.5 + config.wall_cells - 1 - DOMAIN_CELLS / 2
        low = (START_CELLS - SLIDING_CELLS[0] / 2, up, -SLIDING_CELLS[2] / 2)
        scene = block(setting, material, low, SLIDING_CELLS, obstacles, (SLIDING_SPEED, 0.0, 0.0), gravity)
        scenes.append(dataclasses.replace(scene, wall_friction=(0.0, friction, 0.0)))
    config = dataclasses.replace(config, collider_friction=friction)
    first = round(SETTLING_S * FRAME_RATE_HZ)
    frames = 1 + round((SETTLING_S + SLIDING_S) * FRAME_RATE_HZ)
    acting = []
    for (setting, _, _), outcome in zip(cases, simulate(scenes, config, frames, FRAME_RATE_HZ), strict=True):
        way = centres(setting, outcome)[first:]
        time = np.arange(len(way)) / FRAME_RATE_HZ
        acceleration = 2 * np.polyfit(time, way, 2)[0]
        acting.append(float((GRAVITY * sine - acceleration[0]) / (GRAVITY * cosine + acceleration[1])))
    return acting


def contacts(config: MpmConfig) -> list[Row]:
    """Rows of the worst of all OFFSETS, for each orientation and material: free flight, friction, and what is glued."""
    rows = []
    settings = [Setting(offset, turn) for turn in ORIENTATIONS for offset in OFFSETS]
    places = [(setting, material) for setting in settings for material in range(len(PAPER_MATERIALS))]
    for (turn, kind), errors in _grouped(places, flight_errors(places, config)).items():
        for name in ("below", "leaving"):
            worst, case = max(error[name] for error in errors), f"contact, {name} a sheet {turn}, {MATERIALS[kind]}"
            rows.append(within(case, FLIGHT_ERROR, worst, "of the way of free flight, at most"))
    for (turn, kind), fractions in _grouped(places, glued_below(places, config)).items():
        case = f"contact, glued below a sheet {turn}, {MATERIALS[kind]}"
        rows.append(within(case, 0.0, max(fractions), "of the particles, at most"))
    for surface in ("sheet", "body", "floor"):
        own = [Setting(0.0)] if surface == "floor" else settings
        places = [(setting, material) for setting in own for material in FRICTION_ERRORS]
        for friction in FRICTIONS:
            found = acting_frictions([(setting, surface, kind) for setting, kind in places], friction, config)
            for (turn, kind), acting in _grouped(places, found).items():
                worst = max(acting, key=lambda value: abs(value - friction))
                held = abs(worst / friction - 1) <= FRICTION_ERRORS[kind]
                beyond = f"mean {np.mean(acting):.4g}; within {FRICTION_ERRORS[kind]:.0%} wanted"
                case = f"contact, friction on a {surface} {turn}, {MATERIALS[kind]}"
                rows.append(Row(case, friction, worst, held, beyond))
    return rows


def _grouped(places: Sequence[tuple[Setting, int]], values: Sequence[Any]) -> dict[tuple[str, int], list[Any]]:
    """What belongs to the offsets of each orientation and material."""
    groups: dict[tuple[str, int], list[Any]] = {}
    for (setting, material), value in zip(places, values, strict=True):
        groups.setdefault((setting.turn, material), []).append(value)
    return groups
