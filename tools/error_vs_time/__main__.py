"""python -m tools.error_vs_time data=… weights=[…] out=results/error_vs_time: error against run time.

Networks (shipped ones where none are named), the solver at coarser grids and larger steps, and predictors that learn
nothing, all on the same test scenes, scored by one converged simulation. Writes a table, OUT.json, OUT.png,
OUT_batched.png and OUT_frames.png.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from hgn.command import EXIT_MACHINE, run_command
from hgn.config import PRECISIONS, MpmConfig
from hgn.data.fresh import set_record
from hgn.data.reader import EpisodeStore, first_episodes
from hgn.runtime.weights import WeightsInfo, find_weights, load_weights, shipped_weights
from hgn.scene.episode import Episode
from hgn.scene.material import MATERIALS
from hgn.schema import ConfigError, from_mapping, from_stored, require
from hgn.system.device import choose_device
from hgn.system.files import write_json
from hgn.system.machine import available_cpus
from hgn.system.progress import bar
from tools.error_vs_time.contenders import (
    COARSE_GRIDS,
    PARTICLES_AT_ONCE,
    SAME_GRID,
    BaselineContender,
    Contender,
    NetworkContender,
    SolverContender,
)
from tools.error_vs_time.paired import paired_lines, paired_rows
from tools.error_vs_time.plot import CONVENTION
from tools.error_vs_time.run import Earlier, Run, draw, same_row
from tools.error_vs_time.score import table
from tools.error_vs_time.settings import ErrorVsTimeConfig
from tools.report import meta_of
from tools.solver_rollouts import Setting, SolverLaunches, other_grid

if TYPE_CHECKING:
    from hgn.runtime.precompile import Precompilation

REFERENCE_STEP = 0.25  # of the limit of stability, on the data's own grid
COMPILING_FRACTION = 0.4  # of the seconds given, until when kernels that are compiled ahead are waited for
ORDER = ("tf32", "fp16", "fp32")  # what tells most for its time first


def main(mapping: dict[str, Any]) -> int:
    """Prints a table and writes the report; returns the exit code."""
    begun = time.monotonic()
    config = from_mapping(ErrorVsTimeConfig, mapping)
    earlier = [Earlier.read(file, f"earlier[{i}]") for i, file in enumerate(config.earlier)]
    if config.data is None:
        return _draw_again(config, earlier)
    Path(config.out).parent.mkdir(parents=True, exist_ok=True)
    device = choose_device(config.device)
    processor = "gpu" if device.type == "cuda" else "cpu"
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
    for report in earlier:
        report.require_same([episode.key for episode in episodes], frames, _reference_name(config))
    known = [row for report in earlier for row in report.rows]
    mpm = replace(from_stored(MpmConfig, store.manifest.config["mpm"], "mpm"), device=processor)
    own_cell, rate = episodes[0].obstacle_grid.cell_size, episodes[0].frame_rate_hz
    own_grid = round(1 / own_cell)

    @functools.cache
    def launches(grid: int) -> SolverLaunches:
        reference = config.resimulate and grid == own_grid
        most = frames if reference else min(frames, config.mpm_frames)
        cell_size = own_cell if grid == own_grid else 1 / grid
        return SolverLaunches(other_grid(mpm, cell_size, own_cell), cell_size, rate, most)

    every: list[Contender] = [*network_contenders(config, device, episodes), *baseline_contenders(store, device)]
    every += solver_contenders(config, mpm, launches, own_grid)
    contenders = [contender for contender in every if same_row(contender.row, known) is None]
    networks = [contender for contender in contenders if isinstance(contender, NetworkContender)]
    solvers = [contender for contender in contenders if isinstance(contender, SolverContender)]
    for solver in solvers:
        solver.launches.add(solver.setting)
    with ExitStack() as stack:
        precompilation = _precompiled_frames(networks, episodes, device)
        if precompilation is not None:
            stack.enter_context(precompilation)
        if config.resimulate:
            references, left_out = resimulated(episodes, launches(own_grid), REFERENCE_STEP)
        else:
            references = [replace(e, position_TN3=np.asarray(e.position_TN3[:frames])) for e in episodes]
            left_out = {}
        require(bool(references), "data", "scenes that the solver gets through", left_out)
        meta = meta_of(config, device) | {
            "data": Path(config.data).name,
            "split": config.split,
            "set": set_record(config.data, store.manifest.config["seed"], {c.file for c in networks}),
            "scenes": len(references),
            "episodes": [episode.key for episode in episodes],
            "left_out": left_out,
            "frames": frames,
            "reference": _reference_name(config),
            "convention": CONVENTION,
            "seconds_before_scoring": time.monotonic() - begun,
        }
        untimed = [row for report in earlier for row in report.untimed]
        run = Run(config, contenders, references, device, meta, begun, known, untimed)
        with ThreadPoolExecutor(available_cpus()) as threads:
            for solver in solvers:
                solver.launches.collide(references, threads)
            run.score_beside(lambda: precompilation is not None and precompilation.running)
        if precompilation is not None:
            print(precompilation.wait(lambda: run.is_past(COMPILING_FRACTION)), file=sys.stderr)
    run.meta["seconds_before_timing"] = time.monotonic() - begun
    run.measure()
    run.write(drawn=True)
    print(table(run.rows), *paired_lines(paired_rows(run.rows)), f"{run.out}.png {run.file}", sep="\n")
    if run.failed:
        print(f"error: {run.failed} of the measurements failed; see above, and not_run in {run.file}", file=sys.stderr)
    return EXIT_MACHINE if run.failed else 0


def _draw_again(config: ErrorVsTimeConfig, earlier: Sequence[Earlier]) -> int:
    """Draws the rows of earlier reports, and prints them; nothing is measured."""
    first = earlier[0].meta
    for report in earlier:
        report.require_same(first["episodes"], first["frames"], first["reference"])
    rows = [row for report in earlier for row in report.rows]
    Path(config.out).parent.mkdir(parents=True, exist_ok=True)
    files, paired = draw(config.out, rows, first), paired_rows(rows)
    write_json(config.json or f"{config.out}.json", {"meta": first, "rows": rows, "paired": paired}, allow_nan=False)
    print(table(rows), *paired_lines(paired), " ".join(files), sep="\n")
    return 0


def _reference_name(config: ErrorVsTimeConfig) -> str:
    if not config.resimulate:
        return "the data"
    return f"the solver on the data's grid at {REFERENCE_STEP:g} of the limit of stability"


def network_contenders(
    config: ErrorVsTimeConfig, device: torch.device, episodes: Sequence[Episode]
) -> list[NetworkContender]:
    """Every weights file at every precision that its backend knows; what is left out is said."""
    files = fitting_weights(episodes) if config.weights is None else named_weights(config.weights, episodes)
    contenders: list[NetworkContender] = []
    for file in files:
        hgn = load_weights(file)[1].network.kind == "hgn"
        precisions = config.precisions
        if precisions is None:
            precisions = ("fp32",) if device.type != "cuda" else PRECISIONS if hgn else ("tf32",)
        ranked = sorted(precisions, key=ORDER.index)
        for precision in precisions:
            chosen = precision, config.backend, device, episodes[0].frame_rate_hz, ranked.index(precision)
            try:
                contenders.append(NetworkContender(file, *chosen))
            except ConfigError as error:
                if precision != "fp16":
                    raise
                print(f"left out: {file.name} at fp16: {error}", file=sys.stderr)
    return contenders


def named_weights(names: Sequence[str], episodes: Sequence[Episode]) -> list[Path]:
    """Their files. Raises: ConfigError, before anything is simulated, for a name or file that is not there or is not
    for such data.
    """
    files = []
    for i, name in enumerate(names):
        file = find_weights(name, f"weights[{i}]")
        rule = _why_unfit(load_weights(file, field=f"weights[{i}]")[1], episodes)
        remedy = "take other weights, or the data set that these were trained on"
        require(rule is None, f"weights[{i}]", f"for data as this: {rule}", name, remedy)
        files.append(file)
    return files


def fitting_weights(episodes: Sequence[Episode]) -> list[Path]:
    """All shipped weights for such data, and those that see obstacles where there are some, else those that do not.
    What does not fit is said.
    """
    seen = any(len(episode.obstacle_grid.cell_K3) for episode in episodes)
    files = []
    for name, file in shipped_weights().items():
        info = load_weights(file)[1]
        if info.network.obstacle_features == seen and _why_unfit(info, episodes) is None:
            files.append(file)
        else:
            print(f"left out: the shipped weights {name}, which are for other data", file=sys.stderr)
    return files


def _why_unfit(info: WeightsInfo, episodes: Sequence[Episode]) -> str | None:
    """What the data has that the weights do not know; none where nothing is."""
    network, rate, cell_size = info.network, episodes[0].frame_rate_hz, episodes[0].obstacle_grid.cell_size
    present = {MATERIALS[i] for episode in episodes for i in np.unique(episode.material_N)}
    others = [e.gravity for e in episodes if tuple(e.gravity) != info.gravity and not network.relative]
    seen = network.obstacle_features and any(len(episode.obstacle_grid.cell_K3) for episode in episodes)
    if info.frame_rate_hz != rate:
        return f"frames at {rate:g} Hz, not {info.frame_rate_hz:g}"
    if not present <= set(network.materials):
        return f"with {', '.join(sorted(present))}, not {', '.join(network.materials)} alone"
    if others:
        return f"with the gravity {others[0]}, not {info.gravity}"
    if seen and info.obstacle_cell_size != cell_size:
        return f"with obstacles in cells of {cell_size:g}, not {info.obstacle_cell_size:g}"
    return None


def _precompiled_frames(
    networks: Sequence[NetworkContender], episodes: Sequence[Episode], device: torch.device
) -> Precompilation | None:
    """Compiles whole frames of networks: beside the solver, which needs one core."""
    whole = [contender for contender in networks if not contender.stepped]
    if not whole:
        return None
    # Triton, which backend torch does without, is loaded here.
    from hgn.runtime.precompile import precompile_frames

    particles = max(len(episode.material_N) for episode in episodes)
    configs, precisions = [c.network.config for c in whole], [c.precision for c in whole]
    return precompile_frames(configs, precisions, device, [particles, 8 * particles, PARTICLES_AT_ONCE])


def baseline_contenders(store: EpisodeStore, device: torch.device) -> list[Contender]:
    """What a network must beat to have learned anything."""
    split = "train" if store.manifest.published("train") else store.split  # fresh test sets are tests alone
    mean_3 = np.asarray(store.manifest.statistics(split).acceleration.mean)
    predictors: dict[str, Callable[[Episode], np.ndarray]] = {
        "constant velocity": lambda episode: np.zeros(3),
        "ballistic motion": lambda episode: np.asarray(episode.gravity) / episode.frame_rate_hz**2,
        "mean acceleration": lambda episode: mean_3,
    }
    return [BaselineContender(name, acceleration, device) for name, acceleration in predictors.items()]


def solver_contenders(
    config: ErrorVsTimeConfig, mpm: MpmConfig, launches: Callable[[int], SolverLaunches], own_grid: int
) -> list[Contender]:
    """The solver at its settings, and how far the reference departs from itself: the chaos floor."""
    step = REFERENCE_STEP if config.resimulate else mpm.stability_fraction

    def solver(grid: int, step: float, perturbation: float = 0.0, **named: Any) -> SolverContender:
        importance = SAME_GRID if grid == own_grid else COARSE_GRIDS
        return SolverContender(launches(grid), Setting(step, perturbation), config.mpm_frames, importance, named)

    contenders: list[Contender] = [solver(grid, step) for grid in config.mpm_grids for step in config.mpm_steps]
    if config.perturbation:
        floor = f"perturbed by {config.perturbation:g}"
        contenders.append(solver(own_grid, step, config.perturbation, system="chaos", floor=floor))
    if config.mpm_grids and 2 * step <= 1:
        contenders.append(solver(own_grid, 2 * step, system="chaos", floor="twice the step"))
    return contenders


def resimulated(
    episodes: Sequence[Episode], launches: SolverLaunches, step: float
) -> tuple[list[Episode], dict[str, str]]:
    """The episodes with the trajectories of another step, and the scenes that it stopped, with the cause; the other
    settings of the grid are simulated beside it.
    """
    with bar("reference", total=launches.frames, unit="frame") as progress:
        trials = launches.trials(Setting(step), episodes, lambda _: progress.update())
    pairs = list(zip(episodes, trials, strict=True))
    left_out = {episode.key: trial.cause for episode, trial in pairs if trial.cause is not None}
    return [replace(e, position_TN3=trial.position_TN3) for e, trial in pairs if trial.cause is None], left_out


if __name__ == "__main__":
    run_command(main, "error_vs_time")
