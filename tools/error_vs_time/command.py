"""Chooses contenders and reference of tools.error_vs_time, and starts the run."""

import functools
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datagen.fine import solver_on_grid, wall_thickness
from hgn.command import EXIT_MACHINE
from hgn.config import PRECISIONS, MpmConfig
from hgn.data.fresh import set_record
from hgn.data.reader import EpisodeStore, first_episodes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import find_weights, load_weights, require_frame_rate, shipped_weights
from hgn.scene.episode import Episode
from hgn.schema import ConfigError, from_mapping, from_stored, printable, require, require_replaceable
from hgn.system.device import choose_device
from tools.error_vs_time.contenders import (
    BaselineContender,
    Contender,
    FallingContender,
    NetworkContender,
    SolverContender,
)
from tools.error_vs_time.paired import paired_rows, paired_table
from tools.error_vs_time.plot import CONVENTION
from tools.error_vs_time.run import Run
from tools.error_vs_time.score import table
from tools.error_vs_time.settings import ENDINGS, ErrorVsTimeConfig
from tools.report import meta_of
from tools.solver_rollouts import Setting, SolverLaunches

REFERENCE_STEP = 0.25  # the reference's step on the data's own grid, as a fraction of the limit of stability
STEPS = (1.0, 0.5)  # the solver's steps, as fractions of the limit of stability


def main(mapping: dict[str, Any]) -> int:
    """Prints a table and writes the report; returns the exit code."""
    started = time.monotonic()
    config = from_mapping(ErrorVsTimeConfig, mapping)
    require_replaceable("out", *(Path(f"{config.out}{ending}") for ending in ENDINGS))
    Path(config.out).parent.mkdir(parents=True, exist_ok=True)
    device = choose_device(config.device)
    store = EpisodeStore(config.data, config.split)
    remedy = "use python -m hgn.evaluate for imported sets"
    require("mpm" in store.manifest.config, "data", "a set of python -m datagen", config.data, remedy)
    episodes = first_episodes(store, config.scenes)
    frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
    finer = store.manifest.config.get("reference")
    resimulate = config.resimulate and finer is None  # a finer grid is nearer to the truth than the data's own
    same = {"episodes": [e.key for e in episodes], "frames": frames, "reference": _reference_name(resimulate, finer)}
    mpm = replace(from_stored(MpmConfig, store.manifest.config["mpm"], "mpm"), device=device.type)
    own_cell, rate = episodes[0].obstacle_grid.cell_size, episodes[0].frame_rate_hz
    own_grid = round(1 / own_cell)
    reference_grid = own_grid if finer is None else int(finer["cells"])

    @functools.cache
    def launches(grid: int) -> SolverLaunches:
        cell_size = own_cell if grid == own_grid else 1 / grid
        return SolverLaunches(solver_on_grid(mpm, cell_size, own_cell), cell_size, rate, frames)

    networks = network_contenders(config, device, episodes)
    solvers = solver_contenders(config, mpm, launches, own_grid, reference_grid, resimulate)
    contenders = [*networks, *baseline_contenders(store, device, wall_thickness(mpm, own_cell)), *solvers]
    for solver in solvers:
        solver.launches.add(solver.setting)
    references: Sequence[Episode] = episodes
    left_out: dict[str, str] = {}
    if resimulate:
        references, left_out = resimulated(episodes, launches(own_grid), REFERENCE_STEP)
    references = [replace(e, position_TN3=np.asarray(e.position_TN3[:frames])) for e in references]
    require(bool(references), "data", "scenes that the solver simulates to the end", left_out)
    meta = meta_of(config, device) | same
    data = Path(printable(config.data)).name
    meta |= {"data": data, "split": config.split, "scenes": len(references), "left_out": left_out}
    meta["set"] = set_record(config.data, store.manifest.config["seed"], {c.file for c in networks})
    meta |= {"convention": CONVENTION, "seconds_before_scoring": time.monotonic() - started}
    run = Run(config, contenders, references, device, meta, started)
    run.measure()
    print(table(run.rows), paired_table(paired_rows(run.rows)), f"{run.out}.png {run.file}", sep="\n\n")
    if run.failed:
        print(f"error: {run.failed} of the measurements failed; see above, and not_run in {run.file}", file=sys.stderr)
    return EXIT_MACHINE if run.failed else 0


def _reference_name(resimulate: bool, finer: dict[str, Any] | None) -> str:
    if finer is not None:
        children = f"{finer['particles_per_visible']} particles for each visible one"
        return f"the data: {finer['cells']} cells a unit, {children}"
    if not resimulate:
        return "the data"
    return f"the solver on the data's grid at {REFERENCE_STEP:g} of the limit of stability"


def network_contenders(
    config: ErrorVsTimeConfig, device: torch.device, episodes: Sequence[Episode]
) -> list[NetworkContender]:
    """Returns every weights file at every supported precision, and prints those that are left out."""
    files = fitting_weights(episodes) if config.weights is None else named_weights(config.weights, episodes)
    contenders: list[NetworkContender] = []
    for file in files:
        hgn = load_weights(file)[1].network.kind == "hgn"
        precisions = config.precisions or (("fp32",) if device.type != "cuda" else PRECISIONS if hgn else ("tf32",))
        for precision in precisions:
            try:
                contenders.append(NetworkContender(file, precision, device, episodes[0].frame_rate_hz))
            except ConfigError as error:
                if precision != "fp16":
                    raise
                print(f"left out: {file.name} at fp16: {error}", file=sys.stderr)
    return contenders


def named_weights(names: Sequence[str], episodes: Sequence[Episode]) -> list[Path]:
    """Returns the weights files. Raises: ConfigError for one that does not exist or does not fit the data."""
    files = [find_weights(name, f"weights[{i}]") for i, name in enumerate(names)]
    for i, (name, file) in enumerate(zip(names, files, strict=True)):
        try:
            require_fits(file, episodes, f"weights[{i}]")
        except ConfigError as error:
            remedy = "use other weights, or the data set that these were trained on"
            raise ConfigError(f"weights[{i}] must fit the data, got {name}: {error}; {remedy}") from None
    return files


def fitting_weights(episodes: Sequence[Episode]) -> list[Path]:
    """Returns all shipped weights that fit the data and have obstacle features if the data has obstacles.

    Prints the others.
    """
    seen = any(len(episode.obstacle_grid.cell_K3) for episode in episodes)
    files = []
    for name, file in shipped_weights().items():
        try:
            sees = load_weights(file)[1].network.obstacle_features
            require(sees == seen, "obstacles", f"{'in' if sees else 'not in'} the data of these weights", seen)
            require_fits(file, episodes, "weights")
            files.append(file)
        except ConfigError as error:
            print(f"left out: the shipped weights {name}: {error}", file=sys.stderr)
    return files


def require_fits(file: Path, episodes: Sequence[Episode], field: str) -> None:
    """Raises: ConfigError if the weights do not support the data's frame rate, materials, gravity or obstacle cells."""
    network, info = load_weights(file, field=field)
    require_frame_rate(info, episodes[0].frame_rate_hz)
    Simulator(network, info.frame_rate_hz, "torch", info=info).start([InitialState.of_episode(e) for e in episodes])


def baseline_contenders(store: EpisodeStore, device: torch.device, wall: float) -> list[Contender]:
    """Returns predictors that have learned nothing; `wall` is the thickness of the domain's walls."""
    split = "train" if store.manifest.published("train") else store.split  # some sets have only the test split
    mean_3 = np.asarray(store.manifest.statistics(split).acceleration.mean)
    predictors: dict[str, Callable[[Episode], np.ndarray]] = {
        "constant velocity": lambda episode: np.zeros(3),
        "ballistic motion": lambda episode: np.asarray(episode.gravity) / episode.frame_rate_hz**2,
        "mean acceleration": lambda episode: mean_3,
    }
    constant = [BaselineContender(name, acceleration, device) for name, acceleration in predictors.items()]
    return [*constant, FallingContender(wall)]


def solver_contenders(
    config: ErrorVsTimeConfig,
    mpm: MpmConfig,
    launches: Callable[[int], SolverLaunches],
    own_grid: int,
    reference_grid: int,
    resimulate: bool,
) -> list[SolverContender]:
    """Returns the solver with each setting, and the chaos floor: the reference from slightly displaced particles."""
    step = REFERENCE_STEP if resimulate else mpm.stability_fraction

    def solver(grid: int, step: float, perturbation: float = 0.0, **named: Any) -> SolverContender:
        return SolverContender(launches(grid), Setting(step, perturbation), named)

    contenders = [solver(grid, step) for grid in config.mpm_grids for step in STEPS]
    if config.perturbation:
        floor = f"perturbed by {config.perturbation:g}" if reference_grid == own_grid else "other children"
        contenders.append(solver(reference_grid, step, config.perturbation, system="chaos", floor=floor))
    if config.mpm_grids and 2 * step <= 1:
        contenders.append(solver(own_grid, 2 * step, system="chaos", floor="twice the step"))
    return contenders


def resimulated(
    episodes: Sequence[Episode], launches: SolverLaunches, step: float
) -> tuple[list[Episode], dict[str, str]]:
    """Simulates episodes with another step; returns those that reach the end, and the causes of the others.

    Further settings of the same grid are simulated in the same launch.
    """
    trials = launches.trials(Setting(step), episodes)
    pairs = list(zip(episodes, trials, strict=True))
    left_out = {episode.key: trial.cause for episode, trial in pairs if trial.cause is not None}
    return [replace(e, position_TN3=trial.position_TN3) for e, trial in pairs if trial.cause is None], left_out
