"""The family `parameters` of `tools.stability network`: figures that depend on a parameter of the scene.

Each case has one value of a parameter and DRAWS scenes, which differ in place, size and particles. The figure of the
network is compared with that of the solver. The solver also simulates the same scenes with the default of the
parameter: a network that ignores the parameter has about this figure, so it must fail.
Shape legend: T frames, N particles.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hgn.scene.material import INPUT_PARAMETERS, MATERIALS
from hgn.scene.own_physics import NOMINAL_P
from hgn.scene.rotation import euler_rotation
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import Vector
from tools.scenes import PARTICLES_PER_CELL, filled, with_friction
from tools.stability.case import Case, Outcome, Parameter
from tools.stability.checks import interval_text
from tools.stability.row import Row

DRAWS = 3  # number of scenes of a case
VARIED, SHIFTED = 0.03, 0.02  # largest relative change of each edge, and shift along x and z in domain units
WITHIN = 0.1  # largest mean size of the errors that passes, as a fraction of the solver's figure
CELL = 1 / 64
FLOOR = 3 * CELL  # height of the domain's floor
AVERAGED = 10  # number of last frames over which widths are averaged
EDGE = 0.98  # fraction of the particles within the edge of a heap
SUPPORT_HEIGHT, SPAN = (
    0.25,
    0.36,
)  # height of the supports of a beam; distance of their edges from its middle, in lengths
GAP = 0.5 * CELL  # distance of the lowest particles from the surface below a body
SLOPE_DEG, SLOPE_SIDE, SLOPE_START = 20.0, 0.8, -0.26  # start of the block along the slope, from the slope's middle


def run_out(path_TN3: np.ndarray, _: Scene) -> float:
    """Returns by how much the edge of a column moves outwards, domain units."""
    return _grown(path_TN3, lambda distance_TN: np.quantile(distance_TN, EDGE, axis=1))


def spread(path_TN3: np.ndarray, _: Scene) -> float:
    """Returns by how much the root mean square distance from the axis grows, domain units."""
    return _grown(path_TN3, lambda distance_TN: np.sqrt(np.square(distance_TN).mean(axis=1)))


def _grown(path_TN3: np.ndarray, width: Callable[[np.ndarray], np.ndarray]) -> float:
    flat_TN2 = path_TN3[[0, *range(-AVERAGED, 0)]][..., [0, 2]].astype(np.float64)
    first, *last = width(np.linalg.norm(flat_TN2 - flat_TN2.mean(axis=1, keepdims=True), axis=2))
    return float(np.mean(last) - first)


def sag(path_TN3: np.ndarray, _: Scene) -> float:
    """Returns how far the middle of a beam hangs below its parts on the supports, domain units.

    The beam swings about its rest with little damping, so this is the mean over all frames, two periods or more.
    """
    place_TN3 = path_TN3.astype(np.float64)
    along_N = place_TN3[0, :, 0] - place_TN3[0, :, 0].mean()
    away_N = np.abs(along_N) / np.ptp(along_N)
    above_T = place_TN3[:, np.abs(away_N - SPAN) < 0.05, 1].mean(axis=1) - place_TN3[:, away_N < 0.1, 1].mean(axis=1)
    return float(above_T[1:].mean() - above_T[0])


def slid(path_TN3: np.ndarray, scene: Scene) -> float:
    """Returns the mean displacement down a slope, domain units."""
    down_3 = _slope_axes()[1]
    return float((path_TN3[-1].astype(np.float64) - path_TN3[0]).mean(axis=0) @ down_3)


@dataclass(frozen=True)
class Kind:
    """A figure, its scenes, and values of the parameter that it depends on."""

    label: str
    parameter: str
    values: tuple[float, ...]
    unit: str
    range: tuple[float, float]  # of the training data
    nominal: float  # the solver's default
    frames: int
    figure: Callable[[np.ndarray, Scene], float]
    scene: Callable[[np.random.Generator], Scene]  # with the default of the parameter


def parameters(frame_rate_hz: float, solver: bool) -> Iterator[Case]:
    """Yields a case for each value of each kind."""
    for kind in KINDS if solver else ():
        nominal = tuple(kind.scene(np.random.default_rng(draw)) for draw in range(DRAWS))
        for value in kind.values:
            own = nominal if value == kind.nominal else tuple(_with(scene, kind.parameter, value) for scene in nominal)
            low, high = kind.range
            place = "edge" if value in kind.range else "inside" if low < value < high else "outside"
            name = f"{kind.label}, {kind.unit.format(value)} ({place})"
            own_case = Parameter(kind.parameter, value, place, kind.figure)
            if kind.parameter == "friction":
                own_case = _of_slide(own_case, (kind.frames - 1) / frame_rate_hz)
            yield Case(name, own, kind.frames, (), solver=True, nominal=nominal, parameter=own_case)


def parameter_row(outcome: Outcome, nominal: Outcome, more: dict[str, Any]) -> Row:
    """Compares the figure of each draw with that of the solver, or with the closed form if there is one."""
    case, solver, own = outcome.case, outcome.solver, outcome.case.parameter
    assert solver is not None and own is not None
    for name, part in (("network", outcome), ("solver", solver), ("nominal solver", nominal)):
        if not part.complete:
            causes = [trial.cause for trial in part.trials if trial.cause is not None]
            return Row(case.name, "simulated", "diverged", False, f"{name}: {', '.join(causes)}", more)
    network, solved, ignored = (_figures(part) for part in (outcome, solver, nominal))
    expected = solved if own.known is None else np.full(DRAWS, own.known)
    scale = np.abs(expected) if own.scale is None else np.full(DRAWS, own.scale)
    room = WITHIN * float(scale.mean())
    low, high = float(expected.mean()) - room, float(expected.mean()) + room
    errors, ignoring = ((figure - expected) / scale for figure in (network, ignored))
    figures = {"network": network, "solver": solved, "nominal": ignored}
    details: dict[str, Any] = {name: figure.tolist() for name, figure in figures.items()}
    details |= {"parameter": own.name, "value": own.value, "range": own.range, "closed_form": own.known}
    details |= {"low": low, "high": high, "error": float((network - expected).mean() / scale.mean())}
    details |= {"errors": errors.tolist(), "deviation": float(errors.std(ddof=1))}
    details |= {"nominal_passes": _passes(ignoring)}
    details |= {"particles": [scene.particle_count for scene in case.scenes], "frames": case.frames} | more
    beyond = f"{details['error']:+.1%} ({errors.min():+.1%} to {errors.max():+.1%}); solver {solved.mean():.3g}"
    beyond += f", with the default of {own.name} {ignored.mean():.3g}"
    return Row(case.name, interval_text(low, high), float(network.mean()), _passes(errors), beyond, details)


def _passes(errors: np.ndarray) -> bool:
    """Returns whether the mean size of the errors is small enough. Errors of different signs do not cancel."""
    return bool(np.abs(errors).mean() <= WITHIN)


def _figures(outcome: Outcome) -> np.ndarray:
    own, scenes = outcome.case.parameter, outcome.case.scenes
    assert own is not None
    pairs = zip(outcome.trials, scenes, strict=True)
    return np.array([own.figure(trial.position_TN3, scene) for trial, scene in pairs])


def _of_slide(own: Parameter, seconds: float) -> Parameter:
    """Adds the closed form of a slide without friction.

    The displacement of a block that stops is small and depends on how it lands, so its error is a fraction of the
    frictionless displacement.
    """
    slope = math.radians(SLOPE_DEG)
    free = 0.5 * 9.8 * math.sin(slope) * seconds**2
    if own.value == 0:
        return replace(own, known=free)
    return replace(own, scale=free) if own.value >= math.tan(slope) else own


def _with(scene: Scene, parameter: str, value: float) -> Scene:
    if parameter == "friction":
        return with_friction(scene, value)
    return replace(scene, material_parameters={parameter: np.full(scene.particle_count, value, np.float32)})


def _drawn(rng: np.random.Generator, size: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns edges, places about the origin, and a shift along x and z."""
    size_3 = np.array(size) * rng.uniform(1 - VARIED, 1 + VARIED, 3)
    count = round(PARTICLES_PER_CELL * float(np.prod(size_3)) / CELL**3)
    place_N3 = size_3 * (rng.random((count, 3)) - 0.5)
    return size_3, place_N3, rng.uniform(-SHIFTED, SHIFTED, 3) * [1.0, 0.0, 1.0]


def _body(material: str, place_N3: np.ndarray, **more: Any) -> Scene:
    filling = {"cell_size": CELL, "particles_per_cell": float(PARTICLES_PER_CELL)}
    return filled(MATERIALS.index(material), place_N3, (0.0, 0.0, 0.0), **filling, **more)


def _column(material: str, size: Vector, friction: float) -> Callable[[np.random.Generator], Scene]:
    """Returns a column on the domain's floor."""

    def scene(rng: np.random.Generator) -> Scene:
        size_3, place_N3, shift_3 = _drawn(rng, size)
        middle_3 = shift_3 + np.array([0.5, FLOOR + 0.5 * size_3[1], 0.5])
        rough = {"domain_size": (1.0, 0.5, 1.0), "wall_friction": (0.0, friction, 0.0)}
        return _body(material, middle_3 + place_N3, **rough)

    return scene


def _beam(rng: np.random.Generator) -> Scene:
    """Returns an elastic beam whose ends lie on two supports."""
    size_3, place_N3, shift_3 = _drawn(rng, (0.42, 0.078, 0.07))
    middle_3, side = shift_3 + np.array([0.5, SUPPORT_HEIGHT, 0.5]), 0.2
    away_3 = np.array([SPAN * size_3[0] + 0.5 * side, 0.0, 0.0])
    centres = (middle_3 - away_3, middle_3 + away_3)
    supports = tuple(shape_obstacle("square", side, tuple(centre_3.tolist())) for centre_3 in centres)
    above_3 = np.array([0.0, GAP + 0.5 * size_3[1], 0.0])
    return _body("elastic", middle_3 + above_3 + place_N3, domain_size=(1.0, 0.5, 1.0), obstacles=supports)


def _slope_axes() -> tuple[np.ndarray, np.ndarray]:
    """Returns the rotation of the slope, and the unit vector down it."""
    turn = euler_rotation((0.0, 0.0, -SLOPE_DEG))
    return turn, turn @ np.array([1.0, 0.0, 0.0])


def _block(height: float, domain_height: float) -> Callable[[np.random.Generator], Scene]:
    """Returns a flat block of snow at the upper end of a slope. Higher blocks would roll on rough slopes."""

    def scene(rng: np.random.Generator) -> Scene:
        size_3, place_N3, shift_3 = _drawn(rng, (0.15, 0.07, 0.15))
        (turn_33, down_3), middle_3 = _slope_axes(), shift_3 + np.array([0.5, height, 0.5])
        start_3 = SLOPE_START * down_3 + turn_33 @ np.array([0.0, GAP + 0.5 * size_3[1], 0.0])
        slope = shape_obstacle("square", SLOPE_SIDE, tuple(middle_3.tolist()), turn_33, "slope")
        rough = {"domain_size": (1.0, domain_height, 1.0), "obstacles": (slope,)}
        return _body("snow", middle_3 + start_3 + place_N3 @ turn_33.T, **rough)

    return scene


NOMINAL = dict(zip(INPUT_PARAMETERS, NOMINAL_P, strict=True))
ANGLE, VISCOSITY, YOUNG = "sand_friction_angle_deg", "water_viscosity_pa_s", "youngs_modulus_pa"
KINDS = (
    Kind(
        "slide on 20 degrees", "friction", (0.0, 0.1, 0.2, 0.3, 0.5, 1.0), "friction {:g}", (0.0, 1.0), 0.0, 31, slid,
        _block(0.5, 1.0),
    ),
    # the floor lies within a coarsest cell of the network below the block
    Kind("slide near the floor", "friction", (0.0, 0.2), "friction {:g}", (0.0, 1.0), 0.0, 31, slid, _block(0.25, 0.5)),
    Kind(
        "run-out of sand", ANGLE, (18.0, 24.0, 38.0, 45.0, 48.0), "{:g} degrees", INPUT_PARAMETERS[ANGLE],
        NOMINAL[ANGLE], 41, run_out, _column("sand", (0.11, 0.19, 0.11), 0.6),
    ),
    Kind(
        "spread of water", VISCOSITY, (8.0, 16.0, 32.0, 64.0, 80.0), "{:g} Pa s", INPUT_PARAMETERS[VISCOSITY],
        NOMINAL[VISCOSITY], 31, spread, _column("water", (0.12, 0.14, 0.12), 0.0),
    ),
    Kind(
        "sag of an elastic block", YOUNG, (6e5, 3.5e5, 2e5, 1.25e5, 1e5), "{:g} Pa", INPUT_PARAMETERS[YOUNG],
        NOMINAL[YOUNG], 61, sag, _beam,
    ),
)  # fmt: skip
