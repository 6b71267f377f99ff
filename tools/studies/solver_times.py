"""python -m tools.studies.solver_times [--json FILE]: the solver: many scenes, many particles, Taichi Elements.

Many scenes: random scenes with obstacles, simulated from their start; timed is the second half of the frames, when most
particles have landed. Many particles: one scene of clumps and spray. With `taichi_elements=COPY` Taichi Elements runs
the paper's four cubes on the same device, and ours runs them at its step, alone and 256 times side by side. A contender
whose scenes fail, or end with a position that is not finite, gets no time.
"""

from __future__ import annotations

import multiprocessing
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from datagen.mpm.collider import Collider, build_collider
from hgn.command import run_command
from hgn.config import MpmConfig, SceneConfig
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.scene import Scene
from hgn.schema import ConfigError, from_mapping, require, require_one_of, to_mapping
from hgn.system.files import write_json
from hgn.system.machine import available_cpus
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from tools.bench.states import Workload, scene_of
from tools.studies.taichi_elements import WARM_FRAMES, cubes, faithful_mode, run_theirs, taichi_elements_substeps

FRAME_RATE_HZ = 60.0
CUBES = [(0.3, 0.3, 0.3), (0.3, 0.3, 0.7), (0.7, 0.3, 0.3), (0.7, 0.3, 0.7)]
CUBE_KINDS = [0, 1, 2, 0]
SIDE_BY_SIDE = 256
EXIT_RED = 1


@dataclass(frozen=True)
class SolverTimesConfig:
    """`python -m tools.studies.solver_times`: what is timed."""

    scenes: tuple[int, ...] = (1, 64, 256)  # random scenes with obstacles, side by side
    particles: tuple[int, ...] = (4_296, 40_000, 400_000, 1_000_000)  # of one scene
    scene_frames: int = 60  # of the random scenes; the second half is timed
    particle_frames: int = 6
    # a folder with a copy of github.com/taichi-dev/taichi_elements, to time beside ours
    taichi_elements: str | None = None
    device: str = "auto"  # or cpu, gpu
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        for name in ("scenes", "particles"):
            require(all(value >= 1 for value in getattr(self, name)), name, "at least 1 each", getattr(self, name))
        for name in ("scene_frames", "particle_frames"):
            require(getattr(self, name) >= 3, name, "at least 3", getattr(self, name))
        require_one_of(self, "device", ("auto", "cpu", "gpu"))
        if self.taichi_elements is not None:
            least = WARM_FRAMES + 3
            require(
                self.scene_frames >= least,
                "scene_frames",
                f"at least {least} beside Taichi Elements",
                self.scene_frames,
            )
        if self.taichi_elements is not None and not (Path(self.taichi_elements) / "engine/mpm_solver.py").is_file():
            raise ConfigError(
                f"taichi_elements must be a folder with a copy of it (engine/mpm_solver.py), got {self.taichi_elements}"
            )


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; the exit code is 1 where a contender failed."""
    from datagen.mpm.device import initialise

    config = from_mapping(SolverTimesConfig, mapping)
    made = _random_scenes(max(config.scenes, default=0), MpmConfig().collider_band_cells)
    device = initialise(config.device)
    meta = provenance("cuda" if device.kind == "gpu" else "cpu") | {"config": without_folders(to_mapping(config))}
    rows: list[dict[str, Any]] = []
    cases = _cases(made, config, device.kind)
    with bar("cases", len(cases), unit="case") as progress:
        for case in cases:
            rows += case()
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


def _cases(
    made: list[tuple[Scene, Collider]], config: SolverTimesConfig, kind: str
) -> list[Callable[[], list[dict[str, Any]]]]:
    """Each times its contenders when it is called, and gives their rows."""
    mpm = MpmConfig(device=kind)

    def scenes(count: int) -> list[dict[str, Any]]:
        own = [scene for scene, _ in made[:count]]
        colliders = [collider for _, collider in made[:count]]
        row = _timed(own, mpm, config.scene_frames, colliders=colliders)
        return [{"case": "random scenes with obstacles"} | row]

    def particles(count: int) -> list[dict[str, Any]]:
        return [{"case": "one scene"} | _timed([scene_of(Workload(count, 1), 0, 0.035)], mpm, config.particle_frames)]

    cases = [partial(scenes, count) for count in config.scenes]
    cases += [partial(particles, count) for count in config.particles]
    return [*cases, partial(_beside_taichi_elements, config, kind)] if config.taichi_elements else list(cases)


def _beside_taichi_elements(config: SolverTimesConfig, kind: str) -> list[dict[str, Any]]:
    assert config.taichi_elements is not None
    scene = cubes(CUBE_KINDS, CUBES, 0.08)
    faithful, rate = faithful_mode(kind)
    theirs: dict[str, Any] = {"case": "Taichi Elements, four cubes", "scenes": 1, "particles": scene.particle_count}
    try:
        _, seconds = run_theirs(
            scene, config.taichi_elements, config.scene_frames, 0 if kind == "gpu" else available_cpus()
        )
        theirs |= {"substeps": taichi_elements_substeps(), "ms": 1e3 * seconds}
    except subprocess.CalledProcessError as error:  # it has said why
        theirs |= {"substeps": None, "ms": None, "cause": f"ended with {error.returncode}"}
    return [
        theirs,
        *(
            {"case": "the same, ours at its step"} | _timed([scene] * count, faithful, config.scene_frames, rate)
            for count in ((1, SIDE_BY_SIDE) if kind == "gpu" else (1,))
        ),
    ]


def _timed(
    scenes: list[Scene],
    mpm: MpmConfig,
    frames: int,
    rate: float = FRAME_RATE_HZ,
    colliders: list[Collider] | None = None,
) -> dict[str, Any]:
    """Milliseconds a frame of the second half, after a first simulation that compiles."""
    from datagen.mpm.solver import SceneFailure, Simulated, simulate

    simulate(scenes, mpm, 2, rate, colliders=colliders)
    ends: list[float] = []
    outcomes = simulate(
        scenes, mpm, frames, rate, lambda _: ends.append(time.perf_counter()), colliders=colliders
    )  # fmt: skip
    row: dict[str, Any] = {"scenes": len(scenes), "particles": sum(scene.particle_count for scene in scenes)}
    failures = [outcome.cause for outcome in outcomes if isinstance(outcome, SceneFailure)]
    found = [outcome for outcome in outcomes if isinstance(outcome, Simulated)]
    if not all(np.isfinite(outcome.position_TN3[-1]).all() for outcome in found):
        failures.append("positions are not finite")
    if failures:
        return row | {"substeps": None, "ms": None, "cause": failures[0]}
    steps = sum(
        outcome.counters["substeps"] * scene.particle_count for outcome, scene in zip(found, scenes, strict=True)
    )
    # frames of one launch end together: from the end of the launch that the middle frame is in
    begin = max(t for t in range(frames - 1) if ends[t] <= ends[(frames - 1) // 2] + 1e-3)
    return row | {
        "substeps": steps / row["particles"] / (frames - 1),
        "ms": 1e3 * (ends[-1] - ends[begin]) / (frames - 1 - begin),
        "projections": sum(outcome.counters["surface_projections"] for outcome in found),
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
