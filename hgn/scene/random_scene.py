"""Random scenes after the paper (sec. 3.3): disjoint obstacles, and groups of particles at a distance from them.

Config and seed determine a scene bitwise on every machine. All randomness is `PCG64` through `Generator.random()`.
Coordinates are sums, products, quotients and square roots. Only unit shapes use sines and cosines, rounded to float32.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hgn.config import SceneConfig
from hgn.scene.funnel import Funnel, draw_funnel
from hgn.scene.group import MOST_PARTICLES, WALL_CELLS, Region, points_in_ball, random_direction, region_of
from hgn.scene.own_physics import with_elastic_bodies
from hgn.scene.placement import (
    CLEARANCE_CELLS,
    ROUNDING,
    Body,
    Placed,
    assemble,
    blocked,
    choice,
    filled,
    place_shape,
    thrown,
    too_near,
)
from hgn.scene.rotation import quaternion_rotation, rotate
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.scene.streams import Stream, stream
from hgn.scene.world import Layout, draw_layout
from hgn.schema import ConfigError, Vector, require, triple

REPORT_SEED = 1_000_000  # first seed of scenes that reports draw; seeds of data sets are hashes
MAXIMUM_TILTED_GRAVITY = 19.6  # domain units per second squared
LAYOUTS = 5  # attempts to place all items of a scene
SHAPES_PER_ITEM = 20  # attempts for an obstacle (each draws shape, size, orientation) or a group (shape)
PLACES_PER_SHAPE = 50
FUNNELS = 300  # attempts to draw a funnel that fits into the domain
LONE_CELLS = 6  # smallest distance of a lone particle from others, in solver cells; 2.7 network cells of 0.035


class _NoRoomError(Exception):
    """An item does not fit into this layout."""


def generate_scene(config: SceneConfig, seed: int) -> Scene:
    """Returns a random scene of particle groups at rest or in motion. A lone particle is a group of size 0.

    The scene's gravity is the config's, zero, or drawn. If the config names `kinds`, the scene is of one of them
    (hgn.scene.world). Obstacles lie in the domain, at least CLEARANCE_CELLS solver cells apart and none inside another,
    except for the four squares of a funnel, which cross. Groups keep the same distance from obstacles, from each other
    and from the solver's walls. An item that does not fit gets a new position, then a new shape, then a new layout.
    `Scene.specification` records every choice in plain JSON types.

    Raises: ConfigError if an item does not fit. The message names the setting to change.
    """
    require(isinstance(seed, int) and seed >= 0, "seed", "a whole number >= 0", seed)
    _require_cells(config)
    kind, config = None, with_elastic_bodies(config, seed)
    if config.kinds:
        kind, drawn = draw_layout(config, seed)
        if isinstance(drawn, Layout):
            return assemble(drawn.config, seed, drawn.gravity, drawn.obstacles, drawn.bodies, kind)
        config = drawn
    rng = np.random.Generator(np.random.PCG64(seed))
    separate = (Stream.LONE_PARTICLES, Stream.MOTION, Stream.FUNNEL)
    lone_rng, motion_rng, funnel_rng = (stream(seed, key) for key in separate)
    gravity = _draw_gravity(config, motion_rng)
    colliding = motion_rng.random() < config.colliding_scene_fraction
    if colliding:
        config = replace(config, obstacle_count=0, funnel_scene_fraction=0.0)
    funnelled = any(gravity) and funnel_rng.random() < config.funnel_scene_fraction
    failure = ""
    for _ in range(LAYOUTS):
        try:
            funnel, obstacles = _place_funnel(config, gravity, funnel_rng) if funnelled else (None, [])
            for index in range(len(obstacles), config.obstacle_count):
                obstacles.append(_place_obstacle(config, obstacles, index, rng))
            shapes, regions = list[str](), list[Region]()
            for index in range(config.group_count):
                shape, region = _place_group(config, obstacles, regions, funnel, index, rng)
                shapes, regions = [*shapes, shape], [*regions, region]
            lone = _place_lone_particles(config, obstacles, regions, lone_rng)
        except _NoRoomError as error:
            failure = str(error)
            continue
        bodies = [_fill_group(config, *group, rng) for group in zip(shapes, regions, strict=True)]
        bodies = _collide(config, bodies, motion_rng) if colliding else _purify(config, bodies, gravity, motion_rng)
        bodies += [_fill_group(config, "cube", region, lone_rng) for region in lone]
        return assemble(config, seed, gravity, obstacles, bodies, kind)
    raise ConfigError(f"{failure} ({LAYOUTS} layouts, seed {seed})")


def _require_cells(config: SceneConfig) -> None:
    """Raises ConfigError for cells so large that walls fill the domain, or with too many particles, at any seed."""
    largest, size = min(config.domain_size) / (2 * (WALL_CELLS + CLEARANCE_CELLS)), config.cell_size
    rule, remedy = f"at most {largest:g}, a tenth of the domain's smallest side", "lower it, or raise domain_size"
    require(size <= largest, "cell_size", rule, size, remedy)
    least = config.group_size * (config.group_count * config.particles_per_cell / MOST_PARTICLES) ** (1 / 3)
    rule = f"at least {least:.3g} for at most {MOST_PARTICLES} particles"
    require(size >= least, "cell_size", rule, size, "raise it, or lower particles_per_cell")


@dataclass(frozen=True)
class _PlacedFunnel:
    """A funnel and the position of its hole's centre."""

    funnel: Funnel
    hole_3: np.ndarray

    def place(self, rng: np.random.Generator) -> np.ndarray:
        """Draws a position, uniform in the space above the hole and above the inner halves of the squares."""
        low_3, high_3 = self.funnel.low_3, self.funnel.high_3
        local_3 = low_3 + (high_3 - low_3) * rng.random(3)
        return self.hole_3 + rotate(local_3[None], self.funnel.rotation_33)[0]


def _place_funnel(config: SceneConfig, gravity: Vector, rng: np.random.Generator) -> tuple[_PlacedFunnel, list[Placed]]:
    domain = np.array(config.domain_size)
    for _ in range(FUNNELS):
        funnel = draw_funnel(config, gravity, rng)
        first_3 = -funnel.extent_P3.min(axis=0) + ROUNDING * domain
        span_3 = domain - ROUNDING * domain - funnel.extent_P3.max(axis=0) - first_3
        if (span_3 >= 0).all():
            hole_3 = first_3 + span_3 * rng.random(3)
            return _PlacedFunnel(funnel, hole_3), _squares(funnel, hole_3)
    raise _NoRoomError(
        f"funnel_scene_fraction must be 0 if none of {FUNNELS} drawn funnels fits into the domain, got "
        f"{config.funnel_scene_fraction:g}; lower it, obstacle_size or group_size, or raise domain_size"
    )


def _squares(funnel: Funnel, hole_3: np.ndarray) -> list[Placed]:
    centre_43 = hole_3 + funnel.centre_43
    parts = enumerate(zip(centre_43, funnel.quaternion, strict=True))
    return [place_shape("square", funnel.size, triple(centre_3), turn, index) for index, (centre_3, turn) in parts]


def _place_obstacle(config: SceneConfig, placed: list[Placed], index: int, rng: np.random.Generator) -> Placed:
    clearance = CLEARANCE_CELLS * config.cell_size
    domain = np.array(config.domain_size)
    smallest, largest = config.obstacle_size
    for _ in range(SHAPES_PER_ITEM):
        shape = choice(config.obstacle_shapes, rng)
        size = smallest + (largest - smallest) * rng.random()
        quaternion = random_direction(rng, 4).tolist()
        turned = shape_obstacle(shape, size, rotation_33=quaternion_rotation(quaternion))
        low, high = turned.vertex_V3.min(axis=0), turned.vertex_V3.max(axis=0)
        first = -low + ROUNDING * domain
        span = domain - ROUNDING * domain - high - first
        if (span < 0).any():
            continue
        for _ in range(PLACES_PER_SHAPE):
            item = place_shape(shape, size, triple(first + span * rng.random(3)), quaternion, index)
            if not any(too_near(item, other, clearance) for other in placed):
                return item
    raise _NoRoomError(
        f"obstacle_count must leave room for each obstacle, got no place for number {index + 1} of "
        f"{config.obstacle_count}; lower obstacle_count or obstacle_size, or raise domain_size"
    )


def _place_group(
    config: SceneConfig,
    obstacles: list[Placed],
    groups: list[Region],
    funnel: _PlacedFunnel | None,
    index: int,
    rng: np.random.Generator,
) -> tuple[str, Region]:
    clearance = CLEARANCE_CELLS * config.cell_size + ROUNDING
    margin = WALL_CELLS * config.cell_size + clearance + 0.5 * config.group_size
    span = np.array(config.domain_size) - 2 * margin
    size = (config.group_size,) * 3
    for _ in range(SHAPES_PER_ITEM if (span >= 0).all() else 0):
        shape = choice(config.group_shapes, rng)
        for _ in range(PLACES_PER_SHAPE):
            centre_3 = margin + span * rng.random(3) if funnel is None else funnel.place(rng)
            if (centre_3 < margin).any() or (centre_3 > margin + span).any():
                continue
            region = region_of(shape, size, triple(centre_3))
            if any(region.distance(other) < clearance for other in groups):
                continue
            if any(blocked(region, item, clearance) for item in obstacles):
                continue
            return shape, region
    raise _NoRoomError(
        f"group_count must leave room for each group, got no place for number {index + 1} of "
        f"{config.group_count} with group_size {config.group_size:g}; lower group_count, group_size "
        "or obstacle_count, or raise domain_size"
    )


def _place_lone_particles(
    config: SceneConfig, obstacles: list[Placed], groups: list[Region], rng: np.random.Generator
) -> list[Region]:
    near = LONE_CELLS * config.cell_size
    clearance = CLEARANCE_CELLS * config.cell_size + ROUNDING
    margin = WALL_CELLS * config.cell_size + clearance
    span = np.array(config.domain_size) - 2 * margin
    placed: list[Region] = []
    for index in range(config.lone_particles):
        for _ in range(SHAPES_PER_ITEM * PLACES_PER_SHAPE if (span >= 0).all() else 0):
            region = Region(triple(margin + span * rng.random(3)))
            if any(region.distance(other) < near for other in (*groups, *placed)):
                continue
            if not any(blocked(region, item, clearance) for item in obstacles):
                placed.append(region)
                break
        else:
            raise _NoRoomError(
                f"lone_particles must leave room for each, got no place for number {index + 1} of "
                f"{config.lone_particles}; lower lone_particles, or raise domain_size"
            )
    return placed


def _fill_group(config: SceneConfig, shape: str, region: Region, rng: np.random.Generator) -> Body:
    material = choice(config.materials, rng)
    velocity = np.zeros(3)
    if config.maximum_initial_speed > 0:
        velocity = config.maximum_initial_speed * points_in_ball(1, 3, rng)[0]
        if config.moving_group_fraction < 1 and rng.random() >= config.moving_group_fraction:
            velocity = np.zeros(3)
    return filled(config, shape, region, material, velocity, rng=rng)


def _draw_gravity(config: SceneConfig, rng: np.random.Generator) -> Vector:
    """Draws the gravity: the config's, zero, or a tilted one, which is uniform in direction and in size."""
    kind, size = rng.random(2).tolist()
    direction_3 = random_direction(rng)
    if kind < config.zero_gravity_fraction:
        return 0.0, 0.0, 0.0
    if kind < config.zero_gravity_fraction + config.tilted_gravity_fraction:
        return triple(size * MAXIMUM_TILTED_GRAVITY * direction_3)
    return config.gravity


def _purify(config: SceneConfig, bodies: list[Body], gravity: Vector, rng: np.random.Generator) -> list[Body]:
    """Gives some of the moving groups a velocity exactly along gravity, against it or normal to it, uniform in size.

    Without gravity y is up.
    """
    if config.pure_direction_fraction == 0:
        return bodies
    up_3 = -np.array(gravity if any(gravity) else (0.0, -1.0, 0.0))
    up_3 /= np.sqrt((up_3 * up_3).sum())
    changed = []
    for body in bodies:
        chosen, kind, size = rng.random(3).tolist()
        across_3 = random_direction(rng)
        across_3 = across_3 - (across_3 * up_3).sum() * up_3
        across_3 /= np.sqrt((across_3 * across_3).sum())
        direction_3 = up_3 if kind < 0.25 else -up_3 if kind < 0.5 else across_3
        pure = chosen < config.pure_direction_fraction and body.velocity_3.any()
        changed.append(thrown(body, size * config.maximum_initial_speed * direction_3) if pure else body)
    return changed


def _collide(config: SceneConfig, bodies: list[Body], rng: np.random.Generator) -> list[Body]:
    """Throws groups at each other, in pairs or all together. A group without a partner starts at rest.

    The groups meet off centre by up to half a group's size. The fastest group has at least half the maximum speed.
    """
    pairs, changed = rng.random() < 0.5, [thrown(body, np.zeros(3)) for body in bodies]
    size = 2 if pairs else max(len(bodies), 1)
    for first in range(0, len(bodies) - 1, size):
        centre_B3 = np.array([body.record["position"] for body in bodies[first : first + size]])
        if len(centre_B3) < 2:
            continue
        aim_B3 = centre_B3.mean(axis=0) + 0.5 * config.group_size * points_in_ball(len(centre_B3), 3, rng)
        speed = config.maximum_initial_speed * (0.5 + 0.5 * rng.random())
        way_B3 = aim_B3 - centre_B3
        way_B3 *= speed / np.sqrt((way_B3 * way_B3).sum(axis=1)).max()
        for place, velocity_3 in enumerate(way_B3, first):
            changed[place] = thrown(bodies[place], velocity_3)
    return changed
