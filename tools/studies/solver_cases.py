"""python -m tools.studies.solver_cases [--json FILE]: what a scene saves by paying only for what it contains.

Each scene is simulated alone, by kernels compiled for its materials and obstacles, and beside three resting particles,
one of each material, above a sheet, so that the kernels hold every branch. The scene's own steps are the same in both.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS, SAND, SNOW, WATER
from hgn.scene.scene import Scene
from hgn.scene.shapes import shape_obstacle
from hgn.schema import from_mapping, require, require_one_of, require_positive, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders

FRAME_RATE_HZ = 60.0
CASES: tuple[tuple[str, tuple[int, ...], bool], ...] = (
    ("water", (WATER,), False),
    ("sand", (SAND,), False),
    ("snow", (SNOW,), False),
    ("water, sand", (WATER, SAND), False),
    ("all materials", (WATER, SAND, SNOW), False),
    ("water, obstacle", (WATER,), True),
    ("all materials, obstacle", (WATER, SAND, SNOW), True),
)


@dataclass(frozen=True)
class SolverCasesConfig:
    """`python -m tools.studies.solver_cases`: what is timed."""

    frames: int = 13
    size: float = 0.08  # of the cubes of particles, in domain units
    rounds: int = 3
    device: str = "auto"  # or cpu, gpu
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_positive(self, "rounds", "size")
        require(self.frames >= 2, "frames", "at least 2", self.frames)
        require(self.size <= 0.2, "size", "at most 0.2", self.size)
        require_one_of(self, "device", ("auto", "cpu", "gpu"))


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to."""
    from datagen.mpm.device import initialise

    config = from_mapping(SolverCasesConfig, mapping)
    device = initialise(config.device)
    rows = []
    with bar("cases", total=len(CASES), unit="case") as progress:
        for name, kinds, obstacle in CASES:
            rows.append({"case": name, **_times(kinds, obstacle, config)})
            progress.update()
    print(f"{'case':<24} {'particles':>9} {'steps a frame':>13} {'ms':>8} {'ms, every branch':>17} {'gain':>6}")
    for row in rows:
        print(
            f"{row['case']:<24} {row['particles']:>9} {row['substeps']:>13.0f} {row['ms']:>8.1f} "
            f"{row['ms_every_branch']:>17.1f} {row['gain']:>6.2f}"
        )
    if config.json is not None:
        meta = provenance("cuda" if device.kind == "gpu" else "cpu") | {"config": without_folders(to_mapping(config))}
        write_json(config.json, {"meta": meta, "rows": rows})
    return 0


def _times(kinds: tuple[int, ...], obstacle: bool, config: SolverCasesConfig) -> dict[str, float]:
    """Milliseconds a frame, the median of rounds in turns, each after a first that compiles."""
    from datagen.mpm.solver import Simulated, simulate

    scene = _scene(kinds, obstacle, config.size)
    contenders = {"ms": [scene], "ms_every_branch": [scene, _everything()]}
    mpm = MpmConfig(device=config.device)
    times: dict[str, list[float]] = {name: [] for name in contenders}
    substeps = 0
    for scenes in contenders.values():
        simulate(scenes, mpm, 2, FRAME_RATE_HZ)
    for _ in range(config.rounds):
        for name, scenes in contenders.items():
            ends: list[float] = []
            outcome = simulate(
                scenes,
                mpm,
                config.frames,
                FRAME_RATE_HZ,
                lambda _, ends=ends: ends.append(time.perf_counter()),  # type: ignore[misc]
            )[0]
            assert isinstance(outcome, Simulated), outcome
            substeps = outcome.counters["substeps"]
            times[name].append(1e3 * (ends[-1] - ends[0]) / (config.frames - 1))
    found = {name: statistics.median(values) for name, values in times.items()}
    gain = found["ms_every_branch"] / found["ms"]
    return {"particles": scene.particle_count, "substeps": substeps / (config.frames - 1), **found, "gain": gain}


def _scene(kinds: tuple[int, ...], obstacle: bool, size: float) -> Scene:
    count = int(8 * (64 * size) ** 3 + 1)
    generator = np.random.default_rng(0)
    place = [
        generator.uniform(-size / 2, size / 2, (count, 3)) + np.array([0.35 + 0.15 * index, 0.15, 0.5])
        for index in range(len(kinds))
    ]
    position = np.concatenate(place).astype(np.float32)
    cone = (shape_obstacle("cone", 0.2, (0.5, 0.4, 0.5)),) if obstacle else ()
    return Scene(position, np.zeros_like(position), np.repeat(np.array(kinds, np.uint8), count), cone)


def _everything() -> Scene:
    """Three particles at rest, one of each material, weightless above a sheet."""
    position = np.array([[0.3, 0.6, 0.5], [0.5, 0.6, 0.5], [0.7, 0.6, 0.5]], np.float32)
    sheet = shape_obstacle("square", 0.3, (0.5, 0.5, 0.5))
    kinds = np.arange(len(MATERIALS)).astype(np.uint8)
    return Scene(position, np.zeros_like(position), kinds, (sheet,), gravity=(0.0, 0.0, 0.0))


if __name__ == "__main__":
    run_command(main, "solver_cases")
