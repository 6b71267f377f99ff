"""Stiff materials, fast impacts, convergence of the default step, and a long run."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from datagen.mpm.solver import SceneFailure, Simulated, particle_bounds, simulate
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SNOW
from hgn.scene.scene import Scene
from tools.scenes import joined
from tools.stability.row import Row
from tools.stability.solver_scenes import (
    block,
    centre_cells,
    front_cells,
    height_cells,
    positions,
    rms_speed,
    thickness_cells,
)

FRAME_RATE_HZ = 60.0
STIFFNESS = (1.0, 10.0, 100.0, 1000.0)
SPEEDS = (5.0, 10.0, 20.0, 30.0)
ENERGY = 1.01  # kinetic energy, of the initial plus potential energy; 0.01 covers rounding and frames
TOUCHED = ("floors", "caps", "clamps", "bounds")  # ends of the names of counters
CONVERGED = 0.03  # relative change of height or front at half the step
CONVERGENCE_RATE_HZ = 240.0
RESOLVED_CELLS = 2.0
LONG_SUBSTEPS = 100_000
LONG_STEP_S = 1.5e-4
DROP_CELLS = 1.0  # between floor and block
MEASURES = {"height": height_cells, "centre": centre_cells, "front": front_cells}


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


def convergence(base: MpmConfig) -> Iterator[Row]:
    """Compares heights of falling blocks and fronts of collapsing columns at the default step and at half of it.

    A row is the largest change over the frames in which the material is at least two cells thick and its centre sinks.
    Two floors are reported with it: the change by a displacement of 1e-6, and by another random filling. The rate of
    transfers stays the same, because their number smooths velocities (see results/solver).
    """
    half = dataclasses.replace(base, stability_fraction=base.stability_fraction / 2)
    blocks = [
        (f"a block of {MATERIALS[kind]} at {speed:g} m/s", partial(_falling, kind, speed, 8.0), 0.1, "centre")
        for speed in (4.5, 10.0)
        for kind in range(3)
    ]
    columns = [
        (f"a column of {MATERIALS[kind]}", partial(block, kind, (2, 2, 28), (6, 12, 8)), 0.4, "front")
        for kind in range(3)
    ]
    for name, make, seconds, other in (*blocks, *columns):
        frames = 1 + round(CONVERGENCE_RATE_HZ * seconds)
        first = make(seed=0)
        shift = np.random.default_rng(1).standard_normal(first.position_N3.shape).astype(np.float32)
        moved = dataclasses.replace(first, position_N3=first.position_N3 + np.float32(1e-6) * shift)
        outcomes = [
            outcome
            for config, scenes in ((base, [first, moved, make(seed=1)]), (half, [first]))
            for outcome in simulate(scenes, config, frames, CONVERGENCE_RATE_HZ)
        ]
        paths = [positions(outcome).astype(np.float64) for outcome in outcomes]
        steps = [{n: o.counters[n] for n in ("substeps", "transfers")} for o in outcomes if isinstance(o, Simulated)]
        until = _sinks_until(paths[0])
        for measure in ("height", other):
            series = [np.array([MEASURES[measure](x) for x in path[:until]]) for path in paths]
            chaos, filling, change = (float(np.abs(changed / series[0] - 1).max()) for changed in series[1:])
            beyond = (
                f"floors: {chaos:.1%} by 1e-6, {filling:.1%} by another filling; {series[0][0]:.3g} cells became "
                f"{series[0][-1]:.4g}, and {series[3][-1]:.4g} at half the step"
            )
            more: dict[str, Any] = {"displaced": chaos, "filled_anew": filling, "frames": until}
            more |= {"default_step": steps[0], "half_the_step": steps[-1]}
            yield Row(f"half the step: {measure} of {name}", CONVERGED, change, change < CONVERGED, beyond, more)


def _sinks_until(path_TN3: np.ndarray) -> int:
    """Returns the number of frames until the material is thinner than two cells or its centre no longer sinks."""
    thin = np.array([thickness_cells(position) for position in path_TN3]) < RESOLVED_CELLS
    rises = np.append(np.diff(path_TN3[:, :, 1].mean(axis=1)) > 0, False)
    return int(np.argmax(np.append(thin | rises, True)))


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


def _falling(kind: int, speed: float, size: float = 4.0, seed: int = 0) -> Scene:
    return block(kind, (30, 3 + DROP_CELLS, 30), (size, size, size), (0, -speed, 0), seed)


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
