"""python -m tools.stability network weights=…: checks a network's motion against closed forms, the solver and limits.

The cases are in network_cases.py, the measures in measures.py. If a rollout fails, the runtime must report it.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from hgn.command import run_command
from hgn.config import DEFAULT_WEIGHTS, MpmConfig, SceneConfig, SimulatorConfig
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.scene import Scene
from hgn.schema import Bound, Bounded, ConfigError, FrameCount, Vector, from_mapping, to_mapping
from tools.report import ReportConfig, meta_of
from tools.solver_rollouts import solver_trials
from tools.stability.case import Case, Outcome, cut, gallery_cases
from tools.stability.checks import gallery_rows, refused, row_of
from tools.stability.gallery import GALLERY_CASES, is_gallery
from tools.stability.network_cases import FAMILIES, PARAMETERS, Context
from tools.stability.parameters import parameter_row
from tools.stability.row import Report, Row
from tools.timing import FrameClock

CaseName = Annotated[
    str, Bound(f"one of {', '.join(FAMILIES)}, {GALLERY_CASES}", lambda n: n in FAMILIES or is_gallery(n))
]


@dataclass(frozen=True)
class StabilityNetworkConfig(SimulatorConfig, ReportConfig, Bounded):
    """The options of `python -m tools.stability network`."""

    weights: str = DEFAULT_WEIGHTS  # a file of python -m hgn.export, or the name of shipped weights
    # throw, gravity, collision, collapse, rest, particles, domain, speed, single, slope, far; null: all of these.
    # parameters: friction and constants of materials; a quarter of an hour on one core.
    # gallery: the scenes of conf/gallery against the solver's figures; gallery_1: the draw for
    # choices; gallery_2: the draw for reports; gallery_NUMBER: another draw; gallery:SCENE: one scene
    cases: tuple[CaseName, ...] | None = None
    frames: FrameCount = 300  # of each rollout
    long_frames: FrameCount = 3000  # of the case rest
    # false: without the solver, which needs Taichi; collapse and rest are left out, slope and collision have limits of
    # their own
    solver: bool = True
    mpm: MpmConfig = field(default_factory=MpmConfig)  # the solver; its sand must be that of the network's data
    scene: SceneConfig = field(default_factory=SceneConfig)  # the scenes of the training


def main(mapping: dict[str, Any]) -> int:
    """Prints rows, and writes JSON if `json` is given. A case that fails is a finding: exit code 0."""
    started = time.monotonic()
    config = from_mapping(StabilityNetworkConfig, mapping)
    simulator = Simulator.load(config.weights, config.device, config.backend, config.precision)
    backend, info = simulator.backend, simulator.info
    print(backend.note, file=sys.stderr)
    meta = meta_of(config, simulator.device) | {"weights": Path(config.weights).name, "updates": info.updates}
    meta |= {"backend": backend.name, "precision": backend.precision, "network": to_mapping(info.network)}
    report = Report("network", meta, config.json)
    cases = cases_of(config, simulator)
    mpm = replace(config.mpm, device=simulator.device.type) if config.solver else None
    runner = Runner(simulator, cases, mpm)
    report.meta["seconds_before_cases"] = time.monotonic() - started
    for number, case in enumerate(cases, start=1):
        print(f"case {number} of {len(cases)}: {case.name}", file=sys.stderr, flush=True)
        report.add(runner.rows(case), case.brief)
    report.meta["seconds"] = time.monotonic() - started
    report.close()
    return 0


def cases_of(config: StabilityNetworkConfig, simulator: Simulator) -> list[Case]:
    """Returns all cases of the chosen families. Raises: ConfigError if a scene has too little space."""
    context = Context(
        config.scene, simulator.network.config, simulator.frame_rate_hz, config.frames, config.long_frames,
        config.solver,
    )  # fmt: skip
    wanted = config.cases or tuple(name for name in FAMILIES if name != PARAMETERS)
    cases = [case for name, family in FAMILIES.items() if name in wanted for case in family(context)]
    return cases + [case for name in wanted if is_gallery(name) for case in gallery_cases(name)]


class Runner:
    """Simulates cases with the network and the solver."""

    def __init__(self, simulator: Simulator, cases: Sequence[Case], mpm: MpmConfig | None) -> None:
        self.simulator, self.mpm = simulator, mpm
        self._upright: dict[int, list[RolloutResult]] = {}
        self._solved: dict[int, RolloutResult] = {}  # key: id of the scene
        self._to_solve: dict[tuple[int, Vector], dict[int, Scene]] = {}  # keys: frames and domain, then id
        for case in cases:
            for scene in (*(case.scenes if case.solver else ()), *case.upright, *case.nominal):
                self._to_solve.setdefault((case.frames, scene.domain_size), {})[id(scene)] = scene

    def rows(self, case: Case) -> list[Row]:
        """Returns one row, or for a scene of the gallery one row for each of its figures."""
        started, clock = time.monotonic(), FrameClock()
        try:
            initial = [InitialState.of_scene(scene) for scene in case.scenes]
            trials = simulate_scenes(self.simulator, initial, case.frames, clock)
        except ConfigError as refusal:
            return refused(case, str(refusal))
        if case.last_frames:
            trials = cut(trials, case.last_frames)
        solver, upright = None, None
        if case.solver:
            solver = Outcome(case, initial, self._solver(case.scenes, case.frames), self.simulator)
        if case.upright:
            upright = self._straight(case), self._solver(case.upright, case.frames)
        more: dict[str, Any] = {"seconds": time.monotonic() - started}
        more |= {"ms": clock.milliseconds()} if case.reported is None else {}
        outcome = Outcome(case, initial, trials, self.simulator, solver, upright)
        if case.parameter:
            nominal = Outcome(case, initial, self._solver(case.nominal, case.frames), self.simulator)
            return [parameter_row(outcome, nominal, more)]
        return gallery_rows(outcome, more) if case.gallery else [row_of(outcome, more)]

    def _straight(self, case: Case) -> list[RolloutResult]:
        if id(case.upright) not in self._upright:
            initial = [InitialState.of_scene(scene) for scene in case.upright]
            self._upright[id(case.upright)] = simulate_scenes(self.simulator, initial, case.frames)
        return self._upright[id(case.upright)]

    def _solver(self, scenes: Sequence[Scene], frames: int) -> list[RolloutResult]:
        """Returns the solver's trajectories. All cases' scenes with the same length and domain are in one launch."""
        for domain_size in dict.fromkeys(scene.domain_size for scene in scenes):
            if pending := self._to_solve.pop((frames, domain_size), {}):
                assert self.mpm is not None
                trials = solver_trials(list(pending.values()), self.mpm, frames, self.simulator.frame_rate_hz)
                self._solved |= dict(zip(pending, trials, strict=True))
        return [self._solved[id(scene)] for scene in scenes]


if __name__ == "__main__":
    run_command(main, "stability_network")
