"""Warnings about a scene's file: groups in one place, sheets, and obstacles out of reach."""

import math
from collections.abc import Iterator

import numpy as np

from hgn.scene.barrier import barrier_pieces
from hgn.scene.distance import contains, extent
from hgn.scene.group import Region, region_of
from hgn.scene.material import MATERIAL_PARAMETERS, MATERIALS
from hgn.scene.motion import AT_REST
from hgn.scene.scene import Scene
from hgn.scene.scene_file import MILLIMETRES
from hgn.schema import printable

OVERLAP = 0.01  # smallest overlap that is noted, as a fraction of the smaller group's particles
OVERLAP_SAMPLES = 1000  # number of particles of a group that are searched for overlaps


def notes_on_files(scene: Scene, duration_s: float = math.inf) -> list[str]:
    """Returns warnings about entries without effect in a simulation of `duration_s`, groups in one place, sheets,
    obstacles tiny or without a surface in the domain, and particles inside one."""
    if scene.specification.get("kind") != "file":
        return []
    notes = [*_overlaps(scene), *_without_effect(scene, duration_s)]
    entries = scene.specification["obstacles"]
    for sheet in scene.obstacles[len(entries) :]:
        notes.append(f"{len(sheet.triangle_F3)} triangles are a sheet, because they enclose no volume: {sheet.name}")
    first = 0
    for group, count in zip(scene.specification["groups"], scene.specification["particle_counts"], strict=False):
        position_N3, first = scene.position_N3[first : first + count], first + count
        if group.get("particles") is not None:
            for obstacle in scene.obstacles:
                if inside := int(contains(position_N3, obstacle.at(0.0)).sum()):
                    notes.append(f"{inside} of {count} particles of {group['particles']} lie inside {obstacle.name}")
    for entry, obstacle in zip(entries, scene.obstacles, strict=False):
        name, key, unit = entry.get("mesh"), "scale", f" ({MILLIMETRES})"
        if name is None:
            name, key, unit = obstacle.name, "size", ""
        elif not obstacle.closed:
            remedy = "close its holes, or write bodies that touch as two obstacles"
            notes.append(f"a sheet, not a solid, because it is not watertight: {name}; {remedy}")
        begin = obstacle.at(0.0)
        low_B3, high_B3 = (obstacle.motion or AT_REST).boxes(obstacle.vertex_V3)
        around = ((low_B3 <= 0) & (high_B3 >= scene.domain_size)).all()
        name = f"{name} ({extent(begin.vertex_V3)})"
        if ((low_B3 > scene.domain_size) | (high_B3 < 0)).any(axis=1).all():
            notes.append(f"outside the domain, out of reach of particles: {name}; see {key} and position")
        elif (obstacle.motion is None or around) and not len(
            barrier_pieces(begin.corners, scene.cell_size, scene.domain_size)
        ):
            notes.append(f"no surface in the domain: {name}; see {key} and position{unit}")
        elif np.ptp(begin.vertex_V3, axis=0).max() < scene.cell_size:
            notes.append(f"smaller than a cell of {scene.cell_size:.3g}: {name}; see {key}")
    return [printable(note) for note in notes]


def _without_effect(scene: Scene, duration_s: float) -> Iterator[str]:
    for name in ("groups", "emitters"):
        for index, entry in enumerate(scene.specification.get(name, ())):
            material = entry["material"]
            for key in MATERIAL_PARAMETERS:
                other = key.partition("_")[0]
                if entry.get(key) is not None and other in MATERIALS and other != material:
                    yield f"no effect: {key} of {name}[{index}], which is {material}"
            if entry.get("start", 0) > duration_s:
                yield f"no effect: {name}[{index}], because it starts after the last frame"


def _overlaps(scene: Scene) -> Iterator[str]:
    """Yields a warning for each group with a shape that overlaps an earlier one, where the density is higher."""
    groups, counts = scene.specification["groups"], scene.specification["particle_counts"]
    regions: list[tuple[str, Region, np.ndarray]] = []
    ends = np.cumsum(counts)
    for index, group in enumerate(groups):
        if group.get("particles") is not None:
            continue
        name = f"groups[{index}] ({group['shape']} of {group['material']})"
        region = region_of(group["shape"], np.broadcast_to(group["size"], 3).tolist(), group["position"])
        position_N3 = scene.position_N3[ends[index] - counts[index] : ends[index]]
        for other_name, other, other_N3 in regions:
            if region.distance(other) > 0:
                continue
            within, some_N3 = (region, other_N3) if len(other_N3) < len(position_N3) else (other, position_N3)
            overlap = (within.distances(some_N3[:: 1 + len(some_N3) // OVERLAP_SAMPLES]) <= 0).mean()
            if overlap > OVERLAP:
                yield f"{name} overlaps {other_name}: {overlap:.0%} of the smaller one; the density is higher there"
                break
        regions.append((name, region, position_N3))
