"""Published experiments: dam breaks, collapsing columns of sand, and the angle of repose.

A wall is at its innermost node that stops motion: node 2, and at the other end the third before the last. Material
fills its basin up to the walls, because it would creep into a gap. Sand lies on sheets. The friction of a column's
floor is what sand bears in simple shear: a rougher floor would brake the lowest cells by more than sand can bear.
Shape legend: T frames, N particles.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence

import numpy as np

from datagen.mpm.layout import sand_sine
from datagen.mpm.solver import simulate
from hgn.config import MpmConfig
from hgn.scene.material import SAND, WATER
from hgn.scene.scene import Obstacle, Scene
from tools.scenes import PARTICLES_PER_CELL, filled, random_places, with_friction
from tools.stability.row import Row, within
from tools.stability.solver_scenes import positions, rms_speed

GRAVITY = 9.8
WALL = 2.0  # cells from the near end of the domain to the wall
FAR_WALL = 3.0  # cells from the far end of the domain to the wall
SLAB = 3  # cells; the thinnest slab that fits between walls

# Martin and Moyce 1952, n² = 2, a = 2.25 in: time sqrt(2 g / a) t, front x / a
DAM = np.array(
    [(0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134), (4.034, 4.944), (4.418, 5.881)]
)
DAM_WIDTH = 0.2  # m; so small that the flow is slow compared with the speed of sound, 17 m/s
DAM_CELLS = (8, 16)
DAM_SPACE = 8  # width of the basin, in widths of the column
DAM_DEPTH = 1 / 16  # depth of water that defines the front, in widths of the column
DAM_LEADS, DAM_RESOLVED = 0.18, 0.05
DAM_RATE_HZ = 200.0

# water at rest between walls
REST_CELLS, REST_DEPTH = 6, 0.375  # m
REST_S, REST_RATE_HZ, REST_WITHIN = 20.0, 4.0, 0.005
SETTLED_S = 2.5  # time until the first waves are gone

# Quarters of round columns on a rough floor. Run-outs of Lube et al. 2004 and Lajeunesse et al. 2004 differ by up to a
# third; a run-out between them agrees with the experiments.
COLUMN_RADIUS = 0.5  # m, 200 default grains; the weight of the tallest column compresses it by 2 %
COLUMN_CELLS = 24  # cells per radius; fronts lack their last 2 to 2.5 cells
LOW_COLUMN_CELLS = 72  # cells per radius of columns that are wider than high, which run out less
COLUMN_DEPTH = 1 / 64  # depth of sand that defines its edge, in radii
COLUMN_WITHIN = 0.1
COLUMN_ASPECTS = (0.5, 1.0, 1.5, 2.5, 4.0)
COLUMN_SPACE = 1.6  # width of the basin, in expected final radii
COLUMN_TOP_CELLS = 2.5  # distance from the axis within which the height is measured
LUBE_ANGLE_DEG = 31.0  # angle of repose of the quartz sand of Lube et al. 2004
TIMES = 4.0  # time until all material is at rest, in sqrt(height / g); the experiments took about 3
STRAY = 1e-3  # fraction of the particles that may reach the walls of the basin

# a slope of sand on a rough platform, from which sand may run off
REPOSE_OTHERS_DEG = (20.0, 40.0)  # further friction angles
REPOSE_WITHIN_DEG = 3.0  # a slope this far below the friction angle stands; steeper ones come to rest this close to it
REPOSE_STEEPER_DEG = 4.0  # steeper slopes start this far above it; if more, running sand would carry more with it
STANDS_DEG = 1.0  # largest change of a slope that counts as standing
REPOSE_LENGTH = 0.5  # length of the platform, m
REPOSE_CELLS = 24  # number of cells along the platform
REPOSE_TIMES = 24.0  # simulated time in sqrt(length / g)
PIT = 0.4  # depth of the pit below the platform, as a fraction of the platform's length
AT_REST = 1e-2  # largest root mean square speed that counts as rest, m/s


def dam_breaks(base: MpmConfig) -> Iterator[Row]:
    """Compares the front of a collapsing column of water with the experiment, at two resolutions."""
    fronts = []
    for cells in DAM_CELLS:
        path = _path(dam(cells), base, 2 + math.ceil(DAM[-1, 0] * math.sqrt(DAM_WIDTH / (2 * GRAVITY)) * DAM_RATE_HZ))
        time = np.arange(len(path)) / DAM_RATE_HZ * math.sqrt(2 * GRAVITY / DAM_WIDTH)
        front = np.interp(DAM[:, 0], time, [dam_front(position, cells) for position in path])
        fronts.append(front)
        beyond = "fronts " + ", ".join(f"{x:.2f} at {t:.2f} ({y:.2f})" for x, (t, y) in zip(front, DAM, strict=True))
        more = {"front": front.tolist(), "experiment": DAM.tolist()}
        worst = float(np.abs(front / DAM[:, 1] - 1).max())
        touched = _strays(path * (cells / DAM_WIDTH), DAM_SPACE * cells, (0,))
        held = worst <= DAM_LEADS and not touched
        yield Row(f"dam break, {cells} cells wide", DAM_LEADS, worst, held, beyond + touched, more)
    change = float(np.abs(fronts[1] / fronts[0] - 1).max())
    name = f"dam break, {DAM_CELLS[0]} against {DAM_CELLS[1]} cells"
    yield within(name, DAM_RESOLVED, change, "largest change of the front")


def dam(cells: int) -> Scene:
    """Returns water `cells` wide and twice as high, three cells thick, left of an empty basin."""
    return basin(WATER, (cells, 2 * cells, SLAB), (DAM_SPACE * cells, 3 * cells, SLAB), DAM_WIDTH / cells)


def dam_front(position_N3: np.ndarray, cells: int) -> float:
    """Returns the distance up to which the water is DAM_DEPTH deep, in widths; depths are from particle counts."""
    place = position_N3[:, 0] * cells / DAM_WIDTH - WALL
    depth = np.bincount(np.maximum(np.floor(place).astype(int), 0)) / (SLAB * PARTICLES_PER_CELL)
    return edge(depth, DAM_DEPTH * cells) / cells


def rest(base: MpmConfig) -> Iterator[Row]:
    """Measures the level of water at rest, filled at random."""
    scene = basin(WATER, (REST_CELLS,) * 3, (REST_CELLS, REST_CELLS + 3, REST_CELLS), REST_DEPTH / REST_CELLS)
    path = _path(scene, base, 1 + round(REST_S * REST_RATE_HZ), REST_RATE_HZ)
    level = 2 * (path[:, :, 1].mean(axis=1) / scene.cell_size - WALL) / REST_CELLS
    change = level[round(SETTLED_S * REST_RATE_HZ) :] / level[0] - 1
    beyond = f"{change[0]:+.2%} after {SETTLED_S:g} s, {change[-1]:+.2%} after {REST_S:g} s"
    worst = float(change[np.abs(change).argmax()])
    yield within("level of water at rest, random filling", REST_WITHIN, worst, beyond)


def columns(base: MpmConfig) -> Iterator[Row]:
    """Measures run-out and height of collapsed columns of several aspects."""
    for aspect in COLUMN_ASPECTS:
        yield from column_rows(aspect, base, LOW_COLUMN_CELLS if aspect < 1 else COLUMN_CELLS)


def column_rows(aspect: float, base: MpmConfig, cells: int) -> Iterator[Row]:
    """Yields run-out and height at the axis, in initial radii, of a column of `cells` in radius."""
    scene = with_friction(column(aspect, cells), sand_sine(base))
    duration = TIMES * math.sqrt(aspect * COLUMN_RADIUS / GRAVITY)
    angle_deg = base.sand_friction_angle_deg
    path = _path(scene, base, 41, 40 / duration)
    place = _above_floor(path[-1], scene.cell_size)
    distance = np.hypot(place[:, 0], place[:, 2])
    many = np.bincount(np.floor(distance).astype(int))
    depth = many / PARTICLES_PER_CELL / (math.pi / 4 * np.diff(np.arange(len(many) + 1) ** 2))
    run_out = edge(depth, COLUMN_DEPTH * cells) / cells - 1
    height = float(np.quantile(place[distance < COLUMN_TOP_CELLS, 1], 0.95)) / 0.95 / cells
    space = math.ceil(COLUMN_SPACE * lube(aspect) * cells)
    touched = _strays(path / scene.cell_size, space, (0, 2))
    name = f"sand column, aspect {aspect:g}, mohr coulomb, {angle_deg:g} degrees, {cells} cells in radius"
    if base.sand_grain_diameter_m > 0:
        name += f", {COLUMN_RADIUS / base.sand_grain_diameter_m:.3g} grains"
    for what, value, published in (("run-out", run_out, run_outs(aspect)), ("height", height, heights(aspect))):
        expected = min(max(value, min(published)), max(published))
        change = value / expected - 1
        beyond = f"{change:+.1%}; speed at the end {rms_speed(path[-2:], 40 / duration):.2g} m/s{touched}"
        more = {"cells": cells, "particles": scene.particle_count, "published": sorted(set(published))}
        yield Row(f"{name}, {what}", expected, value, abs(change) <= COLUMN_WITHIN and not touched, beyond, more)


def column(aspect: float, cells: int) -> Scene:
    """Returns a quarter of a round column of sand, `cells` in radius, on a rough floor between two smooth walls."""
    space = math.ceil(COLUMN_SPACE * lube(aspect) * cells)
    scene = basin(SAND, (cells, aspect * cells, cells), (space, aspect * cells + 2, space), COLUMN_RADIUS / cells, 2)
    place_N3 = _above_floor(scene.position_N3, scene.cell_size)
    return scene.selected(np.hypot(place_N3[:, 0], place_N3[:, 2]) < cells)


def lube(aspect: float) -> float:
    """Returns the final radius of a column, in initial radii (Lube et al. 2004)."""
    return 1 + (1.24 * aspect if aspect < 1.7 else 1.6 * math.sqrt(aspect))


def run_outs(aspect: float) -> tuple[float, ...]:
    """Returns published growths of a column's radius, in initial radii.

    Lube et al. 2004; between aspects of 0.74 and 3 also Lajeunesse et al. 2004, from the volume of cones 0.74 high.
    """
    return (lube(aspect) - 1, *((math.sqrt(3 * aspect / 0.74) - 1,) if 0.74 <= aspect < 3 else ()))


def heights(aspect: float) -> tuple[float, float]:
    """Returns published final heights at the axis, in initial radii.

    Glass beads (Lajeunesse et al. 2004); sand, salt and seeds (Lube et al. 2004), a power of the aspect from 1.7 on.
    """
    return min(aspect, 0.74), min(aspect, 0.88 * aspect ** (1 / 6))


def reposes(base: MpmConfig) -> Iterator[Row]:
    """Measures slopes of sand: those below the friction angle stand, steeper ones come to rest.

    The expected angle of repose is that of shear along the slope, in plane strain without a change of volume; for the
    default sand also that of Lube et al.
    """
    own = base.sand_friction_angle_deg
    for angle in sorted({own, *REPOSE_OTHERS_DEG}):
        for start in (angle - REPOSE_WITHIN_DEG, angle + REPOSE_STEEPER_DEG):
            before, after, speed = repose(angle, start, base, REPOSE_CELLS)
            beyond = f"{after - before:+.1f} degrees; at the end {speed:.2g} m/s rms"
            if start < angle:
                held = abs(after - before) <= STANDS_DEG
                yield Row(f"slope that stands, friction {angle:g} degrees", before, after, held, beyond)
                continue
            shears = math.degrees(math.atan(sand_sine(_sand(base, angle))))
            angles = [(f"angle of repose, friction {angle:g} degrees", shears)]
            if angle == own:
                angles.append((f"angle of repose, friction {angle:g} degrees, as quartz sand has it", LUBE_ANGLE_DEG))
            for name, expected in angles:
                held = abs(after - expected) <= REPOSE_WITHIN_DEG and speed < AT_REST
                yield Row(name, expected, after, held, beyond)


def repose(angle_deg: float, start_deg: float, base: MpmConfig, cells: int) -> tuple[float, float, float]:
    """Returns the slope of sand on a platform before and after, degrees, and its final rms speed, m/s."""
    scene = with_friction(platform(start_deg, cells), 1.0)
    rate_hz = 30 / (REPOSE_TIMES * math.sqrt(REPOSE_LENGTH / GRAVITY))
    path = _path(scene, _sand(base, angle_deg), 31, rate_hz)
    place = path / scene.cell_size - WALL - np.array([0.0, round(PIT * cells), 0.0])
    on = (place[-1, :, 1] > 0) & (place[-1, :, 0] < cells)
    return surface_slope(place[0], cells), surface_slope(place[-1, on], cells), rms_speed(path[-2:, on], rate_hz)


def platform(slope_deg: float, cells: int) -> Scene:
    """Returns a slope of sand from a smooth wall to the end of a rough platform, `cells` long, above a pit."""
    height = math.ceil(cells * math.tan(math.radians(slope_deg)))
    pit = round(PIT * cells)
    scene = basin(SAND, (cells, height, SLAB), (2 * cells, height + 2, SLAB), REPOSE_LENGTH / cells, pit)
    place = scene.position_N3.astype(np.float64) / scene.cell_size - WALL
    below = place[:, 1] - pit < (cells - place[:, 0]) * math.tan(math.radians(slope_deg))
    sheet = scene.obstacles[0]
    corner = sheet.vertex_V3.copy()
    corner[:, 0] = np.minimum(corner[:, 0], (WALL + cells) * scene.cell_size)
    return dataclasses.replace(scene.selected(below), obstacles=(dataclasses.replace(sheet, vertex_V3=corner),))


def surface_slope(place_N3: np.ndarray, cells: int) -> float:
    """Returns the slope of sand over the middle of a platform, degrees; places are in cells from its wall.

    The surface of a cell is extrapolated from the 0.9 quantile of heights: maxima and counts are too random.
    """
    column = np.floor(place_N3[:, 0]).astype(int)
    own = np.arange(round(0.15 * cells), round(0.85 * cells))
    surface = [np.quantile(place_N3[column == k, 1], 0.9) / 0.9 for k in own]
    return math.degrees(math.atan(-np.polyfit(own, surface, 1)[0]))


def basin(
    material: int, size_cells: Sequence[float], space_cells: Sequence[float], cell: float, floor: int | None = None
) -> Scene:
    """Fills a box in the corner of a basin with particles at random places. With `floor` they lie on a sheet, `floor`
    cells above the basin's floor."""
    place = random_places(size_cells) + WALL
    nodes = [math.ceil(space + WALL + FAR_WALL) for space in space_cells]
    obstacles: tuple[Obstacle, ...] = ()
    if floor is not None:
        place[:, 1] += floor
        nodes[1] += floor
        low, high, y = -cell, (max(nodes) + 1) * cell, (WALL + floor) * cell
        corner = np.array([[low, y, low], [high, y, low], [high, y, high], [low, y, high]])
        obstacles = (Obstacle("floor", corner, np.array([[0, 1, 2], [0, 2, 3]], np.int32), False),)
    return filled(
        material, place * cell, (0.0, 0.0, 0.0), obstacles=obstacles, domain_size=tuple(n * cell for n in nodes),
        cell_size=cell, gravity=(0.0, -GRAVITY, 0.0), particles_per_cell=PARTICLES_PER_CELL,
    )  # fmt: skip


def edge(depth: np.ndarray, least: float) -> float:
    """Returns the place from which on mean depths of cells are below `least`, in cells from the first.

    Depths are interpolated between centres of cells. A cliff fills its last cells partly. Its end is the place at which
    the slope behind it, continued, would contain the volume of the last two cells.
    """
    depth = np.concatenate([depth[:1], depth[:1], depth, [0.0, 0.0]])
    last = int(np.flatnonzero(depth[2:] >= least).max(initial=0)) + 2
    linear = 0.5 + float((depth[last] - least) / max(depth[last] - depth[last + 1], 1e-9))
    slope = max(float(depth[last - 2] - depth[last - 1]), 0.0)
    mass, begin = float(depth[last] + depth[last + 1]), max(float(depth[last - 1]) - 0.5 * slope, least)
    square = begin * begin - 2 * slope * mass
    cliff = 2 * mass / (begin + math.sqrt(square)) if square >= 0 else math.inf
    return last - 2 + min(linear, cliff)


def _strays(place_TN3: np.ndarray, space_cells: float, axes: Sequence[int]) -> str:
    """Returns a note if many particles come within a cell of the far walls of the basin, or an empty string."""
    reach = WALL + space_cells - 1
    share = float(np.mean([(place_TN3[..., axis] > reach).any(axis=0) for axis in axes]))
    return f"; {share:.1%} of it reached the walls of the basin, {space_cells:g} cells wide" if share > STRAY else ""


def _above_floor(position_N3: np.ndarray, cell: float) -> np.ndarray:
    """Returns places from the corner of a column's floor, in cells."""
    return np.asarray(position_N3, np.float64) / cell - np.array([WALL, WALL + 2.0, WALL])


def _sand(base: MpmConfig, angle_deg: float) -> MpmConfig:
    return dataclasses.replace(base, sand_friction_angle_deg=angle_deg)


def _path(scene: Scene, config: MpmConfig, frames: int, rate_hz: float = DAM_RATE_HZ) -> np.ndarray:
    return positions(simulate([scene], config, frames, rate_hz)[0])
