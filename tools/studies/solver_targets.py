"""python -m tools.studies.solver_targets [--json FILE]: the solver's frames and data set beside what is asked of them.

First a path's result is compared: the first frames with one launch a substep, the plain prototype's fall with ours, a
data set's shards with their checksums. A path whose check is red gets no time. Timed is the second half of the frames,
when most particles have landed.
"""

from __future__ import annotations

import multiprocessing
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from datagen.mpm.collider import Collider, build_collider
from hgn.command import run_command
from hgn.config import MpmConfig, Processor, SceneConfig, config_directory
from hgn.data.manifest import MANIFEST_NAME, Manifest
from hgn.data.verification import verify_file
from hgn.scene.random_scene import REPORT_SEED, generate_scene
from hgn.scene.scene import Scene
from hgn.schema import Positive, from_mapping, require, require_bounds
from hgn.system.files import write_json
from hgn.system.progress import bar
from tools import report
from tools.bench.states import Workload, scene_of
from tools.timing import FrameClock

FRAME_RATE_HZ = 60.0
STEP_S, SUBSTEPS = 1 / 60 / 54, 55  # Taichi Elements' step at 64 cells a side, and how many it takes a frame
CUBES = ((0.3, 0.3, 0.3), (0.3, 0.3, 0.7), (0.7, 0.3, 0.3), (0.7, 0.3, 0.7))
CUBE_KINDS, CUBE_SIZE = (0, 1, 2, 0), 0.08
SIDE_BY_SIDE = 256
# asked for: ms a frame and scene on one H100, seconds of a data set
TARGETS = {
    "one_scene_te_step": 2.0, "one_scene": 5.0, "one_random_scene": 8.0, "scenes_256_te_step": 0.2,
    "scenes_256_random": None, "particles_1m": 110.0, "plain_one_scene_te_step": None, "plain_256_te_step": None,
    "dataset_800": 150.0,
}  # fmt: skip
GREEN = "green"
GENERATOR = (sys.executable, "-m", "datagen", "+experiment=obstacles")
COMPARED_FRAMES = 4
FIRST_FRAME, LATER_FRAMES, FALL = 1e-6, 1e-4, 0.01  # bounds: domain units


@dataclass(frozen=True)
class SolverTargetsConfig:
    """`python -m tools.studies.solver_targets`: what is timed."""

    cases: tuple[str, ...] = tuple(TARGETS)
    frames: int = 60  # the second half is timed; of a million particles a tenth
    # threads of a block, blocks and run of who runs a scene (datagen.mpm.team_launch.Team), to be compared in a few
    # cases; null: what the solver takes
    team: tuple[Positive[int], Positive[int], Positive[int]] | None = None
    scenes: Positive[int] = 800  # of the data set
    settings: tuple[str, ...] = ()  # more of the data set's command, as dataset.seed=1; its row names them
    folder: str | None = None  # a new one, in which the data set stays; null: it goes when it is timed
    seconds: Positive[float] | None = None  # of the data set, at most; then it is stopped, and its check tells how far
    device: Processor = "auto"  # or cpu, gpu
    json: str | None = None  # also write the rows to this file; --json FILE does the same

    def __post_init__(self) -> None:
        require_bounds(self)
        unknown = sorted(set(self.cases) - set(TARGETS))
        require(not unknown, "cases", f"some of {', '.join(TARGETS)}", unknown)
        require(self.frames >= COMPARED_FRAMES, "frames", f"at least {COMPARED_FRAMES}", self.frames)
        rule = "null with dataset_800, whose solver takes its own"
        require(self.team is None or "dataset_800" not in self.cases, "team", rule, self.team)
        new = self.folder is None or not (Path(self.folder) / MANIFEST_NAME).exists()
        require(new, "folder", "one without a data set, which would be gone on with", self.folder)


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; the exit code is 1 where a check is red."""
    from datagen.mpm.device import initialise

    config = from_mapping(SolverTargetsConfig, mapping)
    device = initialise(config.device)
    meta = report.meta_of(config, "cuda" if device.kind == "gpu" else "cpu")
    rows: list[dict[str, Any]] = []
    with bar("cases", len(config.cases), unit="case") as progress:
        for case in config.cases:
            rows.append({"case": case, "target": TARGETS[case]} | _row(case, config, device.kind))
            progress.update()
            if config.json is not None:  # after each: what a later case does takes nothing away
                write_json(config.json, {"meta": meta, "rows": rows})
    print(table(rows))
    return 0 if all(row["check"] == GREEN for row in rows) else report.EXIT_RED


def table(rows: list[dict[str, Any]]) -> str:
    """The figures for people."""
    lines = []
    for row in rows:
        figures = row.get("seconds", row.get("ms")), row["target"], row.get("substeps")
        lines.append((row["case"], *(report.number(value, ".4g") for value in figures), row["check"]))
    return report.table(("case", "ms a frame and scene, or s", "asked for", "steps a frame", "check"), lines)


def _row(case: str, config: SolverTargetsConfig, kind: str) -> dict[str, Any]:
    if case == "dataset_800":
        return _dataset(config)
    own, frames, many, team = MpmConfig(device=kind), config.frames, SIDE_BY_SIDE if "256" in case else 1, config.team
    if "random" in case:
        scenes, colliders = _random_scenes(many)
        return timed(scenes, own, frames, colliders=colliders, team=team)
    if case == "particles_1m":
        return timed([scene_of(Workload(1_000_000, 1), 0, 0.035)], own, max(COMPARED_FRAMES, frames // 10), team=team)
    if case == "one_scene":
        return timed([_cubes()], own, frames, team=team)
    theirs, rate = _at_their_step(kind), 1 / (SUBSTEPS * STEP_S)
    if case.startswith("plain"):
        return _plain(many, theirs, rate, frames)
    return timed([_cubes()] * many, theirs, frames, rate, team=team)


def timed(
    scenes: Sequence[Scene],
    mpm: MpmConfig,
    frames: int,
    rate: float = FRAME_RATE_HZ,
    colliders: Sequence[Collider] | None = None,
    team: tuple[int, int, int] | None = None,
) -> dict[str, Any]:
    """Milliseconds a frame and scene, after a comparison of the first scene that compiles; by `team`, or by what the
    solver takes. Where its blocks are not at work at once it takes another way, of which no time is given.
    """
    from datagen.mpm.solver import SceneFailure, Simulated, Team, simulate

    colliders = colliders or [build_collider(scenes[0], mpm.collider_band_cells)] * len(scenes)
    expected = simulate(scenes[:1], mpm, COMPARED_FRAMES, rate, colliders=colliders[:1], team=Team(0))[0]
    row: dict[str, Any] = {"scenes": len(scenes), "particles": sum(scene.particle_count for scene in scenes)}
    chosen, clock = None if team is None else Team(*team), FrameClock()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            simulate(scenes, mpm, 2, rate, colliders=colliders, team=chosen)
            outcomes = simulate(scenes, mpm, frames, rate, clock, colliders=colliders, team=chosen)
    except RuntimeWarning as warning:
        return row | {"ms": None, "check": str(warning)}
    for outcome in (expected, *outcomes):
        if isinstance(outcome, SceneFailure):
            return row | {"ms": None, "check": outcome.cause}
    paths = [outcome.position_TN3 for outcome in (expected, *outcomes) if isinstance(outcome, Simulated)]
    if not all(np.isfinite(path_TN3[-1]).all() for path_TN3 in paths):
        return row | {"ms": None, "check": "positions are not finite"}
    away_T = np.abs(paths[1][:COMPARED_FRAMES] - paths[0]).max(axis=(1, 2))
    if away_T[1] > FIRST_FRAME or away_T.max() > LATER_FRAMES:
        return row | {"ms": None, "check": f"{away_T[1]:.1e} after a frame, {away_T.max():.1e} after some"}
    # frames of one launch end together: from the end of the launch that the middle frame is in
    ends = clock.ends
    begin = max(t for t in range(frames - 1) if ends[t] <= ends[(frames - 1) // 2] + 1e-3)
    steps = [outcome.counters["substeps"] for outcome in outcomes if isinstance(outcome, Simulated)]
    return row | {
        "ms": 1e3 * (ends[-1] - ends[begin]) / (frames - 1 - begin) / len(scenes),
        "substeps": float(np.mean(steps)) / (frames - 1),
        "check": GREEN,
    }


def _plain(copies: int, mpm: MpmConfig, rate: float, frames: int) -> dict[str, Any]:
    from datagen.mpm.solver import Simulated, simulate
    from tools.studies.plain_mpm import plain_milliseconds

    scene = _cubes()
    taken, position_N3 = plain_milliseconds(scene, copies, SUBSTEPS, STEP_S, frames)
    (ours,) = simulate([scene], mpm, frames + 1, rate)
    assert isinstance(ours, Simulated)
    away = float(np.linalg.norm(position_N3.mean(axis=0) - ours.position_TN3[-1].mean(axis=0)))
    row = {"scenes": copies, "particles": copies * scene.particle_count, "substeps": SUBSTEPS}
    if not away < FALL:
        return row | {"ms": None, "check": f"its centre of mass is {away:.1e} from ours"}
    return row | {"ms": taken / copies, "check": GREEN}


def _dataset(config: SolverTargetsConfig) -> dict[str, Any]:
    """Seconds from the start of the command to its end, shards verified after."""
    with ExitStack() as stack:
        folder = config.folder or f"{stack.enter_context(tempfile.TemporaryDirectory())}/data"
        begin = time.perf_counter()
        settings = f"scenes={config.scenes}", f"out={folder}", "progress=off", *config.settings
        process = subprocess.Popen([*GENERATOR, *settings])
        stack.callback(process.kill)
        row: dict[str, Any] = {"scenes": config.scenes, "settings": list(config.settings), "seconds": None}
        try:
            ended = process.wait(config.seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)  # what is published stays
            process.wait()
            found = (Path(folder) / MANIFEST_NAME).exists()
            published = Manifest.load(folder).published("train") if found else 0  # training scenes
            return row | {"check": f"{published} scenes after {config.seconds:g} s"}
        seconds = time.perf_counter() - begin
        if ended:
            return row | {"check": f"ended with {ended}"}
        data = Path(folder)
        shards = Manifest.load(data).shards.since(0)
        for shard in shards:
            verify_file(data / shard.name, shard.sha256, shard.bytes, "generate it again")
    return row | {"seconds": seconds, "check": GREEN if shards else "no shards"}


def _at_their_step(kind: str) -> MpmConfig:
    """conf/mpm/taichi_elements.yaml, at the step that Taichi Elements takes."""
    theirs = yaml.safe_load((config_directory() / "mpm" / "taichi_elements.yaml").read_text())
    del theirs["defaults"]
    return from_mapping(MpmConfig, theirs | {"device": kind, "fixed_time_step_s": STEP_S})


def _cubes() -> Scene:
    count = int(8 * (64 * CUBE_SIZE) ** 3 + 1)
    draw = np.random.default_rng(0).uniform
    position = np.concatenate([draw(-CUBE_SIZE / 2, CUBE_SIZE / 2, (count, 3)) + centre for centre in CUBES])
    kinds = np.repeat(np.array(CUBE_KINDS, np.uint8), count)
    return Scene(position.astype(np.float32), np.zeros(position.shape, np.float32), kinds)


def _random_scenes(count: int) -> tuple[list[Scene], list[Collider]]:
    """Scenes of the data set with obstacles; a case's own, so that no case waits for another's."""
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        made = list(pool.map(_scene, range(REPORT_SEED, REPORT_SEED + count), chunksize=4))
    return [scene for scene, _ in made], [collider for _, collider in made]


def _scene(seed: int) -> tuple[Scene, Collider]:
    scene = generate_scene(SceneConfig(), seed)
    return scene, build_collider(scene, MpmConfig().collider_band_cells)


if __name__ == "__main__":
    run_command(main, "solver_targets")
