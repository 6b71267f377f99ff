"""python -m tools.stability network weights=…: how long, how large, how fast and how far a network holds.

Closed forms come first: flight, gravity, collisions (network_motion.py), then rest and slopes beside the solver. A row
of the others has frames asked for, frames reached, and whether everything stayed finite, inside of the domain and
without energy from nowhere. Where a rollout fails, the runtime must have said so; a last case breaks a weight for that.
"""

from __future__ import annotations

import copy
import math
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from hgn.command import run_command
from hgn.config import MpmConfig, SceneConfig
from hgn.render.pictures import compare_picture, spread, stacked, write_picture
from hgn.runtime.rollouts import RolloutResult, simulate_scenes
from hgn.runtime.simulator import InitialState, Simulator
from hgn.scene.rollout_file import Rollout
from hgn.schema import from_mapping, to_mapping
from hgn.system.files import write_json
from hgn.system.machine import available_cpus
from hgn.system.progress import bar
from tools.measures import energies, energy_scale, neighbours, outside_domain
from tools.report import meta_of
from tools.solver_rollouts import kept_trials, solver_trials
from tools.stability.network_cases import CASES, Case, StabilityNetworkConfig, body, cases
from tools.stability.network_motion import motion_rows
from tools.stability.row import Row, table
from tools.timing import FrameClock

PICTURES, PICTURE_SIZE = 4, 300  # of each case; the width of one in pixels
LONGEST = 100.0  # domain that is drawn whole, in heights
DRAWN_EVERY_S = 5.0  # the picture of all cases so far, which takes longer with each
ENERGY_BOUND = 0.02  # how much energy may come from nowhere, of a fall through the domain
WAY_BOUND = 0.2  # how far off a known way may be
DENSITY_BOUND = 2.0  # times as many neighbours, or as few, may there be at rest after thousands of frames
DRIFT_FACTOR, DRIFT_CELLS = 2.0, 1.0  # of the solver's own drift at rest, and so many of its cells, may there be
# How far spread and mean height of what falls may be from the solver's. Its own differ by at most 2 % and 0.1 cells
# over three fillings, water's late spread by 9 %.
SPREAD_WITHIN, FALLEN_CELLS = 0.15, 0.5
# How much more or less than with the solver may pass a hole, of all particles. The solver's own shares differ by at
# most 0.012 over three fillings (holes of 1.5 R; of snow also 2 and 3). As much as a known way may be off: a hole that
# is closed, or that wrongly opens, is off by far more.
PASSED_WITHIN = 0.2
LEAKED_WITHIN = 0.05  # of all particles, beyond what leaks with the solver, may come through a funnel's sheets
HOLE_MARGIN_CELLS = 0.5  # of the solver, beyond a hole's edges, that still count as the hole: its sheets' band
PULLED_CELLS, PULLED_EVERY = 0.3, 5  # finest cells from a hole's edge is what is in it; frames that are asked
HEIGHT_CELLS = 0.1  # that the mean height at rest may differ from the solver's
STIR_FRAMES = 60  # the last ones, over which the squared speed at rest is averaged
# Of the solver's own squared speed about the mean at rest, and so many (domain units per second)^2, may there be: twice
# the standard deviation of its water's and its sand's over five fillings of 135 particles, frames 300 to 360.
STIR_FACTOR, STIR_FLOOR = 2.0, 5e-4
FAR_DOMAINS, GUARD_FRAMES = 100.0, 4  # how far the guard's case throws particles, in so many frames
ON_THE_FLOOR = 0.04  # times the height of a particle in the middle: 0.02 domain heights


def main(mapping: dict[str, Any]) -> int:
    """Prints a table, and writes JSON where asked to; what does not hold is a finding, and the exit code is 0."""
    begun = time.monotonic()
    config = from_mapping(StabilityNetworkConfig, mapping)
    simulator = Simulator.load(config.weights, config.device, config.backend, config.precision)
    network, device, backend, info = simulator.network.config, simulator.device, simulator.backend, simulator.info
    print(backend.note, file=sys.stderr)
    rows: list[Row] = []
    pictures: list[Image.Image] = []
    drawn = 0.0  # when the picture was last written
    weights, wanted = Path(config.weights).name, config.cases or CASES
    meta = meta_of(config, device) | {"weights": weights, "updates": info.updates, "backend": backend.name}
    meta["network"] = to_mapping(info.network)

    def keep(done: bool = False) -> None:  # a run that is cut off leaves the cases that it had
        nonlocal drawn
        if config.json is not None:
            write_json(config.json, {"meta": meta, "rows": [row.mapping("network") for row in rows]}, allow_nan=False)
        if config.picture is not None and pictures and (done or time.monotonic() - drawn > DRAWN_EVERY_S):
            write_picture(config.picture, stacked(pictures))
            drawn = time.monotonic()

    made = list(cases(config, network))
    solver = solver_of(config)
    with ThreadPoolExecutor(available_cpus()) as threads, ExitStack() as stack:
        # What the runtime makes of obstacles takes seconds where there are many: the largest cases first.
        order = sorted(made, key=lambda case: -sum(len(scene.obstacles) for scene in case.scenes))
        starts = {case.name: threads.submit(initial_states, case) for case in order}
        ahead = None
        if made and not backend.stepped:
            # Triton, which backend torch does without, is loaded here.
            from hgn.runtime.precompile import precompile_frames

            particles = [sum(len(scene.position_N3) for scene in case.scenes) for case in made]
            ahead = precompile_frames([network], [config.precision], device, particles)
        if ahead is not None:
            stack.enter_context(ahead)
        for row in motion_rows(simulator, config.scene, network.materials, wanted, config.scenes_at_once, solver):
            rows.append(row)
            keep()
        initial = {name: start.result() for name, start in starts.items()}  # nothing runs beside what is timed
        if ahead is not None:
            print(ahead.wait(), file=sys.stderr)
    meta["seconds_before_cases"] = time.monotonic() - begun
    beside = solver_beside(made, solver, simulator.frame_rate_hz, config.solver_kept) if solver is not None else {}
    late = late_kernels(backend.name)
    with bar("cases", total=len(made), unit="case") as progress:
        for case in made:
            started, growths, compiled, states = time.monotonic(), backend.growths, late(), initial[case.name]
            trials, milliseconds = case_trials(simulator, case, states, beside.get(case.name))
            row = case_row(simulator, case, states, trials, milliseconds, beside.get(case.name))
            if config.picture is not None:
                pictures.append(case_picture(simulator, case, trials[0], weights))
            row.more["growths"], row.more["kernels_compiled"] = backend.growths - growths, late() - compiled
            row.more["seconds"] = time.monotonic() - started
            rows.append(row)
            keep()
            progress.update()
    if "guard" in wanted:
        rows.append(guard_row(simulator, config.scene))
    meta["seconds"] = time.monotonic() - begun
    print(table(rows))
    keep(done=True)
    return 0


def solver_of(config: StabilityNetworkConfig) -> MpmConfig | None:
    """The solver that is asked, on its device; none where none is."""
    return replace(config.mpm, device=config.solver_device) if config.solver else None


def solver_beside(
    made: Sequence[Case], config: MpmConfig, frame_rate_hz: float, kept: str | None = None
) -> dict[str, list[RolloutResult]]:
    """The solver's trajectories of the cases that it stands beside, by name: as many at once as have one length; they
    are read and kept in a folder where one is given.
    """
    simulate = solver_trials if kept is None else partial(kept_trials, Path(kept))
    of_cases: dict[str, list[RolloutResult]] = {}
    for frames in sorted({case.frames for case in made if case.beside_solver}):
        some = [case for case in made if case.beside_solver and case.frames == frames]
        trials = iter(simulate([scene for case in some for scene in case.scenes], config, frames, frame_rate_hz))
        of_cases |= {case.name: [next(trials) for _ in case.scenes] for case in some}
    return of_cases


def late_kernels(backend: str) -> Callable[[], int]:
    """How many kernels were compiled in this process by now: each holds a simulation up for a second or more."""
    if backend != "triton":
        return lambda: 0
    from hgn.kernels.triton_compat import JitMisses

    late = JitMisses()
    return lambda: late.count


def initial_states(case: Case) -> list[InitialState]:
    return [InitialState.of_scene(scene) for scene in case.scenes]


def case_trials(
    simulator: Simulator, case: Case, initial: Sequence[InitialState], films: Sequence[RolloutResult] | None = None
) -> tuple[list[RolloutResult], float | None]:
    """Simulates a case, where it says so from a frame of the solver's `films` on, which then come before; the
    milliseconds of a frame too.
    """
    clock = FrameClock()
    if not case.begun:
        return simulate_scenes(simulator, initial, case.frames, clock), clock.milliseconds()
    assert films is not None
    states = [in_film(scene, film, case.begun) for scene, film in zip(initial, films, strict=True)]
    trials = simulate_scenes(simulator, states, case.frames - case.begun, clock)
    joined = [
        replace(trial, position_TN3=np.concatenate([film.position_TN3[: case.begun], trial.position_TN3]))
        for trial, film in zip(trials, films, strict=True)
    ]
    return joined, clock.milliseconds()


def in_film(scene: InitialState, film: RolloutResult, frame: int) -> InitialState:
    """A frame of a scene's film, with all before it as its past."""
    return replace(scene, position_N3=film.position_TN3[frame], past_HN3=film.position_TN3[:frame])


def case_picture(simulator: Simulator, case: Case, trial: RolloutResult, weights: str) -> Image.Image:
    """Some frames of a case's first scene. Of a domain that is long beyond all others, which would leave a line, only
    the end is drawn, where the particles are.
    """
    scene, (length, height, depth) = case.scenes[0], case.scenes[0].domain_size
    shift_3 = np.array([length - height if length > LONGEST * height else 0.0, 0.0, 0.0])
    rollout = Rollout(
        (trial.position_TN3 - shift_3).astype(np.float32),
        scene.material_N,
        tuple(replace(mesh, vertex_V3=mesh.vertex_V3 - shift_3) for mesh in scene.obstacles),
        (length - float(shift_3[0]), height, depth),
        simulator.frame_rate_hz,
        source={"weights": weights},
    )
    return compare_picture(rollout, spread(trial.frame_count, PICTURES), PICTURE_SIZE, case.name)


def case_row(
    simulator: Simulator,
    case: Case,
    initial: Sequence[InitialState],
    trials: Sequence[RolloutResult],
    milliseconds: float | None,
    beside: Sequence[RolloutResult] | None = None,
) -> Row:
    """Says whether a case held; `beside` is what the solver makes of it."""
    rate, pairs = simulator.frame_rate_hz, list(zip(trials, initial, strict=True))
    finite = all(bool(np.isfinite(trial.position_TN3).all()) for trial in trials)
    growth = max(energy_growth(trial, scene, rate) for trial, scene in pairs)
    outside = max(outside_domain(trial.position_TN3[-1], scene.domain_size) for trial, scene in pairs)
    causes = [trial.cause for trial in trials if trial.cause is not None]

    def came(some: Sequence[RolloutResult]) -> float:
        return min(share_of_way(*pair, rate, case) for pair in zip(some, initial, strict=True))

    way = came(trials) if case.known_3 is not None else None
    more: dict[str, Any] = {"solver_share_of_way": came(beside)} if beside and way is not None else {}
    restless = None
    if case.spread_at and beside is not None:
        fallen, solvers_fallen = (collapse(some, initial, case.spread_at) for some in (trials, beside))
        more |= {"collapse": fallen, "solver_collapse": solvers_fallen}
        restless = misfallen(fallen, solvers_fallen)
    if case.hole_cells and beside is not None:
        cell_size = simulator.network.config.cell_size
        passed, solvers_passed = (passing(some, initial, case, cell_size) for some in (trials, beside))
        more |= {"passed": passed, "solver_passed": solvers_passed}
        more |= dict(zip(("pull", "solver_pull"), pulled(simulator, initial, beside, case), strict=True))
        restless = mispassed(passed, solvers_passed)
    if case.settled is not None and beside is not None:
        own, solvers = (at_rest(some, initial, case.settled, simulator.frame_rate_hz) for some in (trials, beside))
        more |= {"rest": own, "solver_rest": solvers}
        restless = unrest(own, solvers)
    beyond = None
    if causes:
        beyond = causes[0]
    elif not finite:
        beyond = "positions are not finite, and the runtime did not say so"
    elif growth > ENERGY_BOUND:
        beyond = f"energy grows by {growth:.2g} of a fall through the domain"
    elif way is not None and abs(way - 1) > WAY_BOUND:
        beyond = f"comes {100 * way:.2g} % of its way in the first {case.known_frames} frames"
    elif restless:
        beyond = restless
    elif outside:
        beyond = f"{100 * outside:.2g} % of the particles end outside of the domain"
    more = {
        "particles": sum(len(scene.position_N3) for scene in initial),
        "scenes": len(initial),
        "domain_size": list(initial[0].domain_size),
        "energy_growth": growth if math.isfinite(growth) else None,
        "outside_domain": outside,
        "share_of_way": way,
        "failed_scenes": len(causes),
        "guard": "missed" if not finite else "raised" if causes else "not needed",
        "ms": milliseconds,
    } | more
    reached = min(trial.frame_count for trial in trials)
    return Row(case.name, case.frames, reached, beyond is None, beyond or "nothing seen", more)


def energy_growth(trial: RolloutResult, scene: InitialState, frame_rate_hz: float) -> float:
    """The most that kinetic and potential energy exceed those at the start, of a fall through the domain."""
    if trial.frame_count < 2:
        return 0.0
    gravity_3 = np.asarray(scene.gravity, np.float64) / frame_rate_hz**2
    energy_T = energies(trial.position_TN3, gravity_3)
    speed_N3 = scene.velocity_N3 / frame_rate_hz
    start = float((0.5 * (speed_N3**2).sum(-1) - trial.position_TN3[0].astype(np.float64) @ gravity_3).mean())
    return max(0.0, float(energy_T.max()) - start) / energy_scale(gravity_3, scene.domain_size)


def share_of_way(trial: RolloutResult, scene: InitialState, frame_rate_hz: float, case: Case) -> float:
    """How far the particles came in the frames whose acceleration a case knows, of the way of the closed form."""
    last = min(case.known_frames, trial.frame_count - 1)
    known_3, seconds = np.asarray(case.known_3, np.float64), last / frame_rate_hz
    if not last or not known_3.any():
        return 1.0
    moved_N3 = trial.position_TN3[last].astype(np.float64) - trial.position_TN3[0] - seconds * scene.velocity_N3
    return float((moved_N3 @ known_3).mean() / (0.5 * seconds**2 * (known_3 @ known_3)))


def collapse(
    trials: Sequence[RolloutResult], scenes: Sequence[InitialState], frames: Sequence[int]
) -> list[dict[str, float]] | None:
    """Of each scene in some frames, in obstacle cells: how far particles have spread along x and z (root mean square
    about their mean), and their mean height. None where a rollout ended early.
    """
    if any(trial.frame_count <= frames[-1] or trial.cause is not None for trial in trials):
        return None
    rows: list[dict[str, float]] = []
    for number, (trial, scene) in enumerate(zip(trials, scenes, strict=True)):
        for frame in frames:
            place_N3 = trial.position_TN3[frame].astype(np.float64) / scene.obstacle_grid.cell_size
            spread = float(np.sqrt(0.5 * place_N3[:, [0, 2]].var(axis=0).sum()))
            rows.append({"scene": number, "frame": frame, "spread": spread, "height": float(place_N3[:, 1].mean())})
    return rows


def misfallen(own: list[dict[str, float]] | None, solvers: list[dict[str, float]] | None) -> str | None:
    """The first spread or height that is beyond its bound beside the solver's; none where all hold."""
    if own is None or solvers is None:
        return f"the {'solver' if solvers is None else 'network'} did not come to the end"
    for row, solver in zip(own, solvers, strict=True):
        place = f"in frame {row['frame']} of scene {row['scene']}"
        if not abs(row["spread"] / solver["spread"] - 1) <= SPREAD_WITHIN:
            return f"spreads by {row['spread']:.2f} cells {place}, the solver {solver['spread']:.2f}"
        if not abs(row["height"] - solver["height"]) <= FALLEN_CELLS:
            return f"lies {row['height']:.2f} cells high {place}, the solver's {solver['height']:.2f}"
    return None


def passing(
    trials: Sequence[RolloutResult], scenes: Sequence[InitialState], case: Case, cell_size: float
) -> list[dict[str, float]] | None:
    """Of each scene, the shares of its particles that are below the edge of its hole at last: those that came through
    the hole, and those that leaked elsewhere, by where they first crossed that height, straight from frame to frame.
    `cell_size` is the network's finest. None where a rollout ended early.
    """
    if any(trial.frame_count < case.frames or trial.cause is not None for trial in trials):
        return None
    rows: list[dict[str, float]] = []
    for cells, trial, scene in zip(case.hole_cells, trials, scenes, strict=True):
        below_TN = trial.position_TN3[..., 1] < case.hole_height
        passed_N = np.flatnonzero(below_TN[-1])
        crossed_N = below_TN[:, passed_N].argmax(axis=0)
        before_N3, after_N3 = (trial.position_TN3[crossed_N - i, passed_N].astype(np.float64) for i in (1, 0))
        way_N1 = (case.hole_height - before_N3[:, 1:2]) / (after_N3 - before_N3)[:, 1:2]
        aside_N3 = np.abs(before_N3 + way_N1 * (after_N3 - before_N3) - 0.5 * np.array(scene.domain_size))
        half = 0.5 * cells * cell_size + HOLE_MARGIN_CELLS * scene.obstacle_grid.cell_size
        within_N = (aside_N3[:, [0, 2]] <= half).all(axis=1)
        through, leaked = (float(some_N.sum() / below_TN.shape[1]) for some_N in (within_N, ~within_N))
        rows.append({"hole_cells": cells, "through": through, "leaked": leaked})
    return rows


def pulled(
    simulator: Simulator, scenes: Sequence[InitialState], films: Sequence[RolloutResult], case: Case
) -> tuple[list[float | None], list[float | None]]:
    """Of each scene, the mean acceleration along gravity, in gravities, of what is in its hole in the solver's `films`:
    what the network makes of these states, a frame each, and what followed. None where nothing is there. A rollout
    passes a hole or is stuck by little; this says by how much.
    """
    history, reach = simulator.network.config.velocity_history, PULLED_CELLS * simulator.network.config.cell_size
    own: list[float | None] = []
    true: list[float | None] = []
    for cells, scene, film in zip(case.hole_cells, scenes, films, strict=True):
        position_TN3 = torch.from_numpy(film.position_TN3).to(simulator.device)
        aside_TN3 = (position_TN3 - 0.5 * torch.tensor(scene.domain_size).to(position_TN3)).abs()
        within_TN = (aside_TN3[..., [0, 2]] <= 0.5 * cells * simulator.network.config.cell_size).all(-1)
        within_TN &= (position_TN3[..., 1] - case.hole_height).abs() <= reach
        pulls: list[torch.Tensor] = []
        for frame in range(history, len(position_TN3) - 1, PULLED_EVERY):
            within_N = within_TN[frame]
            if not bool(within_N.any()):
                continue
            state = simulator.start([in_film(scene, film, frame)])
            nexts = torch.stack([simulator.step(state).position_N3, position_TN3[frame + 1]])
            change_2N = (nexts - state.position_N3 - state.velocity_NM3[:, 0])[..., 1]
            pulls.append(change_2N[:, within_N].double())
        gravity = scene.gravity[1] / simulator.frame_rate_hz**2
        for side, means in enumerate((own, true)):
            means.append(float(torch.cat(pulls, dim=1)[side].mean()) / gravity if pulls else None)
    return own, true


def mispassed(own: list[dict[str, float]] | None, solvers: list[dict[str, float]] | None) -> str | None:
    """The hole that is farthest off the solver's or leaks most, where that is beyond its bound; none where all hold."""
    if own is None or solvers is None:
        return f"the {'solver' if solvers is None else 'network'} did not come to the end"
    farthest, solver = max(
        zip(own, solvers, strict=True), key=lambda pair: abs(pair[0]["through"] - pair[1]["through"])
    )
    if not abs(farthest["through"] - solver["through"]) <= PASSED_WITHIN:
        own_percent, solver_percent = (f"{100 * row['through']:.0f} %" for row in (farthest, solver))
        return f"lets {own_percent} through a hole of {farthest['hole_cells']:g} R, the solver {solver_percent}"
    leaky, solver = max(zip(own, solvers, strict=True), key=lambda pair: pair[0]["leaked"] - pair[1]["leaked"])
    if not leaky["leaked"] - solver["leaked"] <= LEAKED_WITHIN:
        own_percent, solver_percent = (f"{100 * row['leaked']:.0f} %" for row in (leaky, solver))
        return f"leaks {own_percent} beside a hole of {leaky['hole_cells']:g} R, the solver {solver_percent}"
    return None


def at_rest(
    trials: Sequence[RolloutResult], scenes: Sequence[InitialState], settled: int, frame_rate_hz: float
) -> dict[str, float] | None:
    """Of all scenes, in obstacle cells: how far particles moved since frame `settled` (root mean square), their mean
    heights then and at last, and the neighbours within a cell at last, of those then. And the mean squared speed about
    each scene's mean in its last STIR_FRAMES, (domain units per second)^2: what stirs, not what slides in common. None
    where a rollout ended early.
    """
    if any(trial.frame_count <= settled or trial.cause is not None for trial in trials):
        return None
    moved, heights, counts, speeds = [], [], [], []
    for trial, scene in zip(trials, scenes, strict=True):
        cell = scene.obstacle_grid.cell_size
        velocity_TN3 = frame_rate_hz * np.diff(trial.position_TN3[-STIR_FRAMES - 1 :].astype(np.float64), axis=0)
        speeds.append(np.square(velocity_TN3 - velocity_TN3.mean(axis=1, keepdims=True)).sum(axis=-1).mean(axis=0))
        pair_2N3 = trial.position_TN3[[settled, -1]].astype(np.float64) / cell
        moved.append(np.square(pair_2N3[1] - pair_2N3[0]).sum(axis=1))
        heights.append(pair_2N3[..., 1])
        counts.append([neighbours(place_N3, 1.0) * len(place_N3) for place_N3 in pair_2N3])
    before, after = np.concatenate(heights, axis=1).mean(axis=1)
    first, last = np.sum(counts, axis=0)
    return {
        "drift": float(np.sqrt(np.concatenate(moved).mean())),
        "height_before": float(before),
        "height": float(after),
        "density": float(last / max(first, 1.0)),
        "squared_speed": float(np.concatenate(speeds).mean()),
    }


def unrest(own: dict[str, float] | None, solvers: dict[str, float] | None) -> str | None:
    """What of drift, density, height and stirring is beyond its bound beside the solver's; none where all hold."""
    if own is None or solvers is None:
        return f"the {'solver' if solvers is None else 'network'} did not come to the end"
    drift = DRIFT_FACTOR * solvers["drift"] + DRIFT_CELLS
    if not own["drift"] <= drift:
        return f"moves {own['drift']:.2f} cells at rest, the solver {solvers['drift']:.2f}"
    if not 1 / DENSITY_BOUND <= own["density"] <= DENSITY_BOUND:
        return f"has {own['density']:.2g} times the neighbours that it had when it came to rest"
    if not abs(own["height"] - solvers["height"]) <= HEIGHT_CELLS:
        return f"lies {own['height']:.2f} cells high, the solver's {solvers['height']:.2f}"
    if not own["squared_speed"] <= STIR_FACTOR * solvers["squared_speed"] + STIR_FLOOR:
        return f"stirs at {own['squared_speed']:.2g} squared a second, the solver at {solvers['squared_speed']:.2g}"
    return None


def guard_row(simulator: Simulator, config: SceneConfig) -> Row:
    """A network with a weight that explodes: the runtime must stop at the first frame.

    Its particles lie on the floor: with relative inputs nothing comes of a weight in free flight.
    """
    broken = copy.deepcopy(simulator.network)
    with torch.no_grad():
        # Not NaN: backends that are compared with each other before they run could not agree on that. Upwards: with
        # relative inputs nothing comes of it along the floor.
        thrown = FAR_DOMAINS * max(config.domain_size) / broken.normaliser.acceleration_std[1]
        dict(broken.named_parameters())["decode.second.bias"][1] = thrown
    floor_13 = 0.5 * np.array([config.domain_size]) * (1.0, ON_THE_FLOOR, 1.0)
    materials = [name for name in config.materials if name in broken.config.materials]
    scenes = [InitialState.of_scene(body(config, material, floor_13, np.zeros(3))) for material in materials]
    sabotaged = Simulator(broken, simulator.frame_rate_hz, simulator.backend.name, simulator.backend.precision)
    trials = simulate_scenes(sabotaged, scenes, GUARD_FRAMES)
    caught = all(trial.cause is not None and trial.frame_count == 1 for trial in trials)
    beyond = next((trial.cause for trial in trials if trial.cause is not None), "the runtime did not say so")
    frames = max(trial.frame_count for trial in trials)
    return Row("a weight that explodes", 1, frames, caught, beyond, {"guard": "raised" if caught else "missed"})


if __name__ == "__main__":
    run_command(main, "stability_network")
