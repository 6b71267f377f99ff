"""A case of `tools.stability network` as data: scenes, frames, and limits on named measures.

A measure (measures.py) maps trajectories to figures. A limit bounds one of them from both sides, relative to the
figure of the solver where the case is simulated by the solver too. A new case needs no code of its own.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hgn.runtime.rollouts import RolloutResult
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.hdf5 import damage_named
from hgn.scene.scene import Scene
from hgn.schema import require
from hgn.system.yaml_files import read_json
from tools.stability.gallery import GRID_CELLS, REFERENCE, GalleryCase, load_gallery


@dataclass(frozen=True)
class Limit:
    """Passes if low + below * solver <= figure <= high + above * solver, where solver is the solver's figure."""

    measure: str  # a key of measures.MEASURES; a dot and a field follow where the measure returns records
    low: float = -math.inf
    high: float = math.inf
    below: float = 0.0
    above: float = 0.0


STANDARD = (Limit("energy_growth", high=0.02), Limit("outside_domain", high=0.0))


@dataclass(frozen=True, eq=False)
class Parameter:
    """The parameter of a case of the family `parameters`, and the figure that depends on it."""

    name: str
    value: float
    range: str  # inside, edge or outside of the range of the training data
    figure: Callable[[np.ndarray, Scene], float]  # of positions [T, N, 3] and the scene
    known: float | None = None  # closed form of the figure, which replaces that of the solver
    scale: float | None = None  # length that errors are a fraction of; None: the expected figure


@dataclass(frozen=True, eq=False)
class Case:
    """Scenes that are simulated side by side, for how long, and the limits of their measures."""

    name: str
    scenes: tuple[Scene, ...]
    frames: int
    limits: tuple[Limit, ...] = STANDARD
    solver: bool = False  # the solver simulates the scenes too, as the reference of limits
    reported: str | None = None  # measure in the column "measured"; None: the number of frames reached
    also: tuple[str, ...] = ()  # measures that are reported without a limit
    labels: tuple[str, ...] = ()  # of the scenes
    last_frames: tuple[int, ...] = ()  # last frame of each scene that is measured; empty: the last one
    known_3: tuple[float, float, float] | None = None  # acceleration of the particles in the first `known_frames`
    known_frames: int = 0
    at_frames: tuple[int, ...] = ()  # frames in which `collapse` is measured
    settled: int = 0  # frame from which on all particles rest
    upright: tuple[Scene, ...] = ()  # the scenes before they were turned
    parameter: Parameter | None = None
    nominal: tuple[Scene, ...] = ()  # the scenes with the default of the parameter, for the solver only
    gallery: GalleryCase | None = None  # the file of a gallery scene, which has bounds instead of limits
    references: tuple[float, ...] = ()  # the solver's figures, one for each bound of the gallery scene
    brief: bool = False  # rows that pass are counted, and not printed


@dataclass(frozen=True, eq=False)
class Outcome:
    """Trajectories of a case, of the network or of the solver, with what measures need."""

    case: Case
    scenes: Sequence[InitialState]
    trials: Sequence[RolloutResult]
    simulator: Simulator
    solver: "Outcome | None" = None  # the solver's trajectories of the same scenes
    upright: tuple[Sequence[RolloutResult], Sequence[RolloutResult]] | None = None  # network and solver

    @property
    def frame_rate_hz(self) -> float:
        return self.simulator.frame_rate_hz

    @property
    def complete(self) -> bool:
        return all(t.cause is None and t.frame_count >= self.case.frames for t in self.trials)


def cut(trials: Sequence[RolloutResult], last_frames: Sequence[int]) -> list[RolloutResult]:
    """Ends each trajectory at its last measured frame; a divergence after that does not count."""
    return [
        RolloutResult(trial.position_TN3[: last + 1], trial.cause if trial.frame_count <= last else None)
        for trial, last in zip(trials, last_frames, strict=True)
    ]


def gallery_cases(case: str) -> list[Case]:
    """Returns the scenes as cases, with the solver's figures from the JSON of `tools.stability solver`."""
    loaded = load_gallery(case)
    draw, _, scene = case.partition(":")
    file = REFERENCE / f"{draw}_solver.json"
    command = f"run python -m tools.stability solver 'cases=[{case}]' json={file}"
    require(file.is_file(), "cases", f"{case} only where {file} has the solver's figures", case, command)
    cases = []
    with damage_named(f"{file} must be a report of tools.stability solver", command):
        stored = read_json(file)["scenes"]
        for each in loaded:
            own = stored.get(each.name, {})
            rule = f"as it was when {file.name} was measured"
            require(own.get("digest") == each.digest, str(each.file), rule, "a change of scene", command)
            grid = {**own["series"][str(GRID_CELLS[0])]}
            lacking = [bound.key for bound in each.measure.bounds if bound.key not in grid]
            require(not lacking, str(each.file), rule, f"a new row: {', '.join(lacking)}", command)
            figures = tuple(bound.reduced_line(grid[bound.key]) for bound in each.measure.bounds)
            frames = each.measure.frames
            cases.append(Case(each.name, each.scenes, frames, (), gallery=each, references=figures, brief=not scene))
    return cases
