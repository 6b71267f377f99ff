"""Simulates batches of scenes: MLS-MPM with water, sand, snow, elastic solids and mesh obstacles, on a CPU or a GPU.

The method is the paper's simulator, Taichi Elements, with the corrections that hgn.solver_method lists.
Shape legend: T frames, N particles of a scene, B scenes.
"""

import contextlib
import gc
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from datagen.mpm.body import require_slow
from datagen.mpm.collider import Collider, build_collider
from datagen.mpm.device import Device, initialise, memory_bytes
from datagen.mpm.grid_launch import GridLaunch
from datagen.mpm.launch import Launch, SceneFailure, Simulated, fixed_substeps, no_counters, particle_bounds
from datagen.mpm.team_launch import MAXIMUM_PARTICLES, SHARED_BLOCKS, BlocksApartError, Team, TeamLaunch
from hgn.config import MpmConfig, SceneConfig
from hgn.scene.emission import at_entry, require_free_entries
from hgn.scene.random_scene import generate_scene
from hgn.scene.scene import Scene, whole_cells
from hgn.schema import ConfigError, require

# Number of thread blocks that run on a processor concurrently. Taichi compiles kernels for two blocks of any size: a
# thread has 64 registers with 512 threads per block, 128 with 256, and 255 with 128.
GPU_BLOCKS = 2
TEAM_THREADS, TEAM_BLOCKS, TEAM_RUN = 256, 3, 4  # for many scenes, which teams compute in turn
EVEN = 0.95  # one block per scene above this fraction of filled turns and this mean / largest particle count
SHARED_THREADS = 128  # threads of a block of a few scenes
SHARED_PARTICLES = 8  # fewest particles of such a block
LARGE_PARTICLES = 4096  # particles per processor above which a scene's blocks are as large as those of many scenes
# Largest number of random scenes in a warm-up. Some kinds of scenes have bodies or obstacles that others lack, and all
# of them choose the kernels of a launch. Without kinds few scenes contain all materials and an obstacle.
WARM_SCENES, WARM_SCENES_OF_KINDS = 4, 16
WARM_PARTICLES = 200_000  # particles above which a warm-up has no further scenes
USUAL_PARTICLES = 4_000  # number of particles in a random scene
ROUNDING = 2e-6  # largest distance of a particle from the bounds of coordinates, as a fraction of the upper one
PARTICLE_BYTES, NODE_BYTES = 340, 50  # memory of a launch's arrays

__all__ = [
    "SceneFailure",
    "Simulated",
    "Team",
    "fixed_substeps",
    "initialise",
    "particle_bounds",
    "simulate",
    "warm_up",
]


def simulate(
    scenes: Sequence[Scene],
    config: MpmConfig,
    frames: int,
    frame_rate_hz: float,
    on_frame: Callable[[int], None] | None = None,
    cpu_threads: int | None = None,
    colliders: Sequence[Collider] | None = None,
    team: Team | None = None,
    stability_fractions: Sequence[float] | None = None,
    children: int = 1,
    trajectories: Sequence[np.ndarray] | None = None,
) -> list[Simulated | SceneFailure]:
    """Simulates `scenes` together, and returns `frames` frames of each, the initial state included.

    Scenes may differ in everything but their cell size. The largest domain determines each scene's memory.
    docs/concepts/solver.md has the rules for substeps and transfers. With a fixed time step each substep has a
    transfer. A frame then has ceil(frame / step) substeps, as in Taichi Elements: 54 at 60 Hz and 3.125e-4 s, which are
    1.25 % longer than the frame.

    Scenes with emitters are simulated after the others, in a launch of their own. `on_frame(t)` is called from 0 on
    when the scenes have completed frame t, on average over the scenes if there are two launches.
    `trajectories` are arrays for the frames of each scene, which contain frame t of a single scene in `on_frame(t)`.
    `cpu_threads` applies to the process's first simulation (see `initialise`). `colliders` are results of
    `build_collider` for the scenes; None: they are built. `team` computes a scene of the first launch; None: it is
    chosen by device and scenes. `stability_fractions` replace the config's. Results contain the first of each
    `children` particles (see datagen.fine); counters include all particles.

    On a CPU a scene's result does not depend on its batch, bitwise. `cpu_threads` changes it only through the number of
    partial sums, min(cpu_threads, 4). On a GPU sums have no fixed order.

    A particle with an entry time is NaN before it; it then enters in free flight from its given position. A scene that
    is not finite, leaves the domain or needs more than MAXIMUM_SUBSTEPS per frame ends as a SceneFailure with cause and
    frame. The result of a scene without particles has shape [frames, 0, 3].

    Raises: ConfigError for scenes that do not share a grid, particles outside the walls, obstacles that are not finite,
    fewer than one frame, or a missing device.
    """
    require(frames >= 1, "frames", "at least 1", frames)
    require(frame_rate_hz > 0 and math.isfinite(frame_rate_hz), "frame_rate_hz", "a finite number > 0", frame_rate_hz)
    if not scenes:
        return []
    node_counts = _largest_grid(scenes, config)
    given, scenes = scenes, [at_entry(scene, frame_rate_hz) for scene in scenes]
    for scene, entered in zip(given, scenes, strict=True):
        require_free_entries(scene, entered)
    scenes = [_between_walls(scene, index, *particle_bounds(scene, config)) for index, scene in enumerate(scenes)]
    if colliders is None:
        colliders = [build_collider(scene, config.choices.collider_band_cells) for scene in scenes]
    require(len(colliders) == len(scenes), "colliders", f"one for each of {len(scenes)} scenes", len(colliders))
    fractions = [config.stability_fraction] * len(scenes) if stability_fractions is None else list(stability_fractions)
    require(len(fractions) == len(scenes), "stability_fractions", f"one for each of {len(scenes)} scenes", fractions)
    for index, fraction in enumerate(fractions):
        require(0 < fraction <= 1, f"stability_fractions[{index}]", "above 0 and at most 1", fraction)

    device = initialise(config.device, cpu_threads)
    occupied = [index for index, scene in enumerate(scenes) if scene.particle_count]
    if trajectories is None:
        counts = [len(range(0, scene.particle_count, children)) for scene in scenes]
        trajectories = [np.empty((frames, count, 3), np.float32) for count in counts]
    results: list[Simulated | SceneFailure] = [Simulated(path_TN3, no_counters()) for path_TN3 in trajectories]
    step_s = config.fixed_time_step_s
    moving = any(scenes[i].moves for i in occupied)
    require_slow(scenes, frame_rate_hz)
    require(not moving or step_s is None, "fixed_time_step_s", "null if obstacles move", step_s)
    _require_memory(device, [scenes[i] for i in occupied], node_counts)
    single = [i for i in occupied if scenes[i].emits]  # particles enter between launches of single substeps
    groups = [group for group in ([i for i in occupied if i not in single], single) if group]
    before = reported = 0  # frames of all scenes of earlier launches together; calls of on_frame

    def report(frame: int) -> None:
        nonlocal reported
        while on_frame is not None and (reported + 1) * len(occupied) <= before + (frame + 1) * len(group):
            on_frame(reported)
            reported += 1

    for group in groups:
        batch = (
            [scenes[i] for i in group], [colliders[i] for i in group], config, node_counts, frame_rate_hz,
            [fractions[i] for i in group],
        )  # fmt: skip
        own_team = Team(0) if group is single else team or _team(device, [scene.particle_count for scene in batch[0]])
        outcomes = _launched(device, own_team, batch, [trajectories[i] for i in group], report, children)
        for index, outcome in zip(group, outcomes, strict=True):
            results[index] = outcome
        before += frames * len(group)
    if on_frame is not None and not groups:
        for frame in range(frames):
            on_frame(frame)
    return results


def _launched(
    device: Device,
    team: Team,
    batch: tuple[Any, ...],
    paths: Sequence[np.ndarray],
    on_frame: Callable[[int], None],
    children: int,
) -> list[Simulated | SceneFailure]:
    with _arrays_freed_here():
        if team.threads:
            try:
                return _run(TeamLaunch(team, _teams_at_once(device, team), *batch), paths, on_frame, children)
            except BlocksApartError:
                warnings.warn(
                    f"the {device.kind} does not run the {team.blocks} blocks of {team.threads} threads of a scene "
                    "concurrently, so each substep is a separate launch, which is slower; end other programs on the "
                    "device", RuntimeWarning, stacklevel=3,
                )  # fmt: skip
        return _run(GridLaunch(device, *batch), paths, on_frame, children)


def _run(
    launch: Launch, paths: Sequence[np.ndarray], on_frame: Callable[[int], None], children: int
) -> list[Simulated | SceneFailure]:
    try:
        return launch.run(paths, on_frame, children)
    finally:
        launch.release()


@contextlib.contextmanager
def _arrays_freed_here() -> Iterator[None]:
    """Collects garbage in this thread only.

    Taichi's copies leave arrays in reference cycles, which are freed by the thread that happens to collect garbage. A
    thread without CUDA context would end the process.
    """
    automatic = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        gc.collect(1)  # all garbage of this call; generation 2 is older, and takes a third of a second with torch
        if automatic:
            gc.enable()


def warm_up(scene: SceneConfig, config: MpmConfig, scenes: int) -> None:
    """Starts a GPU and compiles the kernels for a launch of `scenes` random scenes. Does nothing on a CPU.

    Simulates other random scenes of these settings, because a launch's materials and obstacles choose its kernels.
    """
    device = initialise(config.device)
    if device.kind == "cpu":
        return
    drawn: list[Scene] = []
    for seed in range(min(scenes, WARM_SCENES_OF_KINDS if scene.kinds else WARM_SCENES)):
        with contextlib.suppress(ConfigError):  # an obstacle may not fit; makers report such scenes
            drawn.append(generate_scene(scene, seed))
        if sum(one.particle_count for one in drawn) > WARM_PARTICLES:
            break
    simulate(
        drawn,
        config,
        2,
        60.0,
        team=_team(device, [*[USUAL_PARTICLES] * (scenes - 1), 2 * USUAL_PARTICLES]),
    )


def _team(device: Device, counts: Sequence[int]) -> Team:
    """Returns the team that is expected to compute scenes with these particle counts fastest."""
    scenes, most = len(counts), max(counts)
    if device.kind == "cpu" or most > MAXIMUM_PARTICLES:
        return Team(0)
    share = device.processors // scenes
    if share > 1 and most > LARGE_PARTICLES * share:
        return Team(TEAM_THREADS, GPU_BLOCKS * share)
    room = _blocks_at_once(device)
    blocks = min(room // scenes, -(-most // SHARED_PARTICLES))
    if blocks >= SHARED_BLOCKS:
        # with at most one particle per thread, sums over runs of particles are not faster
        return Team(SHARED_THREADS, blocks, 1) if most <= SHARED_THREADS * blocks else Team(SHARED_THREADS, blocks)
    rounds = -(-scenes // room)
    if scenes > EVEN * rounds * room and sum(counts) > EVEN * scenes * most:
        return Team(TEAM_THREADS)  # all scenes end at about the same time
    # a launch lasts as long as its longest scene: a larger team computes it sooner, a smaller team waits less
    return Team(TEAM_THREADS, max(blocks, TEAM_BLOCKS), TEAM_RUN)


def _blocks_at_once(device: Device) -> int:
    return device.threads if device.kind == "cpu" else GPU_BLOCKS * device.processors


def _teams_at_once(device: Device, team: Team) -> int:
    """Returns the number of teams that run concurrently. Blocks of a team wait for each other."""
    room = _blocks_at_once(device)
    require(team.blocks <= room, "team.blocks", f"at most {room}, which can run concurrently", team.blocks)
    return room // team.blocks


def _largest_grid(scenes: Sequence[Scene], config: MpmConfig) -> tuple[int, int, int]:
    """Returns the largest number of cells along each axis. Raises: ConfigError for other cells, or a small domain."""
    first, largest = scenes[0], (0, 0, 0)
    smallest = 2 * config.wall_cells + 2
    for index, scene in enumerate(scenes):
        if scene.cell_size != first.cell_size:
            raise ConfigError(
                f"cell_size must be the same in all scenes of a batch, got {scene.cell_size} in scene {index} and "
                f"{first.cell_size} in scene 0; simulate them separately"
            )
        counts = whole_cells(scene.domain_size, scene.cell_size)
        for axis, length, cells in zip("xyz", scene.domain_size, counts, strict=True):
            rule = f"at least {smallest} cells: the walls, and two between them"
            require(cells >= smallest, f"domain_size ({axis})", rule, length)
        x, y, z = (max(pair) for pair in zip(largest, counts, strict=True))
        largest = (x, y, z)
    return largest


def _require_memory(device: Device, scenes: Sequence[Scene], node_counts: tuple[int, int, int]) -> None:
    particles, nodes = sum(scene.particle_count for scene in scenes), len(scenes) * math.prod(node_counts)
    needed, memory = PARTICLE_BYTES * particles + NODE_BYTES * nodes, memory_bytes(device)
    require(
        needed <= memory,
        "a batch",
        f"such that its particles and nodes fit in the {device.kind}'s memory of {memory / 1e9:.3g} GB",
        f"{needed / 1e9:.3g} GB for {particles} particles and {nodes} nodes of {len(scenes)} scenes",
        "lower mpm.scenes_per_launch or dataset.reference_cells, or simulate fewer particles",
    )


def _between_walls(scene: Scene, index: int, low: np.ndarray, high: np.ndarray) -> Scene:
    """Returns the scene. Particles a rounding outside of the bounds, where networks stop them, are moved onto these."""
    position = np.asarray(scene.position_N3, np.float32)
    nearest = position.clip(low, high)
    outside = np.flatnonzero(~(np.abs(position - nearest) <= ROUNDING * high).all(axis=1))
    if len(outside):
        raise ConfigError(
            f"position_N3 of scene {index} must lie within the walls, {low.tolist()} to {high.tolist()}, got "
            f"{position[outside[0]].tolist()} for particle {outside[0]} ({len(outside)} such particles); "
            "move the particles inwards or enlarge domain_size"
        )
    return scene if (nearest == position).all() else replace(scene, position_N3=nearest)
