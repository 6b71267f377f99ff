"""The largest stable step, measured against the formula dt = dx sqrt(rho / (3 lambda + 2 mu)).

A single particle is the stability limit: its own stress meets no neighbour's resistance. One that bounces off the
floor keeps a strain afterwards, which oscillates without end at a stable step and grows at an unstable one. Plastic
flow hides the growth (stretched sand bears no stress, snow yields), so the formula is measured on water and on an
elastic solid; sand and snow themselves are measured as blocks pressed into a corner, which bear more.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.mpm.layout import lame_parameters
from datagen.mpm.solver import SceneFailure, Simulated, simulate
from hgn.config import MpmConfig
from hgn.scene.material import ELASTIC, SAND, SNOW, WATER
from hgn.scene.scene import Scene
from hgn.system.files import write_atomically
from tools.figure import as_png, new_figure
from tools.stability.row import Row
from tools.stability.solver_scenes import CELL, block, particles

STIFFNESS = (1.0, 10.0, 100.0, 1000.0)  # times the default Young's modulus
FACTORS = (0.5, 0.8, 0.9, 0.94, 0.97, 1.0, 1.03, 1.06, 1.1, 1.3, 1.7)  # of the formula
SOLID_FACTORS = (0.5, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0)
SUBSTEPS, FRAMES = 50, 21  # a frame
WITHIN = 0.06  # of the formula; the factors lie 3 % apart
FASTER = 1.5  # times the speed of impact: energy from nowhere


@dataclass(frozen=True)
class Point:
    """One simulation of the picture."""

    case: str
    stiffness: float  # times the default
    step_s: float
    factor: float  # of the formula
    stable: bool

    def mapping(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


def formula(config: MpmConfig, material: int) -> float:
    """The single-particle limit of unhardened material, s."""
    shear, bulk = lame_parameters(config)
    return CELL * math.sqrt(config.density_kg_m3 / (3 * bulk + (2 * shear if material != WATER else 0.0)))


def largest_steps(base: MpmConfig) -> tuple[list[Row], list[Point]]:
    """A row for each material and stiffness, and all simulations behind them."""
    rows, points = [], []
    for stiffness in STIFFNESS:
        modulus = base.youngs_modulus_pa * stiffness
        # speeds like the speed of sound, so that the same strains arise
        speed = math.sqrt(stiffness)
        config = dataclasses.replace(base, youngs_modulus_pa=modulus, time_step="fixed")
        cases = (
            ("single particle, water", WATER, _singles(WATER, speed), FACTORS),
            ("single particle, elastic solid", ELASTIC, _singles(ELASTIC, speed), FACTORS),
            ("block in a corner, sand", SAND, _corner(SAND, speed), SOLID_FACTORS),
            ("block in a corner, snow", SNOW, _corner(SNOW, speed), SOLID_FACTORS),
        )  # fmt: skip
        for name, material, scenes, factors in cases:
            row, tried = _measure(name, stiffness, config, material, scenes, factors)
            rows.append(row)
            points += tried
    return rows, points


def _measure(
    name: str, stiffness: float, config: MpmConfig, material: int, scenes: list[Scene], factors: tuple[float, ...]
) -> tuple[Row, list[Point]]:
    limit = formula(config, material)
    points, beyond, measured = [], "stable at all steps tried", 0.0
    for factor in factors:
        step = factor * limit
        own = dataclasses.replace(config, fixed_time_step_s=step)
        # a frame of whole steps; the margin keeps rounding from adding one
        outcomes = simulate(scenes, own, FRAMES, (1 + 1e-9) / (SUBSTEPS * step))
        signs = [_sign(outcome, scene) for outcome, scene in zip(outcomes, scenes, strict=True)]
        unstable = [sign for sign in signs if sign]
        points.append(Point(name, stiffness, step, factor, not unstable))
        if unstable:
            beyond = f"at {factor:g} times the formula, in {len(unstable)} of {len(signs)} scenes: {max(unstable)}"
            break
        measured = step
    single = name.startswith("single")
    held = abs(measured / limit - 1) <= WITHIN if single else measured >= limit
    case = f"largest step, {name}, stiffness x{stiffness:g}"
    return Row(case, limit, measured, held, beyond), points


def _sign(outcome: Simulated | SceneFailure, scene: Scene) -> str:
    """What tells that the step was unstable; empty where nothing does."""
    if isinstance(outcome, SceneFailure):
        return f"stopped, {outcome.cause}"
    if outcome.counters["water_volume_floors"] or outcome.counters["singular_value_floors"]:
        return "the particle's strain grows to its floor"
    if outcome.counters["largest_speed"] > FASTER * float(np.linalg.norm(scene.velocity_N3, axis=1).max()):
        return "faster than it came"
    return ""


def _singles(material: int, speed: float) -> list[Scene]:
    """One particle a scene, at 24 places within a cell, about to touch the floor; without gravity."""
    places = [(x, y, z) for x in (0, 0.25, 0.5) for y in (0, 0.25, 0.5, 0.75) for z in (0, 0.25)]
    return [
        particles(material, np.array([[32, 2.75, 32]]) + place, (0, -speed, 0), gravity=(0.0, 0.0, 0.0))
        for place in places
    ]


def _corner(material: int, speed: float) -> list[Scene]:
    velocity = (-speed, -speed, -speed)
    return [block(material, (2.8, 2.8, 2.8), (2, 2, 2), velocity, seed) for seed in range(6)]


def draw(points: list[Point], base: MpmConfig, file: Path) -> None:
    """Stable and unstable steps over the stiffness, with the formula as a line, as PNG."""
    cases = list(dict.fromkeys(point.case for point in points))
    figure, (axes,) = new_figure(1, len(cases), (3.4 * len(cases), 3.6), share_y=True)
    for axis, case in zip(axes, cases, strict=True):
        own = [point for point in points if point.case == case]
        for stable, marker, color in ((True, "o", "#2a7f62"), (False, "x", "#b3402a")):
            kept = [point for point in own if point.stable == stable]
            label = "stable" if stable else "unstable"
            steps = [point.step_s * 1e3 for point in kept]
            axis.plot([point.stiffness for point in kept], steps, marker, color=color, label=label, markersize=5)
        stiffness = np.geomspace(min(STIFFNESS) / 1.6, max(STIFFNESS) * 1.6)
        limit = [1e3 * point.step_s / point.factor * math.sqrt(point.stiffness) for point in own[:1]]
        axis.plot(stiffness, limit[0] / np.sqrt(stiffness), "-", color="#39424e", label="formula")
        used = limit[0] * base.stability_fraction
        axis.plot(stiffness, used / np.sqrt(stiffness), "--", color="#39424e", label="the solver's own step")
        axis.set(xscale="log", yscale="log", title=case, xlabel="Young's modulus, times 1 MPa")
    axes[0].set_ylabel("step, ms")
    axes[0].legend(fontsize=8)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(file, as_png(figure))
