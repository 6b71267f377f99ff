"""The largest stable step, measured against the formula dt = dx sqrt(rho / (3 lambda + 2 mu)).

A single particle has the smallest limit: no neighbour resists its stress. After a bounce off the floor its strain
oscillates at a stable step and grows at an unstable one. Plastic flow hides the growth, so single particles are water
or an elastic solid. Sand and snow are blocks pressed into a corner, which remain stable at larger steps.
"""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from datagen.mpm.layout import lame_parameters
from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.scene.scene import Scene
from tools.report import as_png, new_figure
from tools.scenes import filled
from tools.stability.row import Row
from tools.stability.solver_scenes import CELL, block

STIFFNESS = (1.0, 10.0, 100.0, 1000.0)  # times the default Young's modulus
FACTORS = (0.5, 0.8, 0.9, 0.94, 0.97, 1.0, 1.03, 1.06, 1.1, 1.3, 1.7)  # of the formula
SOLID_FACTORS = (0.5, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0)
SUBSTEPS, FRAMES = 50, 21  # a frame
WITHIN = 0.06  # of the formula; the factors lie 3 % apart
FASTER = 1.5  # times the speed of impact: a sign of instability


Point = dict[str, Any]  # a simulation of the figure
POINT = ("case", "stiffness", "step_s", "factor", "stable")  # stiffness times the default, factor of the formula


def formula(config: MpmConfig, material: int) -> float:
    """Returns the largest stable step of a single particle of unhardened material, s."""
    shear, bulk = lame_parameters(config)
    return CELL * math.sqrt(config.density_kg_m3 / (3 * bulk + (2 * shear if material != WATER else 0.0)))


def singles(material: int, speed: float) -> list[Scene]:
    """Returns scenes of one particle about to touch the floor, at 24 places within a cell, without gravity."""
    places = [(x, y, z) for x in (0, 0.25, 0.5) for y in (0, 0.25, 0.5, 0.75) for z in (0, 0.25)]
    above = [CELL * (np.array([[32, 2.75, 32]]) + place) for place in places]
    return [filled(material, place, (0, -speed, 0), cell_size=CELL, gravity=(0.0, 0.0, 0.0)) for place in above]


def corners(material: int, speed: float) -> list[Scene]:
    """Returns blocks that are pressed into a corner."""
    velocity = (-speed, -speed, -speed)
    return [block(material, (2.8, 2.8, 2.8), (2, 2, 2), velocity, seed) for seed in range(6)]


CASES: dict[str, tuple[int, Callable[[int, float], list[Scene]], tuple[float, ...]]] = {
    "single particle, water": (WATER, singles, FACTORS),
    "single particle, elastic solid": (ELASTIC, singles, FACTORS),
    "block in a corner, sand": (SAND, corners, SOLID_FACTORS),
    "block in a corner, snow": (SNOW, corners, SOLID_FACTORS),
}


def largest_steps(base: MpmConfig, points: list[Point]) -> Iterator[Row]:
    """Yields a row for each stiffness and case, and adds its simulations to `points`."""
    for stiffness, (name, (material, make, factors)) in itertools.product(STIFFNESS, CASES.items()):
        config = dataclasses.replace(base, youngs_modulus_pa=base.youngs_modulus_pa * stiffness)
        scenes = make(material, math.sqrt(stiffness))  # speeds proportional to that of sound: the same strains
        limit, beyond, measured = formula(config, material), "stable at all steps tried", 0.0
        for factor in factors:
            step = factor * limit
            own = dataclasses.replace(config, fixed_time_step_s=step)
            # a frame of whole steps; the margin keeps rounding from adding one
            outcomes = simulate(scenes, own, FRAMES, (1 + 1e-9) / (SUBSTEPS * step))
            unstable = list(filter(None, map(_sign, outcomes, scenes)))
            points.append(dict(zip(POINT, (name, stiffness, step, factor, not unstable), strict=True)))
            if unstable:
                where = f"in {len(unstable)} of {len(scenes)} scenes: {max(unstable)}"
                beyond = f"at {factor:g} times the formula, {where}"
                break
            measured = step
        held = abs(measured / limit - 1) <= WITHIN if name.startswith("single") else measured >= limit
        yield Row(f"largest step, {name}, stiffness x{stiffness:g}", limit, measured, held, beyond)


def _sign(outcome: Simulated | SceneFailure, scene: Scene) -> str:
    """Returns the sign of an unstable step, or an empty string."""
    if isinstance(outcome, SceneFailure):
        return f"stopped, {outcome.cause}"
    if outcome.counters["water_volume_floors"] or outcome.counters["singular_value_floors"]:
        return "the particle's strain grows to its bound"
    if outcome.counters["largest_speed"] > FASTER * float(np.linalg.norm(scene.velocity_N3, axis=1).max()):
        return "faster than at the impact"
    return ""


def draw(points: list[Point], base: MpmConfig) -> bytes:
    """Plots stable and unstable steps over the stiffness, with the formula as a line; returns PNG bytes."""
    cases = list(dict.fromkeys(point["case"] for point in points))
    figure, (axes,) = new_figure(1, len(cases), (3.4 * len(cases), 3.6), share_y=True)
    stiffness = np.geomspace(min(STIFFNESS) / 1.6, max(STIFFNESS) * 1.6)
    for axis, case in zip(axes, cases, strict=True):
        own = [point for point in points if point["case"] == case]
        for stable, marker, color in ((True, "o", "#2a7f62"), (False, "x", "#b3402a")):
            xy = [(p["stiffness"], 1e3 * p["step_s"]) for p in own if p["stable"] == stable]
            label = "stable" if stable else "unstable"
            axis.plot([x for x, _ in xy], [y for _, y in xy], marker, color=color, label=label, markersize=5)
        limit = 1e3 * own[0]["step_s"] / own[0]["factor"] * np.sqrt(own[0]["stiffness"] / stiffness)
        axis.plot(stiffness, limit, "-", color="#39424e", label="formula")
        axis.plot(stiffness, limit * base.stability_fraction, "--", color="#39424e", label="the solver's step")
        axis.set(xscale="log", yscale="log", title=case, xlabel="Young's modulus, times 1 MPa")
    axes[0].set_ylabel("step, ms")
    axes[0].legend(fontsize=8)
    return as_png(figure)
