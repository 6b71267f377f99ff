"""The cases of `tools.stability network`: a table of families, each a generator of cases.

Shape legend: N particles, K cubes.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hgn.config import NetworkConfig, SceneConfig
from hgn.scene.material import MATERIALS
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError
from tools.scenes import filled, joined
from tools.stability.case import STANDARD, Case, Limit
from tools.stability.measures import EARTH, TURNS, wall_distance
from tools.stability.parameters import parameters

SPEEDS = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)  # domain units per second
ROOT = 3**-0.5
DIRECTIONS = {
    "+x": (1.0, 0.0, 0.0), "-x": (-1.0, 0.0, 0.0), "+z": (0.0, 0.0, 1.0), "-z": (0.0, 0.0, -1.0),
    "up": (0.0, 1.0, 0.0), "down": (0.0, -1.0, 0.0), "diagonal": (ROOT, ROOT, ROOT),
}  # fmt: skip
AT_REST = (0.0, 0.0, 0.0)
GRAVITIES = {  # domain units per second squared; names give the size in multiples of the earth's
    "none": (0.0, 0.0, 0.0),
    "half, sideways": (0.5 * EARTH, 0.0, 0.0),
    "one, upwards": (0.0, EARTH, 0.0),
    "one, oblique": (-ROOT * EARTH, -ROOT * EARTH, ROOT * EARTH),
    "two, downwards": (0.0, -2 * EARTH, 0.0),
    "two, oblique": (1.2 * EARTH, 0.0, -1.6 * EARTH),
}
FLIGHT_FRAMES = 60  # largest number of frames of a flight
TURNED_FRAMES, TURNED_CUBES = 90, 8  # several cubes, because the error of one varies by a factor of two
TURNED_SPREAD = 0.1  # cubes start within this fraction of each domain side from the middle
MEETING = (1.5, -0.5)  # velocities of the two cubes along x, domain units per second
MEETING_FRAMES = 40
COLLAPSE_CELLS = (5.0, 20.0)  # heights of falling cubes above the lower plane, in cells of the solver
COLLAPSE_FRAMES = (30, 60, 150)  # material spreads, reaches the walls, and is at rest
SLOPES_DEG = (15.0, 30.0, 45.0)
SLOPE_SIDE, SLOPE_WAY = 0.6, 0.35  # side of the slope and distance slid, as fractions of the domain's smallest side
FALL_FRAMES = 12  # number of frames in which a falling particle meets nothing
ATTEMPTS = 20  # largest number of seeds to try if scenes have too little space
PARTICLE_FACTOR = 10.0  # factor of the volume of groups, and so of the number of particles
DOMAIN_SIDES = (2, 3, 4)  # factors of length and depth; obstacles and groups grow with the floor
SPEED_FACTOR = 3.0  # largest initial speed, in multiples of the speed after a fall through the domain
FAR_CELLS = 64_000  # length in obstacle cells of a domain with a scene at its far end

PARAMETERS = "parameters"  # family that runs only if it is named, because the solver takes long

FLIES = (Limit("gravity_error", high=0.02),)
KEEPS = Limit("kept", low=0.99)
# The solver's angular momentum has an error, because positions do not show the spin within a cell. For cubes of side
# 0.08 this error is 0.04 (snow), 0.06 (water) or 0.07 (sand).
MEETS = (
    Limit("momentum", high=0.01), Limit("angular", high=0.05, above=1.0), Limit("met", low=0.0, below=0.5),
)  # fmt: skip
MEETS_ALONE = (Limit("momentum", high=0.01), Limit("angular", high=0.05), Limit("met", low=0.1))
ENERGY, INSIDE = STANDARD
RISE = Limit("energy_rise", high=0.02, above=1.5)
WAY = (ENERGY, Limit("share_of_way", 0.8, 1.2), INSIDE)
# Over three random fillings the solver's spread varies by 2 % (water's late spread by 9 %), its height by 0.1 cells.
SPREADS = (
    ENERGY,
    RISE,
    Limit("collapse.spread", 0.0, 0.0, below=0.85, above=1.15),
    Limit("collapse.height", -0.5, 0.5, below=1.0, above=1.0),
    Limit("collapse.neighbours", 0.0, 0.0, below=0.7, above=1.4),
    INSIDE,
)
# 5e-4 is twice the standard deviation of the squared speed over five fillings of 135 particles of water or sand.
# Mixed water drifts by 0.6 of the distance between the walls, so particles can exceed 1.3 times the solver's drift.
RESTS = (
    ENERGY,
    RISE,
    Limit("rest.drift", -1.0, 1.0, below=0.5, above=1.3),
    Limit("rest.neighbours", 0.0, 0.0, below=0.8, above=1.25),
    Limit("rest.spread", -0.5, 0.5, below=0.9, above=1.1),
    Limit("rest.height", -0.1, 0.1, below=1.0, above=1.0),
    Limit("rest.squared_speed", -5e-4, 5e-4, below=0.5, above=2.0),
    INSIDE,
)


@dataclass(frozen=True)
class Context:
    """Scenes, network and lengths of a report's cases."""

    scene: SceneConfig  # as in training, without obstacles and materials that the network does not support
    network: NetworkConfig
    frame_rate_hz: float
    frames: int
    long_frames: int  # of the family `rest`
    solver: bool

    def __post_init__(self) -> None:
        count = self.scene.obstacle_count if self.network.obstacle_features else 0
        materials = tuple(name for name in self.scene.materials if name in self.network.materials)
        fitted = replace(self.scene, funnel_scene_fraction=0.0, obstacle_count=count, materials=materials)
        object.__setattr__(self, "scene", fitted)


def throws(context: Context) -> Iterator[Case]:
    for material in context.network.materials:
        for speed in SPEEDS:
            name = f"thrown at {speed:g} a second" if speed else "dropped"
            ways = DIRECTIONS if speed else {"": AT_REST}
            velocities = {label: speed * np.array(way) for label, way in ways.items()}
            yield _flight(f"{name}, {material}", context, material, velocities, context.scene.gravity)


def gravities(context: Context) -> Iterator[Case]:
    ways = {"at rest": AT_REST, "+x": DIRECTIONS["+x"], "up": DIRECTIONS["up"]}
    velocities = {label: np.array(way) for label, way in ways.items()}
    for material in context.network.materials:
        for name, gravity in GRAVITIES.items():
            yield _flight(f"gravity {name}, {material}", context, material, velocities, gravity)
        if context.solver and len(set(context.scene.domain_size)) == 1:
            yield from _turned(context, material)


def collisions(context: Context) -> Iterator[Case]:
    for material in context.network.materials:
        yield Case(
            f"two bodies meet without gravity, {material}", (meeting(context.scene, material),), MEETING_FRAMES,
            MEETS if context.solver else MEETS_ALONE, solver=context.solver, reported="momentum",
        )  # fmt: skip


def collapses(context: Context) -> Iterator[Case]:
    times = tuple(frame for frame in COLLAPSE_FRAMES if frame < context.frames)
    for material in context.scene.materials if context.solver and times else ():
        scenes = tuple(_above_floor(context.scene, material, cells) for cells in COLLAPSE_CELLS)
        name = f"falls and spreads, {material}"
        yield Case(name, scenes, times[-1] + 1, SPREADS, solver=True, at_frames=times)


def rests(context: Context) -> Iterator[Case]:
    for material in context.scene.materials if context.solver else ():
        scene = _scene(replace(context.scene, obstacle_count=0, materials=(material,)))
        name, settled = f"{context.long_frames} frames, {material}", min(context.frames, context.long_frames) - 1
        yield Case(name, (scene,), context.long_frames, RESTS, solver=True, settled=settled)


def many_particles(context: Context) -> Iterator[Case]:
    size = context.scene.group_size * PARTICLE_FACTOR ** (1 / 3)
    yield _changed(f"particles x{PARTICLE_FACTOR:g}", context, group_size=size)


def large_domains(context: Context) -> Iterator[Case]:
    (width, height, depth), scene = context.scene.domain_size, context.scene
    for side in DOMAIN_SIDES:
        counts = {"obstacle_count": scene.obstacle_count * side**2, "group_count": scene.group_count * side**2}
        yield _changed(f"domain x{side**2}", context, domain_size=(width * side, height, depth * side), **counts)


def fast_groups(context: Context) -> Iterator[Case]:
    fall = math.sqrt(2 * float(np.linalg.norm(context.scene.gravity)) * context.scene.domain_size[1])
    speed = SPEED_FACTOR * fall
    alone = replace(context, solver=False)
    yield _changed(f"thrown at up to {speed:.1f} a second", alone, maximum_initial_speed=speed)


def single_particles(context: Context) -> Iterator[Case]:
    for material in context.scene.materials:
        scene = body(context.scene, material, 0.5 * np.array([context.scene.domain_size]), np.zeros(3))
        known: dict[str, Any] = {"known_3": context.scene.gravity, "known_frames": FALL_FRAMES}
        yield Case(f"single particle, {material}", (scene,), context.frames, WAY, **known)


def slopes(context: Context) -> Iterator[Case]:
    for material in context.scene.materials if context.network.obstacle_features else ():
        for degrees in SLOPES_DEG:
            yield _slope(context, material, degrees)


def far_end(context: Context) -> Iterator[Case]:
    """Moves a scene to the far end of a long domain, where float32 coordinates are coarse."""
    scene = _scene(context.scene)
    length = FAR_CELLS * scene.cell_size
    shift_3 = np.array([length - scene.domain_size[0], 0.0, 0.0])
    moved = replace(
        scene,
        position_N3=(scene.position_N3 + shift_3).astype(np.float32),
        obstacles=tuple(replace(mesh, vertex_V3=mesh.vertex_V3 + shift_3) for mesh in scene.obstacles),
        domain_size=(length, *scene.domain_size[1:]),
    )
    yield Case(f"at the end of {FAR_CELLS} cells", (moved,), context.frames)


FAMILIES: dict[str, Callable[[Context], Iterator[Case]]] = {
    "throw": throws, "gravity": gravities, "collision": collisions, "collapse": collapses, "rest": rests,
    "particles": many_particles, "domain": large_domains, "speed": fast_groups,
    "single": single_particles, "slope": slopes, "far": far_end,
    PARAMETERS: lambda context: parameters(context.frame_rate_hz, context.solver),
}  # fmt: skip


def body(config: SceneConfig, material: str, position_N3: np.ndarray, velocity_3: np.ndarray, **more: Any) -> Scene:
    """Returns particles of one material in an empty domain; `more` are fields of Scene."""
    own = {"domain_size": config.domain_size, "cell_size": config.cell_size, "gravity": config.gravity}
    return filled(MATERIALS.index(material), position_N3, velocity_3, **own, **more)


def cube_places(config: SceneConfig, seed: int = 0) -> np.ndarray:
    """Returns random positions in a cube about the origin, with size and density of a group, float64 [N, 3]."""
    count = int(config.particles_per_cell * (config.group_size / config.cell_size) ** 3) + 1
    return config.group_size * (np.random.default_rng(seed).random((count, 3)) - 0.5)


def cube(scene: SceneConfig, material: str, centre_3: np.ndarray, velocity_3: np.ndarray, seed: int = 0) -> Scene:
    """Returns a cube of a group's size, without obstacles."""
    place_N3 = centre_3 + cube_places(scene, seed)
    return body(scene, material, place_N3, velocity_3, particles_per_cell=scene.particles_per_cell)


def meeting(scene: SceneConfig, material: str) -> Scene:
    """Returns two cubes, 0.2 sides apart and 0.5 off centre, that move towards each other along x without gravity."""
    size, middle_3 = scene.group_size, 0.5 * np.array(scene.domain_size)
    scene = replace(scene, gravity=(0.0, 0.0, 0.0))
    cubes = []
    for seed, (side, speed) in enumerate(zip((-1, 1), MEETING, strict=True)):
        centre_3 = middle_3 + side * size * np.array([0.6, 0.25, 0.0])
        cubes.append(cube(scene, material, centre_3, np.array([speed, 0, 0]), seed))
    return joined(cubes)


def _flight(
    name: str, context: Context, material: str, velocities: dict[str, np.ndarray], gravity: tuple[float, float, float]
) -> Case:
    """Throws a cube from the middle of the domain with each velocity."""
    config, middle_3 = replace(context.scene, gravity=gravity), 0.5 * np.array(context.scene.domain_size)
    thrown = enumerate(velocities.values())
    scenes = tuple(cube(config, material, middle_3, velocity_3, seed) for seed, velocity_3 in thrown)
    reach = wall_distance(context.network)
    last = tuple(flight_frames(scene, context.frame_rate_hz, reach) for scene in scenes)
    limits = (*FLIES, KEEPS) if any(velocity_3.any() for velocity_3 in velocities.values()) else FLIES
    labels = tuple(velocities)
    return Case(
        name, scenes, max(last) + 1, limits, reported="gravity_error", also=("throws",), labels=labels, last_frames=last
    )


def flight_frames(scene: Scene, rate_hz: float, reach: float) -> int:
    """Returns the number of frames before a particle's next position can be within `reach` of a wall; at least 1."""
    gravity_3, velocity_3 = np.array(scene.gravity) / rate_hz**2, scene.velocity_N3[0] / rate_hz
    low_3 = scene.position_N3.min(axis=0) - reach - np.abs(gravity_3)
    high_3 = np.array(scene.domain_size) - scene.position_N3.max(axis=0) - reach - np.abs(gravity_3)
    for frame in range(1, FLIGHT_FRAMES + 1):
        moved_3 = frame * velocity_3 + 0.5 * frame**2 * gravity_3
        if (moved_3 < -low_3).any() or (moved_3 > high_3).any():
            return max(frame - 1, 1)
    return FLIGHT_FRAMES


def _turned(context: Context, material: str) -> Iterator[Case]:
    """Exchanges axes of falling cubes and of gravity. The network's errors should not grow."""
    start_K3 = 0.5 + TURNED_SPREAD * (2 * np.random.default_rng(0).random((TURNED_CUBES, 3)) - 1)
    places_K3 = start_K3 * np.array(context.scene.domain_size)
    places = enumerate(places_K3)
    upright = tuple(cube(context.scene, material, place_3, np.zeros(3), seed) for seed, place_3 in places)
    for way, order in TURNS.items():
        x, y, z = (upright[0].gravity[axis] for axis in order)
        turned = tuple(replace(each, position_N3=each.position_N3[:, order], gravity=(x, y, z)) for each in upright)
        yield Case(
            f"to rest in gravity along {way}, {material}", turned, TURNED_FRAMES, (Limit("turned_ratio", high=1.25),),
            reported="turned_ratio", labels=(way,), upright=upright,
        )  # fmt: skip


def _above_floor(config: SceneConfig, material: str, cells: float) -> Scene:
    """Returns a cube at rest in the middle of an empty domain, `cells` solver cells above the lower plane."""
    middle_3 = 0.5 * np.array(config.domain_size)
    middle_3[1] = cells * config.cell_size - cube_places(config)[:, 1].min()
    return cube(config, material, middle_3, np.zeros(3))


def _slope(context: Context, material: str, degrees: float) -> Case:
    """Puts a block just above the upper end of a tilted square. Its acceleration is that of gravity along the slope."""
    config, length = context.scene, min(context.scene.domain_size)
    turn = euler_rotation((degrees, 0.0, 0.0))
    up_3, down_3 = turn @ np.array([0.0, 1.0, 0.0]), turn @ np.array([0.0, 0.0, 1.0])
    middle_3 = 0.5 * np.array(config.domain_size)
    start_3 = middle_3 - 0.6 * SLOPE_WAY * length * down_3 + (0.5 * config.group_size + 0.75 * config.cell_size) * up_3
    slope = shape_obstacle("square", SLOPE_SIDE * length, tuple(middle_3.tolist()), turn, "slope")
    scene = body(config, material, start_3 + cube_places(config) @ turn.T, np.zeros(3), obstacles=(slope,))
    along = float(np.array(config.gravity) @ down_3)
    last = int(context.frame_rate_hz * math.sqrt(2 * SLOPE_WAY * length / along)) if along > 0 else 0
    known: dict[str, Any] = {"known_3": tuple((along * down_3).tolist()), "known_frames": last}
    frames, name = min(context.frames, last + 2), f"slides down {degrees:g} degrees, {material}"
    return Case(name, (scene,), frames, WAY, solver=context.solver, **known)


def _changed(name: str, context: Context, **change: Any) -> Case:
    """Returns a case of one changed scene. Without the solver only energy and walls are checked."""
    scene = (_scene(replace(context.scene, **change)),)
    if not context.solver:
        return Case(name, scene, context.frames)
    return Case(name, scene, context.frames, SPREADS, solver=True, at_frames=(context.frames - 1,))


def _scene(config: SceneConfig, seed: int = REPORT_SEED) -> Scene:
    """Generates a scene, with other seeds if it has too little space. Raises: ConfigError after some attempts."""
    for attempt in range(1, ATTEMPTS):
        try:
            return generate_scene(config, attempt * seed)
        except ConfigError:
            continue
    return generate_scene(config, ATTEMPTS * seed)
