"""python -m tools.studies.taichi_elements folder=COPY [--json FILE]: our faithful mode beside Taichi Elements.

Cubes of each material alone and of all three, dropped on the floor from the same places, at the same step. Both sum in
no common order and the motion is chaotic, so the first frame is compared particle by particle and the run by centre of
mass, height and spread. Taichi Elements, whose atomics sum in another order each time, runs twice: what its two runs
differ by is the floor. Of several random fillings the worst counts. Times are of whole frames, compilation left out,
one solver after the other.
Shape legend: T frames, N particles.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hgn.command import run_command
from hgn.config import MpmConfig
from hgn.scene.material import MATERIALS
from hgn.scene.scene import Scene
from hgn.schema import ConfigError, from_mapping, require, require_positive, to_mapping
from hgn.system.files import write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders

FRAME_S = 1 / 60
STEP_S = 0.02 / 64  # Taichi Elements' longest at 64 cells a side
CELL = 1 / 64
FLOOR = 3 * CELL
FIRST_FRAME, CENTRE, SHAPE = 1e-4, 0.01, 0.05  # bounds: domain units, domain units, relative
WARM_FRAMES = 3


@dataclass(frozen=True)
class TaichiElementsConfig:
    """`python -m tools.studies.taichi_elements`: what is compared."""

    folder: str  # a checkout of github.com/taichi-dev/taichi_elements
    frames: int = 100
    threads: int = 2  # of the CPU, for both
    size: float = 0.08  # of the cubes of particles, in domain units
    seeds: int = 3  # random fillings of each case
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_positive(self, "threads", "size", "seeds")
        require(self.frames > WARM_FRAMES + 1, "frames", f"more than {WARM_FRAMES + 1}", self.frames)
        require(self.size <= 0.2, "size", "at most 0.2", self.size)
        if not (Path(self.folder) / "engine" / "mpm_solver.py").is_file():
            raise ConfigError(f"folder must hold a copy of Taichi Elements (engine/mpm_solver.py), got {self.folder}")


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; what does not hold is a finding, and the exit code is 0."""
    config = from_mapping(TaichiElementsConfig, mapping)
    rows = []
    with bar("cases", total=len(cases(config.size)) * config.seeds, unit="run") as progress:
        for name in dict(cases(config.size)):
            runs = []
            for seed in range(config.seeds):
                runs.append(compare(name, dict(cases(config.size, seed))[name], config))
                progress.update()
            rows.append(worst(runs))
    heads = ("first frame", "centre", "height", "spread", "ms", "TE ms")
    print(f"{'case':<8} {'particles':>9} {heads[0]:>12} " + " ".join(f"{head:>8}" for head in heads[1:]) + "  held")
    for row in rows:
        print(
            f"{row['case']:<8} {row['particles']:>9} {row['first_frame']:>12.2g} {row['centre']:>8.2g} "
            f"{row['height']:>8.2g} {row['spread']:>8.2g} {row['ms']:>8.1f} {row['taichi_elements_ms']:>8.1f}  "
            f"{'yes' if row['held'] else 'NO'}"
        )
        floor = row["floor"]
        print(
            f"{'  floor':<18} {floor['first_frame']:>12.2g} {floor['centre']:>8.2g} {floor['height']:>8.2g} "
            f"{floor['spread']:>8.2g}"
        )
    if config.json is not None:
        meta = provenance("cpu") | {"config": without_folders(to_mapping(config))}
        write_json(config.json, {"meta": meta, "rows": rows})
    return 0


def cases(size: float, seed: int = 0) -> list[tuple[str, Scene]]:
    """A cube of each material, and three beside each other."""
    single = [cubes([kind], [(0.5, 0.2, 0.5)], size, seed) for kind in range(3)]
    mixed = cubes([0, 1, 2], [(0.45, 0.15, 0.5), (0.5, 0.3, 0.5), (0.55, 0.45, 0.5)], size, seed)
    return [*zip(MATERIALS, single, strict=True), ("mixed", mixed)]


def faithful_mode(device: str) -> tuple[MpmConfig, float]:
    """Our solver as Taichi Elements, at its step, and the frame rate at which it takes as many of them a frame."""
    step = FRAME_S / (int(FRAME_S / STEP_S) + 1)
    mpm = MpmConfig(
        device=device, time_step="fixed", fixed_time_step_s=step, sand_volume_correction="taichi_elements",
        sand_friction_law="compression", sand_friction_angle_deg=45.0, time_integration="symplectic_euler",
        water_volume_update="taichi_elements", water_density_relaxation_s=None, snow_maximum_hardening=100.0,
    )  # fmt: skip
    return mpm, 1 / (taichi_elements_substeps() * step)


def taichi_elements_substeps() -> int:
    """How often it steps in a frame: the time left is counted down in floats, and its rest may ask for one more."""
    whole = int(FRAME_S / STEP_S) + 1
    left, taken = FRAME_S, 0
    while left > 0:
        left -= FRAME_S / whole
        taken += 1
    return taken


def compare(name: str, scene: Scene, config: TaichiElementsConfig) -> dict[str, Any]:
    """A row: differences of the two trajectories, of two runs of Taichi Elements (floor), and times of a frame."""
    theirs, their_s = run_theirs(scene, config.folder, config.frames, config.threads)
    again, _ = run_theirs(scene, config.folder, config.frames, config.threads)
    ours, our_s = _run_ours(scene, config)
    row: dict[str, Any] = {
        "case": name,
        "particles": scene.particle_count,
        **differences(ours, theirs),
        "floor": differences(again, theirs),
        "ms": 1e3 * our_s,
        "taichi_elements_ms": 1e3 * their_s,
        "time_ratio": our_s / their_s,
        "substeps": taichi_elements_substeps(),
    }
    row["held"] = bool(
        row["first_frame"] <= FIRST_FRAME
        and row["centre"] <= CENTRE
        and row["height"] <= SHAPE
        and row["spread"] <= SHAPE
    )
    return row


def differences(path_TN3: np.ndarray, reference_TN3: np.ndarray) -> dict[str, float]:
    """The largest of all frames: of particles in the first, centre of mass, height and spread."""
    one, other = path_TN3.astype(np.float64), reference_TN3.astype(np.float64)
    height = [np.quantile(path[:, :, 1], 0.95, axis=1) - FLOOR for path in (one, other)]
    spread = [path[:, :, ::2].std(axis=1).mean(axis=1) for path in (one, other)]
    return {
        "first_frame": float(np.abs(one[1] - other[1]).max()),
        "centre": float(np.linalg.norm(one.mean(axis=1) - other.mean(axis=1), axis=1).max()),
        # of a film thinner than a cell, in cells
        "height": float((np.abs(height[0] - height[1]) / np.maximum(height[1], CELL)).max()),
        "spread": float(np.abs(spread[0] / spread[1] - 1).max()),
    }


def worst(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The largest differences of several fillings, the median times."""
    row = dict(runs[0])
    for name in ("first_frame", "centre", "height", "spread"):
        row[name] = max(run[name] for run in runs)
    row["floor"] = {name: max(run["floor"][name] for run in runs) for name in runs[0]["floor"]}
    for name in ("ms", "taichi_elements_ms"):
        row[name] = float(np.median([run[name] for run in runs]))
    row["time_ratio"] = row["ms"] / row["taichi_elements_ms"]
    row["seeds"] = len(runs)
    row["held"] = all(run["held"] for run in runs)
    return row


def cubes(kinds: list[int], centres: list[tuple[float, float, float]], size: float, seed: int = 0) -> Scene:
    count = int(8 * (64 * size) ** 3 + 1)
    generator = np.random.default_rng(seed)
    position = np.concatenate([generator.uniform(-size / 2, size / 2, (count, 3)) + centre for centre in centres])
    return Scene(
        position.astype(np.float32), np.zeros((len(position), 3), np.float32),
        np.repeat(np.array(kinds, np.uint8), count),
    )  # fmt: skip


def run_theirs(scene: Scene, folder: str, frames: int, threads: int) -> tuple[np.ndarray, float]:
    """Its trajectory, float32 [T, N, 3], and the median seconds of a frame; `threads` are a CPU's, 0 asks for a GPU."""
    with tempfile.TemporaryDirectory() as exchange:
        source, target = Path(exchange) / "in.npz", Path(exchange) / "out.npz"
        np.savez(
            source, position_N3=scene.position_N3, velocity_N3=scene.velocity_N3, material_N=scene.material_N,
            frames=frames, frame_s=FRAME_S,
        )  # fmt: skip
        command = [sys.executable, "-m", "datagen.mpm.taichi_elements", folder, source, target, threads]
        subprocess.run(list(map(str, command)), check=True)
        found = np.load(target)
        return found["position_TN3"], float(np.median(found["seconds_T"][WARM_FRAMES:]))


def _run_ours(scene: Scene, config: TaichiElementsConfig) -> tuple[np.ndarray, float]:
    from datagen.mpm.solver import SceneFailure, simulate

    mpm, rate = faithful_mode("cpu")
    ends: list[float] = []
    (outcome,) = simulate(
        [scene], mpm, config.frames, rate, lambda _: ends.append(time.perf_counter()), cpu_threads=config.threads
    )
    if isinstance(outcome, SceneFailure):
        raise ConfigError(f"our solver stopped where Taichi Elements did not: {outcome.cause}")
    return outcome.position_TN3, float(np.median(np.diff(ends)[WARM_FRAMES:]))


if __name__ == "__main__":
    run_command(main, "taichi_elements")
