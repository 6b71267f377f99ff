"""Stiff materials, fast impacts, and a long run."""

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence

import numpy as np

from datagen.mpm.solver import SceneFailure, particle_bounds, simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SNOW
from hgn.scene.scene import Scene
from tools.scenes import joined
from tools.stability.row import Row
from tools.stability.solver_scenes import block, rms_speed

FRAME_RATE_HZ = 60.0
STIFFNESS = (1.0, 10.0, 100.0, 1000.0)
SPEEDS = (5.0, 10.0, 20.0, 30.0)
ENERGY = 1.01  # kinetic energy, of the initial plus potential energy; 0.01 covers rounding and frames
TOUCHED = ("floors", "caps", "clamps", "bounds")  # ends of the names of counters
LONG_SUBSTEPS = 100_000
LONG_STEP_S = 1.5e-4
DROP_CELLS = 1.0  # between floor and block


def stiffnesses(base: MpmConfig) -> Iterator[Row]:
    """Drops blocks at 3 m/s, up to 1000 times stiffer than the default, and a block of two stiffnesses."""
    for stiffness in STIFFNESS:
        config = dataclasses.replace(base, youngs_modulus_pa=base.youngs_modulus_pa * stiffness)
        names = [f"stiffness x{stiffness:g}, {MATERIALS[kind]} at 3 m/s" for kind in range(3)]
        yield from _bounded(names, [_falling(kind, 3.0) for kind in range(3)], config, 7)
    soft = _falling(SNOW, 3.0)
    modulus = np.full(soft.particle_count, base.youngs_modulus_pa, np.float32)
    modulus[soft.position_N3[:, 0] > soft.position_N3[:, 0].mean()] *= STIFFNESS[-1]
    contrast = dataclasses.replace(soft, material_parameters={"youngs_modulus_pa": modulus})
    yield from _bounded([f"stiffness contrast 1:{STIFFNESS[-1]:g}, snow at 3 m/s"], [contrast], base, 7)


def impacts(base: MpmConfig) -> Iterator[Row]:
    """Drops blocks and single particles at up to 30 m/s."""
    cases = list(itertools.product(SPEEDS, range(3), {"block": 4.0, "particle": 0.1}.items()))
    names = [f"impact at {speed:g} m/s, {what} of {MATERIALS[kind]}" for speed, kind, (what, _) in cases]
    return _bounded(names, [_falling(kind, speed, size) for speed, kind, (_, size) in cases], base, 13)


def long_run(base: MpmConfig) -> Iterator[Row]:
    """Simulates a small scene of three materials for 100,000 substeps; it must stay at rest."""
    config = dataclasses.replace(base, fixed_time_step_s=LONG_STEP_S)
    blocks = [block(kind, (4 + 6 * kind, 3.5, 4), (3, 3, 3), seed=kind) for kind in range(3)]
    scene = dataclasses.replace(joined(blocks), domain_size=(24 / 64, 24 / 64, 24 / 64))
    frames = 1 + math.ceil(LONG_SUBSTEPS / math.ceil(1 / (FRAME_RATE_HZ * LONG_STEP_S)))
    (outcome,) = simulate([scene], config, frames, FRAME_RATE_HZ)
    if isinstance(outcome, SceneFailure):
        yield Row("long run", LONG_SUBSTEPS, 0.0, False, outcome.cause)
        return
    speed = rms_speed(outcome.position_TN3[-60:], FRAME_RATE_HZ)
    steps = float(outcome.counters["substeps"])
    beyond = f"root mean square speed over the last second {speed:.2g} m/s"
    yield Row("long run, three materials", LONG_SUBSTEPS, steps, steps >= LONG_SUBSTEPS and speed < 0.05, beyond)


def _falling(kind: int, speed: float, size: float = 4.0) -> Scene:
    return block(kind, (30, 3 + DROP_CELLS, 30), (size, size, size), (0, -speed, 0))


def _bounded(names: Sequence[str], scenes: Sequence[Scene], config: MpmConfig, frames: int) -> Iterator[Row]:
    """Checks that scenes stay finite and inside of the domain, and that kinetic energy does not exceed the total."""
    for name, scene, outcome in zip(names, scenes, simulate(scenes, config, frames, FRAME_RATE_HZ), strict=True):
        if isinstance(outcome, SceneFailure):
            yield Row(name, ENERGY, "stopped", False, outcome.cause)
            continue
        low, high = particle_bounds(scene, config)
        inside = bool(((outcome.position_TN3 >= low) & (outcome.position_TN3 <= high)).all())
        path = outcome.position_TN3.astype(float)
        square = ((np.diff(path, axis=0) * FRAME_RATE_HZ) ** 2).sum(axis=2).mean(axis=1)
        start = float((scene.velocity_N3.astype(float) ** 2).sum(axis=1).mean())
        fallen = path[0, :, 1].mean() - path[1:, :, 1].mean(axis=1)
        energy = float((square / (start + 2 * abs(scene.gravity[1]) * np.maximum(fallen, 0))).max())
        floors = {key: value for key, value in outcome.counters.items() if value and key.endswith(TOUCHED)}
        noted = ", ".join(f"{value} {key.replace('_', ' ')}" for key, value in floors.items()) or "no bound reached"
        more = {key: outcome.counters[key] for key in ("substeps", "smallest_time_step_s", "largest_speed")}
        yield Row(name, ENERGY, energy, inside and energy <= ENERGY, noted, more)
