"""A scene's own physics: friction of surfaces, parameters of materials and elastic bodies of random scenes.

Shape legend: N particles, P parameters in the order of `INPUT_PARAMETERS`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from hgn.config import MpmConfig, SceneConfig
from hgn.scene.kinds import ELASTIC_KINDS, FASTEST
from hgn.scene.material import INPUT_PARAMETERS, LOGARITHMIC, acts_on
from hgn.scene.scene import Scene
from hgn.scene.streams import Stream, stream

ORDINARY = 1 / 2  # fraction of scenes without friction and with the defaults of all parameters
ALONE = 1 / 3  # of the others: fraction with friction only, and with parameters only
ELASTIC = 1 / 6  # fraction of scenes with elastic bodies, half of them without other materials
NOMINAL_P = tuple(float(getattr(MpmConfig(), name)) for name in INPUT_PARAMETERS)


def input_parameters(given: Mapping[str, np.ndarray], settings: Mapping[str, Any], particles: int) -> np.ndarray | None:
    """Returns parameters of particles, float32 [N, P], or None if all are the solver's defaults.

    A parameter that `given` does not name, or has as NaN, is that of the solver's `settings`.
    """
    defaults_P = np.array([settings.get(k, v) for k, v in zip(INPUT_PARAMETERS, NOMINAL_P, strict=True)], np.float32)
    value_NP = np.tile(defaults_P, (particles, 1))
    for i, name in enumerate(INPUT_PARAMETERS):
        if name in given:
            value_NP[:, i] = np.where(np.isnan(given[name]), value_NP[:, i], given[name])
    return None if (value_NP == np.array(NOMINAL_P, np.float32)).all() else value_NP


def own_ranges(drawn: Sequence[str]) -> dict[str, tuple[float, float]]:
    """Returns the ranges of the numbers that random scenes draw with `scene.own_physics`."""
    ranges = {"friction": (0.0, 1.0)} if "friction" in drawn else {}
    ranges |= {"moving": (0.0, FASTEST)} if "moving" in drawn else {}
    defaults = zip(INPUT_PARAMETERS.items(), NOMINAL_P, strict=True) if "parameters" in drawn else ()
    return ranges | {name: (min(low, nominal), high) for (name, (low, high)), nominal in defaults}


def with_elastic_bodies(config: SceneConfig, seed: int) -> SceneConfig:
    """Returns the settings of a random scene. A fraction ELASTIC of the scenes draws from elastic bodies too."""
    drawn, alone = stream(seed, Stream.ELASTIC).random(2).tolist()
    if "elastic" not in config.own_physics or drawn >= ELASTIC:
        return config
    materials = ("elastic",) if alone < 0.5 else (*dict.fromkeys(("elastic", *config.materials)),)
    kinds = {kind: share for kind, share in config.kinds.items() if kind in ELASTIC_KINDS and share > 0}
    return replace(config, materials=materials, kinds=kinds or config.kinds)


def with_drawn_physics(scene: Scene, drawn: Sequence[str], seed: int) -> Scene:
    """Returns a random scene with its own friction and parameters, which are also added to its specification.

    A fraction ORDINARY of the scenes has neither. With less, networks forget scenes without friction.
    """
    rng = stream(seed, Stream.PHYSICS)
    ordinary, which = rng.random(2).tolist()
    if ordinary < ORDINARY:
        return scene
    if "friction" in drawn and which < 1 - ALONE:
        scene = _rough(scene, rng)
    if "parameters" in drawn and which >= ALONE:
        scene = _varied(scene, rng)
    return scene


def _rough(scene: Scene, rng: np.random.Generator) -> Scene:
    floor, sides, *frictions = rng.random(2 + len(scene.obstacles)).tolist()
    pairs = zip(scene.specification["obstacles"], frictions, strict=True)
    own = {"wall_friction": [sides, floor, sides], "obstacles": [record | {"friction": mu} for record, mu in pairs]}
    obstacles = tuple(replace(o, friction=friction) for o, friction in zip(scene.obstacles, frictions, strict=True))
    specification, walls = scene.specification | own, (sides, floor, sides)
    return replace(scene, obstacles=obstacles, wall_friction=walls, specification=specification)


def _varied(scene: Scene, rng: np.random.Generator) -> Scene:
    groups = []
    for record in scene.specification["groups"]:
        values = {name: _draw(name, rng) for name in INPUT_PARAMETERS}
        groups.append(record | {name: value for name, value in values.items() if acts_on(name, record["material"])})
    counts = [group["particle_count"] for group in groups]
    parameters = {
        name: np.repeat(np.array([group.get(name, np.nan) for group in groups], np.float32), counts)
        for name in INPUT_PARAMETERS
        if any(name in group for group in groups)
    }
    return replace(scene, material_parameters=parameters, specification=scene.specification | {"groups": groups})


def _draw(name: str, rng: np.random.Generator) -> float:
    """Draws a parameter uniformly, LOGARITHMIC ones between powers of two, because logarithms differ by machines."""
    low, high = INPUT_PARAMETERS[name]
    part = float(rng.random())
    if name not in LOGARITHMIC:
        return low + (high - low) * part
    doublings = part * round(math.log2(high / low))
    return float(low * 2 ** int(doublings) * (1 + doublings - int(doublings)))
