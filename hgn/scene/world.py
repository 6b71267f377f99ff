"""Scenes of everyday kinds: pools, dam breaks, columns, slopes, edges, bowls, stairs and others.

A kind draws a domain from DOMAINS and numbers from its RANGES, and places obstacles and bodies. Some numbers are drawn
uniformly, others with small values more often. As in `hgn.scene.random_scene`, a scene is determined by (config, seed),
bitwise on every machine. Lengths are in domain units, speeds in domain units per second. Bodies are boxes or balls.
"tilt" is the tangent of half an angle, so rotations need no sine or cosine.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from hgn.config import SceneConfig
from hgn.scene.funnel import Quaternion
from hgn.scene.group import WALL_CELLS, Region, particle_count, points_in_ball, random_direction, region_of
from hgn.scene.kinds import ELASTIC_KINDS, MAXIMUM_PARTICLES, MOVING_FRACTION, MOVING_RANGES, RANGES
from hgn.scene.motion import Keyframes, Motion
from hgn.scene.placement import ROUNDING, Body, Placed, blocked, choice, filled, place_shape
from hgn.scene.streams import Stream, stream
from hgn.schema import ConfigError, Vector, triple

DRAWS = 500  # attempts to place one scene
NEAREST_CELLS = 1.0  # smallest distance between obstacles and bodies, in solver cells
NEAR_WALL = 0.08  # largest gap between a wall and a body that is placed next to it
FALLING = (0.0, -9.8, 0.0)
UNTURNED = (1.0, 0.0, 0.0, 0.0)

# Edge lengths in cells of 1/64.
DOMAINS: dict[str, tuple[int, int, int]] = {
    "small": (24, 40, 24),
    "box": (20, 32, 20),
    "tray": (36, 32, 28),
    "flume": (64, 40, 16),
    "slit": (64, 24, 9),
    "long": (128, 40, 24),
    "tall": (40, 96, 40),
    "room": (64, 64, 64),
    "hall": (96, 64, 96),
}


class _DrawAgainError(Exception):
    """Reports that the drawn numbers do not fit together."""


@dataclass
class Layout:
    """Holds an unfinished scene. For example, layout('size') draws a number from RANGES[kind]['size']."""

    config: SceneConfig
    kind: str
    rng: np.random.Generator
    domain: Vector = (1.0, 1.0, 1.0)
    gravity: Vector = FALLING
    obstacles: list[Placed] = field(default_factory=list)
    regions: list[Region] = field(default_factory=list)
    bodies: list[Body] = field(default_factory=list)
    particles: int = 0

    def __call__(self, name: str, small: bool = False) -> float:
        """Draws from a range: low + fraction * (high - low). The fraction is uniform; with `small` it is squared."""
        low, high = (RANGES | MOVING_RANGES)[self.kind][name]
        part = self.rng.random()
        return low + (high - low) * (part * part if small else part)

    def count(self, name: str) -> int:
        """Draws an integer from a range, both limits included."""
        low, high = (RANGES | MOVING_RANGES)[self.kind][name]
        return int(low + int(self.rng.random() * (high - low + 1)))

    def chance(self, probability: float) -> bool:
        return self.rng.random() < probability

    def one_of(self, *names: str) -> str:
        return choice(names, self.rng)

    def take_domain(self, *names: str) -> None:
        """Draws the domain. Raises: _DrawAgainError if it is larger than the configured domain."""
        x, y, z = DOMAINS[self.one_of(*names)]
        self.domain = (x / 64, y / 64, z / 64)
        if any(own > largest for own, largest in zip(self.domain, self.config.domain_size, strict=True)):
            raise _DrawAgainError

    @property
    def low(self) -> float:
        """Returns the smallest coordinate of particles, at the inner face of the solver's walls."""
        return WALL_CELLS * self.config.cell_size + ROUNDING

    def high(self, axis: int) -> float:
        """Returns the largest coordinate of particles along an axis."""
        return self.domain[axis] - self.low

    def along(self, axis: int, half: float) -> float:
        """Draws a coordinate at which a body of half width `half` does not touch the walls. Raises: _DrawAgainError.

        A quarter of the draws are less than NEAR_WALL from touching a wall, the others uniform over the whole range.
        """
        first = self.low + half + ROUNDING
        span = self.high(axis) - half - ROUNDING - first
        if span < 0:
            raise _DrawAgainError
        part = self.rng.random()
        if part >= 0.25:
            return first + span * (part - 0.25) / 0.75
        gap = min(span, NEAR_WALL * abs(8 * part - 1))
        return first + gap if part < 0.125 else first + span - gap

    def place(
        self, shape: str, size: float, position: Vector, quaternion: Quaternion = UNTURNED, keyframes: Keyframes = ()
    ) -> None:
        """Adds an obstacle. Raises: _DrawAgainError if a part of it is outside the domain, unless it moves."""
        item = place_shape(shape, size, position, quaternion, len(self.obstacles))
        if keyframes:
            obstacle = replace(item.obstacle, motion=Motion.of_frames(keyframes, position))
            item = replace(
                item, obstacle=obstacle, record=item.record | {"keyframes": [[t, [*x]] for t, x in keyframes]}
            )
        elif (item.low < 0).any() or (item.high > np.array(self.domain)).any():
            raise _DrawAgainError
        self.obstacles.append(item)

    def add(
        self, shape: str, size: Vector, centre: Vector, velocity: Vector = (0.0, 0.0, 0.0), material: str = ""
    ) -> None:
        """Adds a body of a drawn material, or of the named one if config.materials contains it.

        Raises: _DrawAgainError if it is too large, or too near to walls, obstacles or other bodies.
        """
        region, clearance = region_of(shape, size, centre), NEAREST_CELLS * self.config.cell_size
        inside = (region.reach > 0).all() and (np.array(centre) - region.reach >= self.low - ROUNDING).all()
        inside = inside and all(centre[i] + region.reach[i] <= self.high(i) + ROUNDING for i in range(3))
        if not inside or any(region.distance(other) < clearance for other in self.regions):
            raise _DrawAgainError
        if any(blocked(region, item, clearance) for item in self.obstacles):
            raise _DrawAgainError
        self.particles += particle_count(region, self.config.particles_per_cell, self.config.cell_size)
        if self.particles > MAXIMUM_PARTICLES:
            raise _DrawAgainError
        drawn = self.one_of(*self.config.materials)
        chosen = material if material in self.config.materials else drawn
        self.regions.append(region)
        self.bodies.append(filled(self.config, shape, region, chosen, np.array(velocity), rng=self.rng))

    def body(self, size: float, centre: Vector, velocity: Vector = (0.0, 0.0, 0.0), material: str = "") -> None:
        """Adds a cube or a ball; where all bodies are elastic, also a beam."""
        shapes = ("cube", "sphere", "box") if self.config.materials == ("elastic",) else ("cube", "sphere")
        shape = self.one_of(*shapes)
        sides = (1.6 * size, 0.4 * size, 0.4 * size) if shape == "box" else (size, size, size)
        self.add(shape, sides, centre, velocity, material)

    def cube(self, size: float, centre: Vector, material: str) -> None:
        """Adds a cube at rest."""
        self.add("cube", (size, size, size), centre, material=material)

    def box(self, low: Vector, high: Vector, material: str) -> None:
        """Adds a box at rest between two corners."""
        size = triple(np.array(high) - np.array(low))
        self.add("box", size, triple(0.5 * (np.array(low) + np.array(high))), material=material)

    def tilt_gravity(self, tangent: float) -> None:
        """Turns gravity about a random horizontal axis, by twice the arc tangent of `tangent`."""
        across_x, across_z = random_direction(self.rng, 2).tolist()
        cosine, sine = _turn(tangent)
        size = -FALLING[1]
        self.gravity = (size * sine * across_x, -size * cosine, size * sine * across_z)


def _turn(tangent: float) -> tuple[float, float]:
    """Returns cosine and sine of an angle from the tangent of its half."""
    square = tangent * tangent
    return (1 - square) / (1 + square), 2 * tangent / (1 + square)


def _about_z(tangent: float) -> Quaternion:
    """Returns the quaternion of a turn about z from the tangent of half its angle."""
    length = float(np.sqrt(1 + tangent * tangent))
    return (1 / length, 0.0, 0.0, tangent / length)


def _pool(new: Layout) -> None:
    """Fills the floor from wall to wall with water or sand at rest. Gravity may be tilted, or a body falls in."""
    new.take_domain("small", "box", "tray", "flume", "slit")
    top = new.low + new("depth")
    material = "water" if new.chance(0.5) else new.one_of("sand", "sand", "")
    new.box((new.low,) * 3, (new.high(0), top, new.high(2)), material=material)
    if new.chance(0.5):
        new.tilt_gravity(new("tilt", small=True))
    if new.chance(0.3):
        size = new("size")
        height = top + NEAREST_CELLS * new.config.cell_size + 0.5 * size + new("height")
        new.body(size, (new.along(0, 0.5 * size), height, new.along(2, 0.5 * size)))


def _dam(new: Layout) -> None:
    """Places a block, mostly of water, at one end of a channel, over its whole width. The floor may be wet."""
    new.take_domain("flume", "slit", "long", "tray", "small")
    far = (new.low + new("length"), new.low + new("height"), new.high(2))
    new.box((new.low,) * 3, far, material="water" if new.chance(0.75) else "")
    if new.chance(0.25):
        begin = far[0] + (NEAREST_CELLS + 0.5) * new.config.cell_size
        new.box((begin, new.low, new.low), (new.high(0), new.low + new("wet"), new.high(2)), material="water")


def _column(new: Layout) -> None:
    """Places a column on the floor, which collapses on all sides."""
    new.take_domain("room", "hall", "tall")
    width, height, depth = new("width"), new("height", small=True), new("depth")
    x, z = new.along(0, 0.5 * width), new.along(2, 0.5 * depth)
    low = (x - 0.5 * width, new.low, z - 0.5 * depth)
    new.box(low, (x + 0.5 * width, new.low + height, z + 0.5 * depth), material="sand" if new.chance(0.5) else "")


def _drop(new: Layout) -> None:
    """Drops or throws one body."""
    new.take_domain("room", "hall", "tall")
    size = new("size")
    height = new.low + 0.5 * size + new("height", small=True) + ROUNDING
    velocity = (0.0, 0.0, 0.0)
    if new.chance(0.5):
        velocity = triple(new("speed") * points_in_ball(1, 3, new.rng)[0])
    new.body(size, (new.along(0, 0.5 * size), height, new.along(2, 0.5 * size)), velocity)


def _slope(new: Layout) -> None:
    """Places one or two bodies, half of them of sand, on a tilted plate. They slide off its lower end."""
    new.take_domain("room", "hall")
    plate, tangent = new("plate"), new("tilt")
    cosine, sine = _turn(tangent)
    y = new.low + 0.5 * plate * sine + 0.1 * new.rng.random()
    middle = np.array((new.along(0, 0.5 * plate * cosine), y, new.along(2, 0.5 * plate)))
    new.place("square", plate, triple(middle), _about_z(tangent))
    for _ in range(1 + new.chance(0.5)):
        size, along, across = new("size"), new.rng.random() - 0.3, new.rng.random() - 0.5
        room = 0.5 * (plate - size)
        gap = 0.5 * size * (cosine + sine) + (NEAREST_CELLS + 1) * new.config.cell_size
        up = np.array((cosine, sine, 0.0)) * along * room + np.array((-sine, cosine, 0.0)) * gap
        centre = triple(middle + up + np.array((0.0, 0.0, 2 * across * room)))
        new.body(size, centre, material="sand" if new.chance(0.5) else "")


def _edge(new: Layout) -> None:
    """Drops a body onto the edge of a plate, or past it. Half of the bodies are cubes of snow."""
    new.take_domain("room", "tall")
    plate, size = new("plate"), new("size")
    x, y, z = new.along(0, 0.5 * plate), new.low + new("height"), new.along(2, 0.5 * plate)
    new.place("square", plate, (x, y, z))
    edge = x + (1.0 if new.chance(0.5) else -1.0) * (0.5 * plate + new("beyond"))
    offset = (new.rng.random() - 0.5) * (plate - size)
    centre = (edge, y + 0.5 * size + new("drop", small=True) + ROUNDING, z + offset)
    if new.chance(0.5):
        new.cube(size, centre, "snow")
    else:
        new.body(size, centre)


def _stack(new: Layout) -> None:
    """Places bodies above one another. Half of the stacks are of cubes of one material, often snow."""
    new.take_domain("room", "tall", "tray")
    size, cubes, material = new("size"), new.chance(0.5), "snow" if new.chance(0.6) else new.one_of("snow", "sand")
    x, z, y = new.along(0, size), new.along(2, size), new.low + ROUNDING
    for _ in range(new.count("bodies")):
        centre = (x + new("shift"), y + 0.5 * size, z + new("shift"))
        if cubes:
            new.cube(size, centre, material)
        else:
            new.body(size, centre)
        y += size + (NEAREST_CELLS + 0.5) * new.config.cell_size


def _apart(new: Layout) -> None:
    """Places bodies on the floor without contact. Some slide, many slowly. In 30 %, tilted gravity moves all."""
    new.take_domain("room", "hall", "long")
    for _ in range(new.count("bodies")):
        size, velocity = new("size"), (0.0, 0.0, 0.0)
        if new.chance(0.5):
            across_x, across_z = random_direction(new.rng, 2).tolist()
            speed = new("speed", small=new.chance(0.5))
            velocity = (speed * across_x, 0.0, speed * across_z)
        centre = (new.along(0, 0.5 * size), new.low + 0.5 * size + ROUNDING, new.along(2, 0.5 * size))
        new.body(size, centre, velocity)
    if new.chance(0.3):
        new.tilt_gravity(new("tilt"))


def _bowl(new: Layout) -> None:
    """Drops bodies into a bowl that stands on the floor."""
    new.take_domain("room", "tall")
    width, size = new("bowl"), new("size")
    x, z = new.along(0, 0.5 * width), new.along(2, 0.5 * width)
    base = new.low + 0.25 * width
    new.place(new.one_of("half_sphere", "half_box"), width, (x, base, z))
    y = base + 0.25 * width + 0.5 * size + new("height")
    for _ in range(1 + new.chance(0.4)):
        shift_x, shift_z = (0.3 * width * (new.rng.random() - 0.5) for _ in range(2))
        new.body(size, (x + shift_x, y, z + shift_z))
        y += size + (NEAREST_CELLS + 0.5) * new.config.cell_size


def _channel(new: Layout) -> None:
    """Releases a block between two upright plates."""
    new.take_domain("room", "hall")
    plate, width, length = new("plate"), new("width"), new("length")
    x, z, y = new.along(0, 0.5 * plate), new.along(2, 0.5 * width), 0.5 * plate
    quarter = (float(np.sqrt(0.5)), float(np.sqrt(0.5)), 0.0, 0.0)
    for side in (-0.5, 0.5):
        new.place("square", plate, (x, y + ROUNDING, z + side * width), quarter)
    half = 0.5 * width - (NEAREST_CELLS + 1.5) * new.config.cell_size
    begin = x - 0.5 * plate + 0.3 * plate * new.rng.random()
    low = (begin, new.low, z - half)
    new.box(low, (begin + length, new.low + new("height"), z + half), material="water" if new.chance(0.6) else "")


def _stairs(new: Layout) -> None:
    """Drops a body onto the top of a flight of steps."""
    new.take_domain("hall", "room")
    plate, rise, size, steps = new("plate"), new("rise"), new("size"), new.count("steps")
    tread = 0.7 * plate
    x, z = new.along(0, 0.5 * plate), new.along(2, 0.5 * plate)
    for step in range(steps):
        new.place("square", plate, (x + step * tread, new.low + (steps - step) * rise, z))
    height = new.low + steps * rise + 0.5 * size + (NEAREST_CELLS + 1) * new.config.cell_size
    new.add(new.one_of("cube", "sphere"), (size,) * 3, (x, height, z), material="water" if new.chance(0.5) else "")


def _jet(new: Layout) -> None:
    """Throws a bar along its axis, often against a wall. Half of the jets have no gravity."""
    new.take_domain("hall", "room", "long")
    length, width = new("length"), new("width")
    centre = (new.along(0, 0.5 * length), new.along(1, 0.5 * width), new.along(2, 0.5 * width))
    speed = new("speed") * (1.0 if new.chance(0.5) else -1.0)
    new.gravity = FALLING if new.chance(0.5) else (0.0, 0.0, 0.0)
    new.add("box", (length, width, width), centre, (speed, 0.0, 0.0), "water" if new.chance(0.6) else "")


def _motion(new: Layout, way: Vector) -> Keyframes:
    """Returns keyframes of a motion with constant speed, which begins after up to half a second."""
    wait, length = 0.5 * new.rng.random(), float(np.sqrt(sum(x * x for x in way)))
    return [(wait, (0.0, 0.0, 0.0)), (wait + length / new("speed"), way)]


def _paddle(new: Layout) -> None:
    """Pushes a pool along a channel with an upright sheet that is wider than the channel."""
    new.take_domain("flume", "slit", "long")
    size, begin, length = 2 * max(new.domain[2], 0.15), new.low + 0.2 * new.rng.random(), new("length")
    far = min(begin + new("gap") + length, new.high(0))
    way = (0.2 + 0.6 * new.rng.random()) * (new.high(0) - begin)
    middle = (begin, 0.5 * size, 0.5 * new.domain[2])
    new.place("square", size, middle, _about_z(1.0), _motion(new, (way, 0.0, 0.0)))
    high = (far, new.low + new("depth"), new.high(2))
    new.box((far - length, new.low, new.low), high, material="water" if new.chance(0.6) else "")


def _piston(new: Layout) -> None:
    """Presses a body on the floor together with a plate from above, elastic bodies by half as much as others."""
    new.take_domain("room", "small", "tray")
    size, gap = new("size"), new("gap")
    x, z, top = new.along(0, 0.5 * size), new.along(2, 0.5 * size), new.low + size
    way = gap + new("way") * size * (0.5 if "elastic" in new.config.materials else 1.0)
    middle = (x, top + NEAREST_CELLS * new.config.cell_size + gap, z)
    new.place("square", 1.5 * size + 0.15, middle, UNTURNED, _motion(new, (0.0, -way, 0.0)))
    new.body(size, (x, new.low + 0.5 * size + ROUNDING, z), material="snow" if new.chance(0.4) else "")


def _conveyor(new: Layout) -> None:
    """Carries a body on a plate that moves horizontally."""
    new.take_domain("room", "hall", "tray")
    plate, size, (across_x, across_z) = new("plate"), new("size"), random_direction(new.rng, 2).tolist()
    x, y, z = new.along(0, 0.4 * plate), new.low + new("height"), new.along(2, 0.4 * plate)
    way = 0.2 + 0.3 * new.rng.random()
    new.place("square", plate, (x, y, z), UNTURNED, _motion(new, (way * across_x, 0.0, way * across_z)))
    new.body(size, (x, y + 0.5 * size + (NEAREST_CELLS + 0.5) * new.config.cell_size, z))


def _falling(new: Layout) -> None:
    """Drops a plate onto a body, on four segments that approximate a parabola, to half of the body's height."""
    new.take_domain("room", "hall")
    size, height = new("size"), new("height")
    way, x, z = height + 0.5 * size, new.along(0, 0.5 * size), new.along(2, 0.5 * size)
    step_s = 7 / 16 * way / new("speed")  # the speed is that of the last piece
    keyframes = [(piece * step_s, (0.0, -way * piece * piece / 16, 0.0)) for piece in range(5)]
    new.place("square", 1.2 * size + 0.1, (x, new.low + size + height, z), UNTURNED, keyframes)
    new.body(size, (x, new.low + 0.5 * size + ROUNDING, z))


_PLACED: dict[str, Callable[[Layout], None]] = {
    "pool": _pool, "dam": _dam, "column": _column, "drop": _drop, "slope": _slope, "edge": _edge, "stack": _stack,
    "apart": _apart, "bowl": _bowl, "channel": _channel, "stairs": _stairs, "jet": _jet,
    "paddle": _paddle, "piston": _piston, "conveyor": _conveyor, "falling": _falling,
}  # fmt: skip


def _paper(new: Layout) -> SceneConfig:
    """Returns settings for random_scene, for a kind with random positions of groups and obstacles, as in the paper."""
    new.take_domain("room", "hall")
    config = replace(new.config, kinds={}, domain_size=new.domain, group_size=new("size"))
    volume = (config.group_size / config.cell_size) * (config.group_size / config.cell_size)
    each = config.particles_per_cell * volume * (config.group_size / config.cell_size) + 1
    groups = min(new.count("groups"), int(MAXIMUM_PARTICLES / each))
    config = replace(config, group_count=groups, obstacle_count=0)
    if new.kind == "funnel":
        low, high = RANGES["funnel"]["hole"]
        config = replace(config, materials=("sand",)) if "sand" in config.materials and new.chance(0.5) else config
        return replace(config, obstacle_count=4, funnel_scene_fraction=1.0, funnel_hole=(low, high))
    if new.kind in ("obstacles", "motion"):
        config = replace(config, obstacle_count=new.count("obstacles"))
    if new.kind == "obstacles":
        return config
    config = replace(config, maximum_initial_speed=new("speed"), lone_particles=2)
    if new.kind == "collision":
        return replace(config, colliding_scene_fraction=1.0, zero_gravity_fraction=0.3, tilted_gravity_fraction=0.3)
    moving = replace(config, moving_group_fraction=0.6, pure_direction_fraction=0.3)
    return replace(moving, zero_gravity_fraction=0.1, tilted_gravity_fraction=0.3)


def draw_kind(kinds: Mapping[str, float], rng: np.random.Generator) -> str:
    """Draws one of the kinds. Their probabilities are in proportion to the numbers in `kinds`."""
    rest = rng.random() * sum(kinds.values())
    for kind, share in kinds.items():
        rest -= share
        if rest < 0:
            return kind
    return [kind for kind, share in kinds.items() if share > 0][-1]


def draw_layout(config: SceneConfig, seed: int) -> tuple[str, Layout | SceneConfig]:
    """Draws a scene of a kind in `config.kinds`.

    Returns the kind and a Layout. For the kinds of `_paper` it returns settings for `hgn.scene.random_scene` instead.
    Raises: ConfigError if a kind does not fit into `config.domain_size`. Kinds of the shipped experiments fit.
    """
    rng = stream(seed, Stream.KIND)
    kind = draw_kind(config.kinds, rng)
    if "moving" in config.own_physics:
        own = stream(seed, Stream.MOVING)
        possible = tuple(k for k in MOVING_RANGES if k in ELASTIC_KINDS or "elastic" not in config.materials)
        kind, rng = (choice(possible, own), own) if own.random() < MOVING_FRACTION else (kind, rng)
    for _ in range(DRAWS):
        new = Layout(config, kind, rng)
        try:
            if kind not in _PLACED:
                return kind, _paper(new)
            _PLACED[kind](new)
        except _DrawAgainError:
            continue
        new.config = replace(config, kinds={}, domain_size=new.domain)
        return kind, new
    raise ConfigError(
        f"kinds must fit into domain_size {list(config.domain_size)}, got {kind}; raise domain_size or leave {kind} out"
    )
