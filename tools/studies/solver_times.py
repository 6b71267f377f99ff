"""python -m tools.studies.solver_times [--json FILE]: frames of the solver, for many scenes and for many particles.

Many scenes: random scenes with obstacles, simulated from their start; timed is the second half of the frames, when most
particles have landed. Many particles: one scene of clumps and spray. A contender whose scenes fail, or end with a
position that is not finite, gets no time.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from datagen.mpm.collider import Collider, build_collider
from hgn.command import run_command
from hgn.config import MpmConfig, SceneConfig
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.scene import Scene
from hgn.schema import OneOrMore, from_mapping, require, require_bounds, require_one_of, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from tools.bench.states import Workload, scene_of

FRAME_RATE_HZ = 60.0
EXIT_RED = 1


@dataclass(frozen=True)
class SolverTimesConfig:
    """`python -m tools.studies.solver_times`: what is timed."""

    scenes: tuple[OneOrMore, ...] = (1, 64, 256)  # random scenes with obstacles, side by side
    particles: tuple[OneOrMore, ...] = (4_296, 40_000, 400_000, 1_000_000)  # of one scene
    scene_frames: int = 60  # of the random scenes; the second half is timed
    particle_frames: int = 6
    device: str = "auto"  # or cpu, gpu
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        for name in ("scene_frames", "particle_frames"):
            require(getattr(self, name) >= 3, name, "at least 3", getattr(self, name))
        require_one_of(self, "device", ("auto", "cpu", "gpu"))


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; the exit code is 1 where a contender failed."""
    from datagen.mpm.device import initialise

    config = from_mapping(SolverTimesConfig, mapping)
    made = _random_scenes(max(config.scenes, default=0), MpmConfig().collider_band_cells)
    device = initialise(config.device)
    meta = provenance("cuda" if device.kind == "gpu" else "cpu") | {"config": without_folders(to_mapping(config))}
    mpm = MpmConfig(device=device.kind)
    rows: list[dict[str, Any]] = []
    cases: list[tuple[str, int]] = [("random scenes with obstacles", count) for count in config.scenes]
    cases += [("one scene", count) for count in config.particles]
    with bar("cases", len(cases), unit="case") as progress:
        for case, count in cases:
            if case == "one scene":
                row = _timed([scene_of(Workload(count, 1), 0, 0.035)], mpm, config.particle_frames)
            else:
                scenes, colliders = zip(*made[:count], strict=True)
                row = _timed(scenes, mpm, config.scene_frames, colliders)
            rows.append({"case": case} | row)
            progress.update()
            if config.json is not None:  # after each: what a later case does takes nothing away
                write_json(config.json, {"meta": meta, "rows": rows})
    print(table(rows))
    return 0 if all(row["ms"] is not None for row in rows) else EXIT_RED


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people, as Markdown."""
    lines = [
        "| case | scenes | particles | steps a frame | ms a frame | ms a scene and frame | million particle-steps/s |",
        "| :-- | --: | --: | --: | --: | --: | --: |",
    ]
    for row in rows:
        given = f"| {row['case']} | {row['scenes']} | {row['particles']:,} |"
        if row["ms"] is None:
            lines.append(f"{given} {row['cause']} | | | |")
        else:
            rate = row["particles"] * row["substeps"] / row["ms"] / 1e3
            each = row["ms"] / row["scenes"]
            lines.append(f"{given} {row['substeps']:.0f} | {row['ms']:.2f} | {each:.3f} | {rate:.0f} |")
    return "\n".join(lines)


def _timed(
    scenes: Sequence[Scene], mpm: MpmConfig, frames: int, colliders: Sequence[Collider] | None = None
) -> dict[str, Any]:
    """Milliseconds a frame of the second half, after a first simulation that compiles."""
    from datagen.mpm.solver import SceneFailure, Simulated, simulate

    simulate(scenes, mpm, 2, FRAME_RATE_HZ, colliders=colliders)
    ends: list[float] = []
    outcomes = simulate(
        scenes, mpm, frames, FRAME_RATE_HZ, lambda _: ends.append(time.perf_counter()), colliders=colliders
    )
    row: dict[str, Any] = {"scenes": len(scenes), "particles": sum(scene.particle_count for scene in scenes)}
    failures = [outcome.cause for outcome in outcomes if isinstance(outcome, SceneFailure)]
    simulated = [outcome for outcome in outcomes if isinstance(outcome, Simulated)]
    if not all(np.isfinite(outcome.position_TN3[-1]).all() for outcome in simulated):
        failures.append("positions are not finite")
    if failures:
        return row | {"substeps": None, "ms": None, "cause": failures[0]}
    steps = sum(
        outcome.counters["substeps"] * scene.particle_count for outcome, scene in zip(simulated, scenes, strict=True)
    )
    # frames of one launch end together: from the end of the launch that the middle frame is in
    begin = max(t for t in range(frames - 1) if ends[t] <= ends[(frames - 1) // 2] + 1e-3)
    return row | {
        "substeps": steps / row["particles"] / (frames - 1),
        "ms": 1e3 * (ends[-1] - ends[begin]) / (frames - 1 - begin),
        "projections": sum(outcome.counters["surface_projections"] for outcome in simulated),
    }


def _random_scenes(count: int, band_cells: float) -> list[tuple[Scene, Collider]]:
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        seeds = range(REPORT_SEED, REPORT_SEED + count)
        return list(pool.map(_scene, seeds, [band_cells] * count, chunksize=4))


def _scene(seed: int, band_cells: float) -> tuple[Scene, Collider]:
    scene = generate_scene(SceneConfig(), seed)
    return scene, build_collider(scene, band_cells)


if __name__ == "__main__":
    run_command(main, "solver_times")
