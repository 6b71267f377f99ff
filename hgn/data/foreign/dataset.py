"""Imports a set of trajectories as a data set: shards are written first, then the index, and the manifest last."""

import hashlib
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from hgn.data.entries import SPLITS, EpisodeEntry, ShardEntry
from hgn.data.foreign.episodes import Converter, obstacle_cell_size
from hgn.data.foreign.formats import find_format, read_split, set_info
from hgn.data.foreign.gravity import estimate_gravity
from hgn.data.foreign.settings import ImportConfig
from hgn.data.foreign.trajectory import SetInfo, Trajectory, require_inside
from hgn.data.identity import identity_hash
from hgn.data.manifest import MANIFEST_NAME, Manifest
from hgn.data.shard import episode_tar, locate_members, tar_end
from hgn.data.statistics import Statistics, episode_statistics
from hgn.data.verification import file_sha256
from hgn.scene.episode import SCHEMA_VERSION, Episode
from hgn.schema import ConfigError, require
from hgn.system.files import make_folder, sync_file, sync_folder, temporary_file

SHARD_BYTES = 128 << 20  # a shard ends with the episode that reaches this size
LOOKED_AT = 4  # number of trajectories that give estimates of gravity, neighbours and the boundary particles' spacing
USUAL_NEIGHBOURS = 15  # published sets have about 10 to 20
WIDEST = 100  # largest width of the box, in widths of the region that particles visit
MOST_NEIGHBOURS = 1000  # mean number; this project's data, with 8 particles per solver cell, have at most 400


def import_set(
    source: Path, config: ImportConfig, progress: Callable[[Episode], Any] = lambda _: None
) -> tuple[Manifest, float, str | None]:
    """Reads the trajectories of a folder and writes them as a data set. Calls `progress` for each episode.

    Returns the manifest, the mean number of neighbours, and a warning about trajectories that leave their bounds, or
    None. The manifest is written last, so an interrupted import can be started again.
    Raises: ConfigError naming the file and field that cannot be read; OSError.
    """
    out = Path(config.out)
    require(not (out / MANIFEST_NAME).exists(), "out", "a new folder", config.out, "this one contains a data set")
    info = set_info(source, find_format(source), config)
    first = list(itertools.islice(read_split(source, "train", info), LOOKED_AT))
    require(bool(first), "from", f"a folder with training trajectories ({info.format})", str(source))
    for trajectory in first:
        require_inside(trajectory, info)
    if config.bounds is None:
        _require_narrow(first, info)
    gravity = _gravity(first, info, known=config.gravity is not None)
    neighbours = _neighbour_count(first, info)
    still = [points for points in (_boundary(trajectory, info) for trajectory in first) if len(points)]
    converter = Converter(info, gravity, config.history, obstacle_cell_size(info, still))
    del first, still
    is_new = not out.exists()
    make_folder(out)
    shards: list[ShardEntry] = []
    try:
        for split in SPLITS:
            episodes = (
                converter.episode(trajectory, f"{split}-{index:06d}", index)
                for index, trajectory in enumerate(read_split(source, split, info))
            )
            shards += _shards(out, split, episodes, progress)
    except ConfigError:
        if is_new and not any(out.iterdir()):
            out.rmdir()
        raise
    identity = {
        "schema_version": SCHEMA_VERSION,
        "imported": {
            "format": info.format,
            "dimensions": info.dimensions,
            "radius": info.radius,
            "history": config.history,
            "domain_size": list(converter.domain_size),
            "obstacle_cell_size": converter.obstacle_cell_size,
            "obstacles": converter.with_obstacles,
            "materials": [name for name in converter.materials if name in converter.present],
            "gravity": list((*gravity, 0.0)[:3]),
            "several_gravities": len(converter.gravities) > 1,
            "maximum_initial_speed": converter.maximum_initial_speed,
            "content": hashlib.sha256("".join(shard.sha256 for shard in shards).encode()).hexdigest(),
        },
        "frame_rate_hz": 1 / info.frame_dt_s,
        "seed": 0,
    }
    requested = {split: sum(len(shard.episodes) for shard in shards if shard.split == split) for split in SPLITS}
    manifest = Manifest(identity_hash(identity), identity, requested, len(shards)).save(out, shards)
    return manifest, neighbours, converter.note_on_bounds(sum(requested.values()))


def _require_narrow(first: list[Trajectory], info: SetInfo) -> None:
    """Raises ConfigError for bounds that are much wider than the paths of more than a few particles."""
    paths = [t.position_TND.reshape(-1, info.dimensions) for t in first if t.position_TND.shape[1] > USUAL_NEIGHBOURS]
    if not paths:
        return
    paths_D2 = np.stack([np.min([path.min(0) for path in paths], 0), np.max([path.max(0) for path in paths], 0)], -1)
    fits = WIDEST * np.ptp(paths_D2, axis=1).max() >= np.ptp(info.bounds, axis=1).max()
    rule, bounds = f"at most {WIDEST} times as wide as the particles' paths", [list(pair) for pair in info.bounds]
    require(fits, "bounds", rule, bounds, f"paths are in {paths_D2.round(4).tolist()}; to use these, give bounds=…")


def _gravity(first: list[Trajectory], info: SetInfo, known: bool) -> tuple[float, ...]:
    """Returns the gravity of the set, or that of the first trajectory, or else an estimate.

    Raises: ConfigError if particles in free flight contradict it, unless it is `known` from the settings.
    """
    stored = [gravity for trajectory in first if (gravity := trajectory.gravity or info.gravity)]
    if len(stored) < len(first):
        return _estimated([trajectory for trajectory in first if trajectory.gravity is None], info)
    for trajectory, gravity in zip(first, stored, strict=True):
        stored_3 = np.array(gravity)
        if known or not stored_3.any():
            continue
        try:
            estimated_3 = np.array(_estimated([trajectory], info))
        except ConfigError:  # too few particles are in free flight
            continue
        if np.linalg.norm(estimated_3 - stored_3) > 0.1 * np.linalg.norm(stored_3):
            estimated = [float(f"{value:.3g}") for value in estimated_3]
            raise ConfigError(
                f"{trajectory.name}: gravity must agree with free flight, in length per second squared, got "
                f"{stored_3.tolist()} instead of {estimated}; check dt, or give gravity=…"
            )
    return info.gravity or stored[0]


def _estimated(first: list[Trajectory], info: SetInfo) -> tuple[float, ...]:
    free = [t.position_TND[:, ~info.obstacles(t.type_N)] for t in first]
    gravity = estimate_gravity(free, info.frame_dt_s)
    size = float(np.linalg.norm(gravity))
    if info.gravity_size is not None and abs(size - info.gravity_size) > 0.1 * info.gravity_size:
        raise ConfigError(
            f"gravity must be given if particles in free flight contradict metadata.json's g_ext_magnitude of "
            f"{info.gravity_size:g}, got {size:.3g}; for example gravity=[0,-{info.gravity_size:g}]"
        )
    return gravity


def _neighbour_count(first: list[Trajectory], info: SetInfo) -> float:
    """Returns the mean number of neighbours of moving particles in the first and last frames.

    Raises: ConfigError for a mean below 1 or above MOST_NEIGHBOURS, except if all trajectories have few particles.
    """
    counts: list[np.ndarray] = []
    usual: list[np.ndarray] = []  # radii with the usual number of neighbours
    for trajectory in first:
        free_N = ~info.obstacles(trajectory.type_N)
        for position_ND in trajectory.position_TND[[0, -1]][:, free_N]:
            tree, some_nD = KDTree(position_ND), position_ND[:: 1 + len(position_ND) // 1000]
            counts.append(tree.query_ball_point(some_nD, info.radius, return_length=True) - 1)
            if len(position_ND) > USUAL_NEIGHBOURS:
                usual.append(tree.query(some_nD, k=[USUAL_NEIGHBOURS + 1])[0])
    mean = float(np.concatenate(counts).mean())
    if usual and not 1 <= mean <= MOST_NEIGHBOURS:
        rule = "at least 1 neighbour" if mean < 1 else f"at most {MOST_NEIGHBOURS} neighbours"
        raise ConfigError(
            f"radius must contain {rule} on average, got {mean:.2g} within {info.radius:g}; "
            f"radius={np.median(np.concatenate(usual)):.2g} contains about {USUAL_NEIGHBOURS}"
        )
    return mean


def _boundary(trajectory: Trajectory, info: SetInfo) -> np.ndarray:
    fixed_PD = trajectory.position_TND[0, info.obstacles(trajectory.type_N)]
    own = trajectory.boundary_PD
    return fixed_PD if own is None else np.concatenate([fixed_PD, own])


def _shards(
    folder: Path, split: str, episodes: Iterator[Episode], progress: Callable[[Episode], Any]
) -> Iterator[ShardEntry]:
    """Writes and yields shards. Each file is written atomically."""
    following = next(episodes, None)
    first = 0
    while following is not None:
        with temporary_file(folder / f"{split}.tar") as temporary:
            entries: list[EpisodeEntry] = []
            statistics, written = Statistics(), 0
            with temporary.open("wb") as file:
                while (episode := following) is not None and (not entries or written < SHARD_BYTES):
                    *parts, _ = episode_tar(episode)
                    written += sum(file.write(part) for part in parts)
                    count, frames = episode.particle_count, episode.frame_count
                    entries.append(EpisodeEntry(episode.key, first + len(entries), episode.seed, 0, count, frames, {}))
                    statistics = statistics.merge(episode_statistics(episode.position_TN3))
                    progress(episode)
                    following = next(episodes, None)
                file.write(tar_end(written))
                sync_file(file)
            stop = first + len(entries)
            target = folder / f"{split}-{first:06d}-{stop:06d}.tar"
            located = locate_members(temporary)
            temporary.replace(target)
        whole = tuple(replace(entry, members=located[entry.key]) for entry in entries)
        sha256, size = file_sha256(target), target.stat().st_size
        yield ShardEntry(target.name, split, first, stop, sha256, size, whole, statistics)
        first = stop
    sync_folder(folder)
