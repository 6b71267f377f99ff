"""python -m tools.studies.drift data=data/obstacles out=drift: how far backends and precisions lead from float32.

Motion is chaotic: a rollout departs from plain float32's whatever is changed in it. How far plain float32 departs from
itself once its particles begin a little displaced is the network's chaos floor, and a backend or precision below it is
as good. Beside them stand the solver's own floors and the network's error.
Shape legend: S scenes, T frames, N particles of a scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hgn.command import run_command
from hgn.config import PRECISIONS, MpmConfig, NetworkConfig
from hgn.data.lookup import first_episodes
from hgn.data.manifest import SPLITS
from hgn.data.reader import EpisodeStore
from hgn.runtime.backend import triton_unsupported_reason
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.runtime.weights import require_frame_rate
from hgn.scene.episode import Episode
from hgn.schema import from_mapping, from_stored, require, require_one_of, require_positive, to_mapping
from hgn.system.device import choose_device
from hgn.system.files import write_atomically, write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from hgn.training.errors import mean_so_far, position_mse
from tools.figure import as_png, new_figure
from tools.solver_launches import Setting, SolverLaunches

TOLD_FRAMES = (1, 10, 50, 99, 150, 200)  # and the last one
WHAT = "position MSE: sum over axes, mean over particles, domain lengths squared"


@dataclass(frozen=True)
class DriftConfig:
    """The options of `python -m tools.studies.drift`."""

    data: str  # a data set
    out: str  # writes OUT.json after each row, and OUT.png
    weights: str = "obstacles"  # a file of python -m hgn.export, or the name of shipped weights
    split: str = "test"
    scenes: int = 20  # simulated side by side
    frames: int = 300
    # domain units, at most, of each coordinate at the start: the chaos floors
    displacements: tuple[float, ...] = (1e-6, 1e-5)
    solver: bool = True  # also how far the solver departs from itself; on a CPU that takes minutes for each scene
    device: str = "auto"  # backend triton and precisions other than float32 are there on a GPU alone
    json: str | None = None  # another name for OUT.json; --json FILE does the same

    def __post_init__(self) -> None:
        require(self.out != "", "out", "a file name without its ending", self.out)
        require_one_of(self, "split", SPLITS)
        require_positive(self, "scenes")
        require(self.frames >= 2, "frames", "at least 2", self.frames)
        for i, size in enumerate(self.displacements):
            require(size > 0, f"displacements[{i}]", "above 0", size)
            require(size not in self.displacements[:i], f"displacements[{i}]", "named once", size, "leave it out")


@dataclass(frozen=True)
class Run:
    """A network's simulations that are set beside plain float32's."""

    backend: str
    precision: str
    displacement: float = 0.0  # at most, of each coordinate at the start; domain units

    @property
    def name(self) -> str:
        if (self.backend, self.precision) != ("torch", "fp32"):
            return f"{self.backend}, {self.precision}"
        return f"displaced by {self.displacement:g}" if self.displacement else "torch, fp32, once more"


PLAIN = Run("torch", "fp32")


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes OUT.json after each row and OUT.png; returns the exit code."""
    config = from_mapping(DriftConfig, mapping)
    store = EpisodeStore(config.data, config.split)
    episodes = first_episodes(store, config.scenes)
    report = Report(config, episodes)
    simulator = Simulator.load(config.weights, config.device, PLAIN.backend, PLAIN.precision)
    require_frame_rate(simulator.info, episodes[0].frame_rate_hz)
    network, device = simulator.network.config, simulator.device
    plain = simulated(simulator, PLAIN, episodes, report.frames)
    truth = [RolloutResult(np.asarray(episode.position_TN3[: report.frames])) for episode in episodes]
    report.add("network", "error: from the data", plain, truth)
    for run in runs(device, network, config.displacements):
        simulator = Simulator.load(config.weights, str(device), run.backend, run.precision)
        report.add("network", run.name, simulated(simulator, run, episodes, report.frames), plain)
    if config.solver:
        simulator.backend.release()
        mpm = from_stored(MpmConfig, store.manifest.config["mpm"], "mpm")
        mpm = replace(mpm, device="gpu" if device.type == "cuda" else "cpu")
        for name, (trials, reference) in solver_floors(mpm, episodes, report.frames, config.displacements).items():
            report.add("solver", name, trials, reference)
    print(table(report.rows), f"{config.out}.png {report.file}", sep="\n")
    return 0


def runs(device: torch.device, network: NetworkConfig, displacements: Sequence[float]) -> list[Run]:
    """Plain float32 again and displaced, then every other backend and precision of this device."""
    fast = [Run("triton", name) for name in PRECISIONS if triton_unsupported_reason(device, network, name) is None]
    plain = [Run("torch", "tf32")] if device.type == "cuda" else []  # elsewhere all products are float32's
    return [PLAIN, *(replace(PLAIN, displacement=size) for size in displacements), *plain, *fast]


def simulated(simulator: Simulator, run: Run, episodes: Sequence[Episode], frames: int) -> list[RolloutResult]:
    """All scenes side by side."""
    scenes = [displaced(episode, run.displacement) for episode in episodes]
    with bar(run.name, total=frames - 1, unit="frame") as progress:
        return simulate_scenes(simulator, scenes, frames, lambda _: progress.update())


def displaced(episode: Episode, size: float) -> InitialState:
    """Frame 0 with each coordinate moved by at most `size`, at random but alike whenever it is asked for."""
    scene = InitialState.of_episode(episode)
    if not size:
        return scene
    move_N3 = np.random.default_rng(episode.seed).uniform(-size, size, scene.position_N3.shape)
    return replace(scene, position_N3=(scene.position_N3 + move_N3).astype(np.float32))


def solver_floors(
    config: MpmConfig, episodes: Sequence[Episode], frames: int, displacements: Sequence[float]
) -> dict[str, tuple[list[RolloutResult], list[RolloutResult]]]:
    """What the solver departs from itself by: simulations on the data's grid, and those with the data's step."""
    first, step = episodes[0], config.stability_fraction
    launches = SolverLaunches(config, first.obstacle_grid.cell_size, first.frame_rate_hz, frames)
    settings = {f"displaced by {size:g}": Setting(step, size) for size in displacements}
    settings["half the step"] = Setting(step / 2)
    for setting in (Setting(step), *settings.values()):
        launches.add(setting)
    with bar("solver", total=frames, unit="frame") as progress:
        reference = launches.trials(Setting(step), episodes, lambda _: progress.update())
    return {name: (launches.trials(setting, episodes), reference) for name, setting in settings.items()}


class Report:
    """Rows, written after each: what a later one does takes nothing away."""

    def __init__(self, config: DriftConfig, episodes: Sequence[Episode]) -> None:
        self.frames = min(config.frames, *(len(episode.position_TN3) for episode in episodes))
        self.file, self.picture = Path(config.json or f"{config.out}.json"), Path(f"{config.out}.png")
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.picture.parent.mkdir(parents=True, exist_ok=True)
        self.rows: list[dict[str, Any]] = []
        self.meta = provenance(choose_device(config.device)) | {
            "config": without_folders(to_mapping(config)),
            "episodes": [episode.key for episode in episodes],
            "frames": self.frames,
            "what": WHAT,
        }

    def add(self, system: str, name: str, trials: Sequence[RolloutResult], references: Sequence[RolloutResult]) -> None:
        mse_ST = departure(trials, references, self.frames)
        told = [frame for frame in sorted({*TOLD_FRAMES, self.frames - 1}) if frame < self.frames]
        causes = [trial.cause for trial in trials if trial.cause is not None]
        curves = {"mean": mean_so_far(mse_ST), "median": median_so_far(mse_ST)}
        self.rows.append(
            {
                "system": system,
                "name": name,
                **{which: {str(frame): number(curve_T[frame]) for frame in told} for which, curve_T in curves.items()},
                "scenes": {str(frame): [number(value) for value in mse_ST[:, frame]] for frame in told},
                "curves": {which: [number(value) for value in curve_T] for which, curve_T in curves.items()},
                "failed_scenes": len(causes),
                "first_failure": causes[0] if causes else None,
            }
        )
        write_json(self.file, {"meta": self.meta, "rows": self.rows}, allow_nan=False)
        write_atomically(self.picture, draw(self.rows))


def departure(trials: Sequence[RolloutResult], references: Sequence[RolloutResult], frames: int) -> np.ndarray:
    """Position MSE of each scene and frame, float64 [S, T]; NaN behind the end of either."""
    mse_ST = np.full((len(trials), frames), np.nan)
    for mse_T, trial, reference in zip(mse_ST, trials, references, strict=True):
        both = min(trial.frame_count, reference.frame_count)
        mse_T[:both] = position_mse(trial.position_TN3[:both], reference.position_TN3[:both])
    return mse_ST


def median_so_far(value_ST: np.ndarray) -> np.ndarray:
    """The median at each frame over the scenes that came so far, float64 [T]; NaN where none did."""
    there = ((value_S, np.isfinite(value_S)) for value_S in value_ST.T)
    return np.array([np.median(value_S[there_S]) if there_S.any() else np.nan for value_S, there_S in there])


def number(value: float) -> float | None:
    """With four digits; none for NaN."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Means over the scenes, and their median in the last frame, as Markdown."""
    frames = list(rows[0]["mean"])
    lines = [
        f"| position MSE after frames | {' | '.join(frames)} | median | failed |",
        "| :-- |" + " --: |" * (len(frames) + 2),
    ]
    for row in rows:
        values = [*row["mean"].values(), row["median"][frames[-1]]]
        told = " | ".join("" if value is None else f"{value:.1e}" for value in values)
        lines.append(f"| {row['system']}, {row['name']} | {told} | {row['failed_scenes']} |")
    return "\n".join(lines)


def draw(rows: Sequence[dict[str, Any]]) -> bytes:
    """Mean and median position MSE over the frames; PNG bytes. Full lines are backends, precisions and the error;
    dotted ones the network's floors, broken ones the solver's.
    """
    figure, (panels,) = new_figure(1, 2, (14.5, 5.4), share_y=True)
    for panel, which in zip(panels, ("mean", "median"), strict=True):
        for row in rows:
            curve_T = np.array([np.nan if value is None else value for value in row["curves"][which]])
            time_T = np.flatnonzero(curve_T > 0)
            line = "--" if row["system"] == "solver" else ":" if "displaced" in row["name"] else "-"
            panel.plot(time_T, curve_T[time_T], line, label=f"{row['system']}, {row['name']}")
        panel.set(xlabel="frame", yscale="log", title=f"{which} of the scenes")
        panel.grid(alpha=0.25)
    panels[0].set_ylabel("position MSE (domain lengths²)")
    panels[1].legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, fontsize=9, frameon=False)
    return as_png(figure)


if __name__ == "__main__":
    run_command(main, "drift")
