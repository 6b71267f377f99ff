"""Notes on scenes that weights cannot simulate as their solver would: ignored settings, and values outside the data."""

import math
from collections.abc import Iterator

import numpy as np

from hgn.config import SceneConfig
from hgn.runtime.weights import WeightsInfo
from hgn.scene.material import INPUT_PARAMETERS
from hgn.scene.scene import Scene
from hgn.scene.scene_notes import notes_on_files

SAME_SPEED = 1e-5  # largest relative difference of speeds that count as equal; velocities are stored in float32


def notes_on_scene(scene: Scene, info: WeightsInfo, weights: str, duration_s: float = math.inf) -> Iterator[str]:
    """Yields a line for each note on the files of a scene and on physics that the weights do not support."""
    yield from notes_on_files(scene, duration_s)
    inputs = info.network.own_physics
    used = INPUT_PARAMETERS if "parameters" in inputs else ()
    if unused := ", ".join(name for name in scene.material_parameters if name not in used):
        yield f"no effect: {unused} of groups; {weights} simulates each material with the solver's constants"
    frictions = np.array([*scene.wall_friction, *(obstacle.friction for obstacle in scene.obstacles)])
    if frictions.any() and "friction" not in inputs:
        yield f"no effect: friction of surfaces; {weights} simulates that of its data, own_physics the scene's"
    density, common = scene.particles_per_cell, SceneConfig.particles_per_cell
    if density not in (None, common):
        yield f"particles_per_cell: {density:g}, shipped weights were trained with {common:g}; motion is unreliable"
    speeds = np.array([obstacle.motion.fastest(obstacle.vertex_V3) for obstacle in scene.obstacles if obstacle.motion])
    for name, (low, high) in info.own_ranges.items():
        own = {"friction": frictions, "moving": speeds}
        values = own.get(name, scene.material_parameters.get(name, np.zeros(0)))
        far = values[(values < low * (1 - SAME_SPEED)) | (values > high * (1 + SAME_SPEED))]
        if len(far) and name in (*used, *inputs):
            field = "keyframes, domain units per second" if name == "moving" else name
            yield f"{field}: {far[0]:.4g}, the data of {weights} have {low:g} to {high:g}; motion is unreliable"


def note_on_speed(velocity_N3: np.ndarray, info: WeightsInfo, weights: str) -> Iterator[str]:
    """Yields a line if initial velocities, domain units per second, are larger than those of the data."""
    limit, relative = info.maximum_initial_speed, info.network.relative
    fastest = float(np.linalg.norm(velocity_N3.astype(np.float64), axis=-1).max(initial=0.0))
    if not (relative and limit is None) and fastest > (limit or 0.0) * (1 + SAME_SPEED):
        known = "an unknown speed; " if limit is None else f"up to {limit:g}; beyond that "
        flight = "motion is unreliable, but free flight is exact with weights=own_physics"
        yield (
            f"velocity: groups start with up to {fastest:.3g} domain units per second, in the data of {weights} "
            f"with {known}{'collisions and contacts are unreliable' if relative else flight}"
        )
