"""The scenes that a network is tried on beyond those that it was trained on.

Shape legend: N particles.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from hgn.config import DEFAULT_WEIGHTS, BackendName, MpmConfig, NetworkConfig, Precision, Processor, SceneConfig
from hgn.scene.funnel import funnel_squares
from hgn.scene.material import MATERIALS
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.rotation import euler_rotation, quaternion_rotation
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import ConfigError, FrameCount, NonNegative, Positive, one_of, require, require_bounds
from tools.scenes import filled

MOTION = ("throw", "gravity", "collision")  # tools/stability/network_motion.py
CASES = (*MOTION, "collapse", "hole", "rest", "particles", "domain", "speed", "single", "slope", "far", "guard")
SLOPES_DEG = (15.0, 30.0, 45.0)
COLLAPSE_CELLS = (5.0, 20.0)  # of the solver, from the lower plane to cubes that fall
COLLAPSE_FRAMES = (30, 60, 150)  # in which they are looked at: as they spread, when walls are reached, and at rest
# how wide funnels' holes are, in the network's finest cells, by the side of the cube above them, in group sizes
HOLE_CELLS = {1.0: (1.5, 2.0, 3.0, 4.0), 1.5: (1.7, 2.0, 4.0)}
HOLE_FRAMES = 150  # in which what falls into a funnel may pass its hole
FUNNEL_SIDE, FUNNEL_TILT_DEG = 0.36, 45.0  # of the domain's smallest side: that of each of a funnel's squares
SLOPE_SIDE, SLOPE_WAY = 0.6, 0.35  # of the domain's smallest side: the slope's, and what is slid along it
FRAME_RATE_HZ = 60.0  # for how long cases are
FALL_FRAMES = 12  # in which what falls meets nothing
ATTEMPTS = 20  # at scenes that turn out to be too full
PARTICLE_FACTOR = 10.0
DOMAIN_SIDES = (2, 3, 4)  # times as long and deep, with as many more obstacles and groups as the floor grows
SPEED_FACTOR = 3.0  # times the speed of a fall through the domain
FAR_CELLS = 64_000  # how long the domain is that particles lie at the far end of, in obstacle cells


@dataclass(frozen=True)
class StabilityNetworkConfig:
    """The options of `python -m tools.stability network`."""

    weights: str = DEFAULT_WEIGHTS  # a file of python -m hgn.export, or the name of shipped weights
    # of throw, gravity, collision, collapse, hole, rest, particles, domain, speed, single, slope, far, guard; null: all
    cases: tuple[Annotated[str, one_of(*CASES)], ...] | None = None
    frames: FrameCount = 300
    long_frames: FrameCount = 3000  # of the case rest
    # of its scenes, one each of every material, judged together; others than the first are for choices
    rest_seeds: tuple[Positive[int], ...] = (REPORT_SEED,)
    # frame of the solver's own film of these scenes that the network goes on from; 0: it simulates them from the first
    rest_from: NonNegative[int] = 0
    # in each rollout of throw, gravity and collision; null: as many as a row has throws
    scenes_at_once: Positive[int] | None = None
    # also ask the solver, which needs Taichi: for slope, collision, collapse, hole and rest; without it the latter
    # three are left out
    solver: bool = True
    solver_device: Processor = "auto"  # or cpu, gpu
    # that solver; sand should be what it was in the data that the weights were trained on (their cards say)
    mpm: MpmConfig = field(default_factory=MpmConfig)
    # a folder in which its trajectories of these cases stay, for other weights beside the same version of it
    solver_kept: str | None = None
    # the scenes as they are in training; obstacles only where the network sees them
    scene: SceneConfig = field(default_factory=SceneConfig)
    backend: BackendName = "auto"  # torch, triton, cpu; auto: the fastest that runs
    precision: Precision = "tf32"  # of matrix products: fp32, tf32 (on a GPU), fp16 (backend triton)
    device: str = "auto"
    picture: str | None = None  # also draw the first scene of each case, as far as it came, into this PNG
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        require(len(self.rest_seeds) > 0, "rest_seeds", "at least one", list(self.rest_seeds))


@dataclass(frozen=True, eq=False)
class Case:
    """Scenes to simulate side by side, and for how long."""

    name: str
    scenes: tuple[Scene, ...]
    frames: int
    known_3: tuple[float, float, float] | None = None  # acceleration along which the particles' way is known
    known_frames: int = 0  # for so long
    spread_at: tuple[int, ...] = ()  # frames in which spread and height are judged beside the solver
    # width of each scene's hole in the network's finest cells: what passed it at last is judged beside the solver
    hole_cells: tuple[float, ...] = ()
    hole_height: float = 0.0  # of the holes' edges
    settled: int | None = None  # frame from which on all rests: drift, density and height are judged beside the solver
    begun: int = 0  # frame of the solver's film that the network goes on from
    beside_solver: bool = False


def cases(config: StabilityNetworkConfig, network: NetworkConfig) -> Iterator[Case]:
    """All cases but the guard's, made when asked for.

    Raises: ConfigError where a scene has no room for what it is to hold.
    """
    wanted = config.cases or CASES
    base = replace(config.scene, funnel_scene_fraction=0.0)
    base = base if network.obstacle_features else replace(base, obstacle_count=0)
    base = replace(base, materials=tuple(name for name in base.materials if name in network.materials))

    def case(name: str, **change: Any) -> Case:
        return Case(name, (_scene(replace(base, **change)),), config.frames)

    for material in base.materials if "collapse" in wanted and config.solver else ():
        drops = tuple(_above_floor(base, material, cells) for cells in COLLAPSE_CELLS)
        times = tuple(frame for frame in COLLAPSE_FRAMES if frame < config.frames)
        name = f"falls and spreads, {material}"
        if times:
            yield Case(name, drops, times[-1] + 1, spread_at=times, beside_solver=True)
    judged = config.solver and network.obstacle_features and config.frames >= HOLE_FRAMES
    for material in base.materials if "hole" in wanted and judged else ():
        for side, hole_cells in HOLE_CELLS.items():
            name = f"passes holes{'' if side == 1 else ' under load'}, {material}"
            larger = replace(base, group_size=side * base.group_size)
            yield _funnels(name, larger, material, hole_cells, network.cell_size)
    for material in base.materials if "rest" in wanted and config.solver else ():
        alone = replace(base, obstacle_count=0, materials=(material,))
        scenes = tuple(_scene(alone, seed) for seed in config.rest_seeds)
        settled = min(config.frames, config.long_frames) - 1
        name, begun = f"{config.long_frames} frames, {material}", config.rest_from
        if begun:
            rule = f"0, or from {network.velocity_history} to {settled}, where all rests"
            require(network.velocity_history <= begun <= settled, "rest_from", rule, begun)
            name += f", from frame {begun} of the solver's"
        yield Case(name, scenes, config.long_frames, settled=settled, begun=begun, beside_solver=True)
    if "particles" in wanted:
        yield case(f"particles x{PARTICLE_FACTOR:g}", group_size=base.group_size * PARTICLE_FACTOR ** (1 / 3))
    for side in DOMAIN_SIDES if "domain" in wanted else ():
        (width, height, depth), factor = base.domain_size, side**2
        yield case(
            f"domain x{factor}",
            domain_size=(width * side, height, depth * side),
            obstacle_count=base.obstacle_count * factor,
            group_count=base.group_count * factor,
        )
    if "speed" in wanted:
        speed = SPEED_FACTOR * math.sqrt(2 * float(np.linalg.norm(base.gravity)) * base.domain_size[1])
        yield case(f"thrown at up to {speed:.1f} a second", maximum_initial_speed=speed)
    for material in base.materials if "single" in wanted else ():
        single = body(base, material, 0.5 * np.array([base.domain_size]), np.zeros(3))
        yield Case(f"single particle, {material}", (single,), config.frames, base.gravity, FALL_FRAMES)
    for material in base.materials if "slope" in wanted and network.obstacle_features else ():
        for degrees in SLOPES_DEG:
            yield replace(_slope(base, material, config.frames, degrees), beside_solver=config.solver)
    if "far" in wanted:
        yield Case(f"at the end of {FAR_CELLS} cells", (_far(_scene(base)),), config.frames)


def body(config: SceneConfig, material: str, position_N3: np.ndarray, velocity_3: np.ndarray, **more: Any) -> Scene:
    """Particles of one material in an empty domain; `more` are fields of Scene."""
    own = {"domain_size": config.domain_size, "cell_size": config.cell_size, "gravity": config.gravity}
    return filled(MATERIALS.index(material), position_N3, velocity_3, **own, **more)


def cube_places(config: SceneConfig, seed: int = 0) -> np.ndarray:
    """A cube of a scene's group size about 0, filled as densely as the scene's groups, float64 [N, 3]."""
    count = int(config.particles_per_cell * (config.group_size / config.cell_size) ** 3) + 1
    return config.group_size * (np.random.default_rng(seed).random((count, 3)) - 0.5)


def cube(scene: SceneConfig, material: str, centre_3: np.ndarray, velocity_3: np.ndarray, seed: int = 0) -> Scene:
    """A cube of a scene's group size at random places, without obstacles."""
    place_N3 = centre_3 + cube_places(scene, seed)
    return body(scene, material, place_N3, velocity_3, particles_per_cell=scene.particles_per_cell)


def _above_floor(config: SceneConfig, material: str, cells: float) -> Scene:
    """A cube at rest in the middle of an empty domain, so many of the solver's cells above the lower plane."""
    middle_3 = 0.5 * np.array(config.domain_size)
    middle_3[1] = cells * config.cell_size - cube_places(config)[:, 1].min()
    return cube(config, material, middle_3, np.zeros(3))


def _funnels(name: str, config: SceneConfig, material: str, hole_cells: tuple[float, ...], network_cell: float) -> Case:
    """A cube at rest above the hole of a funnel, for holes of several widths: four tilted squares about the middle of
    the domain. Above a hole of no width it would be as far from the sheets as a scene's groups are from obstacles.
    """
    side, middle_3 = FUNNEL_SIDE * min(config.domain_size), 0.5 * np.array(config.domain_size)
    tilt = math.radians(FUNNEL_TILT_DEG)
    edge, half = float(middle_3[1]) - 0.5 * side * math.sin(tilt), 0.5 * config.group_size
    clear = (half * math.sin(tilt) + config.clearance_cells * config.cell_size) / math.cos(tilt)
    above = cube(config, material, np.array([middle_3[0], edge + clear + half, middle_3[2]]), np.zeros(3))
    hole_3 = np.array([middle_3[0], edge, middle_3[2]])
    scenes = []
    for cells in hole_cells:
        squares = tuple(
            shape_obstacle("square", side, tuple((hole_3 + centre_3).tolist()), quaternion_rotation(quaternion))
            for quaternion, centre_3 in zip(*funnel_squares(cells * network_cell, side, math.sin(tilt)), strict=True)
        )
        scenes.append(replace(above, obstacles=squares))
    return Case(
        name, tuple(scenes), HOLE_FRAMES,
        hole_cells=hole_cells, hole_height=edge, beside_solver=True,
    )  # fmt: skip


def _scene(config: SceneConfig, seed: int = REPORT_SEED) -> Scene:
    """The first of some scenes that has room for everything."""
    for attempt in range(1, ATTEMPTS):
        try:
            return generate_scene(config, attempt * seed)
        except ConfigError:
            continue
    return generate_scene(config, ATTEMPTS * seed)


def _slope(config: SceneConfig, material: str, frames: int, degrees: float) -> Case:
    """A block just above the upper end of a tilted square: without friction it slides as gravity along the slope
    pulls, whatever the material."""
    length = min(config.domain_size)
    turn = euler_rotation((degrees, 0.0, 0.0))
    up_3, down_3 = turn @ np.array([0.0, 1.0, 0.0]), turn @ np.array([0.0, 0.0, 1.0])
    middle_3 = 0.5 * np.array(config.domain_size)
    start_3 = middle_3 - 0.6 * SLOPE_WAY * length * down_3 + (0.5 * config.group_size + 0.75 * config.cell_size) * up_3
    slope = shape_obstacle("square", SLOPE_SIDE * length, tuple(middle_3.tolist()), turn, "slope")
    scene = body(config, material, start_3 + cube_places(config) @ turn.T, np.zeros(3), obstacles=(slope,))
    pull = float(np.array(config.gravity) @ down_3)
    last = int(FRAME_RATE_HZ * math.sqrt(2 * SLOPE_WAY * length / pull)) if pull > 0 else 0
    known_3 = tuple((pull * down_3).tolist())
    return Case(f"slides down {degrees:g} degrees, {material}", (scene,), min(frames, last + 2), known_3, last)


def _far(scene: Scene) -> Scene:
    """The same at the far end of a long domain: where coordinates are coarse."""
    length = FAR_CELLS * scene.cell_size
    shift_3 = np.array([length - scene.domain_size[0], 0.0, 0.0])
    return replace(
        scene,
        position_N3=(scene.position_N3 + shift_3).astype(np.float32),
        obstacles=tuple(replace(mesh, vertex_V3=mesh.vertex_V3 + shift_3) for mesh in scene.obstacles),
        domain_size=(length, *scene.domain_size[1:]),
    )
