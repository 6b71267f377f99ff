"""Contact with obstacles against closed forms: free flight from a surface, and Coulomb friction on it.

Each case is a block of particles at a surface, a wide sheet or a flat face of a closed body, at an offset from nodes.
Block, surface and gravity are turned together. Lengths are in cells, times in seconds.
Shape legend: T frames, N particles.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh

from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, PAPER_MATERIALS, SAND, SNOW
from hgn.scene.rotation import euler_rotation, rotate
from hgn.scene.scene import Obstacle, Scene
from tools.scenes import filled, random_places, with_friction
from tools.stability.row import Row, within
from tools.stability.solver_scenes import ORIENTATIONS, positions

DOMAIN_CELLS = 32
GRAVITY = 9.8  # m/s²
FRAME_RATE_HZ = 120.0
OFFSETS = (0.0, 0.1, 0.2, 0.3, 0.36, 0.41, 0.5, 0.7, 0.8, 0.9)  # of a surface from a node, in cells
GAPS = (0.25, 0.5, 0.85, 1.2)  # between a sheet and the block below it
LEAVING_SPEEDS = (0.3, 1.0, 3.0)  # m/s
LEAVING_CELLS = 8  # largest distance that the fastest blocks move
FRICTIONS = (0.1, 0.3, 0.5)
SLOPE_DEG = 35.0
FLIGHT_ERROR = 0.02  # fraction of the distance of free flight
FRICTION_ERRORS = {SAND: 0.05, SNOW: 0.10}
FLYING_CELLS, SLIDING_CELLS, FALLING_CELLS = (3.0, 2.0, 3.0), (5.0, 2.0, 5.0), (7.0, 3.0, 7.0)  # of blocks
START_CELLS = -9.0  # start of sliding blocks: up the slope from the middle
SETTLING_S, SLIDING_S = 0.3, 0.2  # until a block slides steadily, and how long it is then measured
# Initial speed down the slope, m/s. Friction opposes each particle's own motion. Without this speed, friction on
# particles that spread across the slope would not act along it.
SLIDING_SPEED = 0.5
FALLING_S = 0.6
HANGING_S = 0.2  # time in which free particles fall three cells
BELOW_CELLS = 2.0  # distance below a sheet within which particles hang on it
RIM_CELLS = 0.5  # width of the rim of a sheet, over which snow hangs down
QUAD = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


@dataclass(frozen=True)
class Setting:
    """A surface `offset` cells above the node in the middle of the domain, turned about this node."""

    offset: float
    turn: str = "aligned"
    cell_size: float = 1 / 16  # so that blocks slide 0.9 m and fall 0.3 m within the domain

    def place(self, place_N3: np.ndarray) -> np.ndarray:
        """Converts cells relative to the middle of the surface to domain units."""
        turned = rotate(np.asarray(place_N3, np.float64) + np.array([0, self.offset, 0]), self.rotation)
        return np.asarray((turned + DOMAIN_CELLS / 2) * self.cell_size)

    @property
    def rotation(self) -> np.ndarray:
        return euler_rotation(ORIENTATIONS[self.turn])


def sheet(setting: Setting, half: float = 40.0) -> Obstacle:
    """Returns a square sheet, by default larger than the domain."""
    corner = np.array([[-half, 0, -half], [half, 0, -half], [half, 0, half], [-half, 0, half]])
    return Obstacle("sheet", setting.place(corner), QUAD, False)


def body(setting: Setting) -> Obstacle:
    """Returns a closed box whose upper face is the surface."""
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
    """Returns a block with its corner at `low`, in cells from the middle of the surface; vectors turn with it."""
    turned_velocity, turned_gravity = rotate(np.array([velocity, gravity]), setting.rotation)
    domain_size = (DOMAIN_CELLS * setting.cell_size,) * 3
    return filled(
        material, setting.place(random_places(size) + np.array(low)), turned_velocity, obstacles=obstacles,
        domain_size=domain_size, cell_size=setting.cell_size, gravity=tuple(turned_gravity.tolist()),
    )  # fmt: skip


def centres(setting: Setting, outcome: Simulated | SceneFailure) -> np.ndarray:
    """Returns the block's centre along the surface's axes at each frame, m, float64 [T, 3]."""
    return np.asarray(rotate(positions(outcome).astype(np.float64).mean(axis=1), setting.rotation.T))


def flight_errors(
    cases: Sequence[tuple[Setting, int]], config: MpmConfig, seconds: float = 0.25
) -> list[dict[str, float]]:
    """Returns the largest relative error of the distance flown, for each setting and material.

    `below`: blocks fall from GAPS below a sheet. `leaving`: blocks leave it at LEAVING_SPEEDS without gravity.
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
    """Lets blocks fall onto a smaller sheet; returns the fraction of particles that hang below it.

    Particles hang if they are just below the sheet after FALLING_S, and still are HANGING_S later.
    """
    width, _, depth = FALLING_CELLS
    low, half, down = (-width / 2, 1.5, -depth / 2), width / 3, (0.0, -GRAVITY, 0.0)
    scenes = [block(at, kind, low, FALLING_CELLS, (sheet(at, half),), gravity=down) for at, kind in cases]
    checked = [round(FALLING_S * FRAME_RATE_HZ), round((FALLING_S + HANGING_S) * FRAME_RATE_HZ)]
    fractions = []
    for (setting, _), outcome in zip(cases, simulate(scenes, config, 1 + checked[1], FRAME_RATE_HZ), strict=True):
        middle = rotate(setting.place(np.zeros((1, 3))), setting.rotation.T)
        hangs = []
        for position_N3 in positions(outcome)[checked].astype(np.float64):
            x_N, y_N, z_N = ((rotate(position_N3, setting.rotation.T) - middle) / setting.cell_size).T
            beside_N = np.maximum(np.abs(x_N), np.abs(z_N))
            hangs.append((beside_N < half - RIM_CELLS) & (y_N < 0) & (y_N > -BELOW_CELLS))
        fractions.append(float(np.all(hangs, axis=0).mean()))
    return fractions


def acting_frictions(cases: Sequence[tuple[Setting, str, int]], friction: float, config: MpmConfig) -> list[float]:
    """Returns the Coulomb coefficient that brakes a sliding block: missing acceleration over pressing force.

    The block slides on a sheet, a body or the domain's floor, which is aligned with the grid; gravity is tilted.
    """
    sine, cosine = math.sin(math.radians(SLOPE_DEG)), math.cos(math.radians(SLOPE_DEG))
    gravity = (GRAVITY * sine, -GRAVITY * cosine, 0.0)
    scenes = []
    for setting, surface, material in cases:
        obstacles = {"sheet": (sheet(setting),), "body": (body(setting),), "floor": ()}[surface]
        up = 0.5 if obstacles else 0.5 + config.wall_cells - 1 - DOMAIN_CELLS / 2
        low = (START_CELLS - SLIDING_CELLS[0] / 2, up, -SLIDING_CELLS[2] / 2)
        scene = block(setting, material, low, SLIDING_CELLS, obstacles, (SLIDING_SPEED, 0.0, 0.0), gravity)
        scenes.append(dataclasses.replace(with_friction(scene, friction), wall_friction=(0.0, friction, 0.0)))
    first = round(SETTLING_S * FRAME_RATE_HZ)
    frames = 1 + round((SETTLING_S + SLIDING_S) * FRAME_RATE_HZ)
    acting = []
    for (setting, _, _), outcome in zip(cases, simulate(scenes, config, frames, FRAME_RATE_HZ), strict=True):
        way = centres(setting, outcome)[first:]
        time = np.arange(len(way)) / FRAME_RATE_HZ
        acceleration = 2 * np.polyfit(time, way, 2)[0]
        acting.append(float((GRAVITY * sine - acceleration[0]) / (GRAVITY * cosine + acceleration[1])))
    return acting


def contacts(config: MpmConfig) -> Iterator[Row]:
    """Yields rows of free flight, adhesion and friction, each the worst of all OFFSETS, by orientation and material."""
    settings = [Setting(offset, turn) for turn in ORIENTATIONS for offset in OFFSETS]
    places = [(setting, material) for setting in settings for material in range(len(PAPER_MATERIALS))]
    for (turn, kind), errors in _grouped(places, flight_errors(places, config)).items():
        for name in ("below", "leaving"):
            worst, case = max(error[name] for error in errors), f"contact, {name} a sheet {turn}, {MATERIALS[kind]}"
            yield within(case, FLIGHT_ERROR, worst, "largest error, as a fraction of the distance of free flight")
    for (turn, kind), fractions in _grouped(places, glued_below(places, config)).items():
        case = f"contact, glued below a sheet {turn}, {MATERIALS[kind]}"
        yield within(case, 0.0, max(fractions), "largest fraction of the particles")
    for surface in ("sheet", "body", "floor"):
        own = [Setting(0.0)] if surface == "floor" else settings
        places = [(setting, material) for setting in own for material in FRICTION_ERRORS]
        for friction in FRICTIONS:
            found = acting_frictions([(setting, surface, kind) for setting, kind in places], friction, config)
            for (turn, kind), acting in _grouped(places, found).items():
                worst = max(acting, key=lambda value: abs(value - friction))
                held = abs(worst / friction - 1) <= FRICTION_ERRORS[kind]
                beyond = f"mean {np.mean(acting):.4g}; must be within {FRICTION_ERRORS[kind]:.0%}"
                case = f"contact, friction on a {surface} {turn}, {MATERIALS[kind]}"
                yield Row(case, friction, worst, held, beyond)


def _grouped(places: Sequence[tuple[Setting, int]], values: Sequence[Any]) -> dict[tuple[str, int], list[Any]]:
    """Groups values by orientation and material."""
    groups: dict[tuple[str, int], list[Any]] = {}
    for (setting, material), value in zip(places, values, strict=True):
        groups.setdefault((setting.turn, material), []).append(value)
    return groups
