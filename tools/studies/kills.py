"""python -m tools.studies.kills +experiment=demo out=data/kills: kills the service 50 times, and looks for harm.

The data set is generated twice: once in peace, and once while a worker, the pool, the service, or all of them at
once are ended by SIGKILL at random moments. The second must be complete and verified, with the scenes and first
frames of the first, bitwise. Worth a run on a new cluster's file system. Linux only: it finds the processes in /proc.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.generate import datagen_config
from datagen.pool.locks import LOCK_NAME
from hgn.command import run_command
from hgn.data.index import INDEX_NAME
from hgn.data.manifest import MANIFEST_NAME, SPLITS, Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.verification import verify_file
from hgn.scene.episode import Episode
from hgn.schema import ConfigError, NonNegative, Positive, from_mapping, require, require_bounds, to_mapping
from hgn.system.files import TEMPORARY_SUFFIX, write_json
from hgn.system.progress import bar
from hgn.system.provenance import provenance, without_folders
from tools.report import EXIT_RED

TARGETS = ("worker", "pool", "service", "all of them")
_KEYS = ("kills", "interval_s", "kill_seed", "json")
_LOOK_S = 0.02
_PATIENCE_S = 600.0  # with a generation in which nothing gets published


@dataclass(frozen=True)
class KillsConfig:
    """`python -m tools.studies.kills`: how often and when, beside what `python -m datagen` takes."""

    kills: Positive[int] = 50
    interval_s: Positive[float] = 3.0  # between two, on average
    kill_seed: NonNegative[int] = 0
    json: str | None = None

    def __post_init__(self) -> None:
        require_bounds(self)


@dataclass(frozen=True)
class Kill:
    """What was killed when, and what was in the folder then."""

    time_s: float  # since the first start
    target: str
    shards: int  # published
    temporary_files: int  # that it left, or that are being written


def main(mapping: dict[str, Any]) -> int:
    """Prints what was killed and whether it did harm; the exit code is 1 where it did."""
    kills_config = from_mapping(KillsConfig, {key: mapping[key] for key in _KEYS if key in mapping})
    config = datagen_config(mapping, _KEYS)
    require(sys.platform == "linux", "tools.studies.kills", "run on Linux", sys.platform)
    out = Path(config.dataset.folder)
    peaceful, killed = out / "peaceful", out / "killed"
    require(not killed.exists(), "out", "a new folder", str(out), f"delete {killed}")
    overrides = [argument for argument in sys.argv[1:] if argument.partition("=")[0] not in (*_KEYS, "out")]
    overrides.append(f"dataset.maximum_attempts={config.dataset.maximum_attempts}")
    subprocess.run([sys.executable, "-m", "datagen", *overrides, f"out={peaceful}"], check=True)
    command = [sys.executable, "-m", "datagen.service", *overrides, f"out={killed}", "port=0", "progress=off"]
    began = time.monotonic()
    kills = generate_with_kills(command, killed, kills_config, out / "service.log")
    faults = differences(peaceful, killed)
    equal = equal_shards(peaceful, killed)
    manifest = Manifest.load(killed)
    counts = {target: sum(kill.target == target for kill in kills) for target in TARGETS}
    episodes = {split: manifest.published(split) for split in SPLITS}
    summary = {
        "kills": counts,
        "seconds": round(time.monotonic() - began, 1),
        "episodes": episodes,
        "shards": len(manifest.shards),
        "shards_bitwise_equal": equal,
        "kills_that_met_a_temporary_file": sum(kill.temporary_files > 0 for kill in kills),
        "differences": faults,
    }
    whole = "complete and verified, with the same scenes and first frames; no temporary file is left"
    print(f"{len(kills)} kills: " + ", ".join(f"{count} of {target}" for target, count in counts.items()))
    print(f"{episodes['train']} training episodes; {equal} of {len(manifest.shards)} shards are bitwise equal")
    print("\n".join(faults) or whole)
    if kills_config.json is not None:
        meta = provenance() | {"config": without_folders(to_mapping(config) | {"kills": to_mapping(kills_config)})}
        write_json(kills_config.json, {"meta": meta, "summary": summary, "rows": [asdict(kill) for kill in kills]})
    return EXIT_RED if faults else 0


def generate_with_kills(command: Sequence[str], folder: Path, config: KillsConfig, log: Path) -> list[Kill]:
    """Runs a service's command until `folder` is complete, killing on the way, and then once more.

    After each kill all that is published is verified, and that nothing published before is gone.
    Raises: ConfigError when the generation was complete before the last kill; RuntimeError when the service ended by
    itself, or nothing gets published.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    generator = np.random.default_rng(config.kill_seed)
    kills: list[Kill] = []
    published: list[str] = []
    order = [TARGETS[i] for _ in range(config.kills) for i in generator.permutation(len(TARGETS))]
    began = time.monotonic()
    with log.open("ab") as stream, bar("killing", total=config.kills, unit="kill") as progress:
        service = _Service(command, folder, stream, log)
        try:
            for target in order[: config.kills]:
                service.wait(generator.exponential(config.interval_s))
                if not service.kill(target, generator):
                    raise ConfigError(
                        f"kills must fall into the generation, got {len(kills)} of {config.kills} before it was "
                        "complete; ask for more scenes, or set interval_s lower"
                    )
                temporary = len(list(folder.rglob(f"*{TEMPORARY_SUFFIX}")))
                published = verified_shards(folder, published)
                kills.append(Kill(round(time.monotonic() - began, 3), target, len(published), temporary))
                progress.update()
                if service.process.poll() is not None:
                    service = _Service(command, folder, stream, log)
            service.wait_until_complete()
        finally:
            service.stop()
    return kills


def verified_shards(folder: Path, before: Sequence[str]) -> list[str]:
    """The sha256 of each published shard, all read back. Raises: ConfigError; RuntimeError when one has gone."""
    if not (folder / MANIFEST_NAME).exists():
        return list(before)
    manifest = Manifest.load(folder)
    for shard in manifest.shards:
        verify_file(folder / shard.name, shard.sha256, shard.bytes, "it was published")
    now = [shard.sha256 for shard in manifest.shards]
    if now[: len(before)] != list(before):
        raise RuntimeError(f"{folder} has lost shards: {len(before)} were published, now {len(now)}")
    return now


def differences(peaceful: Path, killed: Path) -> list[str]:
    """What a data set lacks, or has too much of, beside one that was made in peace; empty when nothing."""
    faults = []
    one, other = Manifest.load(peaceful), Manifest.load(killed)
    verified_shards(killed, ())
    if not other.complete:
        faults.append("it is not complete")
    if other.quarantined:
        cause = other.quarantined[0].cause
        faults.append(f"{len(other.quarantined)} scenes are quarantined, the first because {cause}")
    if sorted(shard.name for shard in one.shards) != sorted(shard.name for shard in other.shards):
        faults.append("its shards have other names")
    for split in SPLITS:
        first, second = ({e.key: e for e in EpisodeStore(folder, split)} for folder in (peaceful, killed))
        if first.keys() != second.keys():
            faults.append(f"{split}: other episodes")
        both = first.keys() & second.keys()
        faults += [f"{key}: another scene" for key in both if not _same(first[key], second[key])]
    index = {Path(name).name for name, _ in other.shards.files()}
    expected = {MANIFEST_NAME, INDEX_NAME, LOCK_NAME, *index, *(shard.name for shard in other.shards)}
    left = sorted(path.name for path in killed.rglob("*") if path.name not in expected)
    return faults + [f"{name} was left behind" for name in left]


def equal_shards(one: Path, other: Path) -> int:
    """How many shards are the same, bitwise; on several threads the solver rounds differently each time."""
    first, second = ({(s.name, s.sha256) for s in Manifest.load(folder).shards} for folder in (one, other))
    return len(first & second)


def _same(one: Episode, other: Episode) -> bool:
    """Whether two episodes are of the same scene: seed, specification and initial state, bitwise."""
    arrays = [
        (e.position_TN3[0], e.initial_velocity_N3, e.material_N, e.obstacle_grid.cell_K3, e.obstacle_grid.normal_K3)
        for e in (one, other)
    ]
    return (
        (one.seed, one.specification, one.frame_count) == (other.seed, other.specification, other.frame_count)
        and (one.domain_size, one.gravity) == (other.domain_size, other.gravity)
        and all(a.shape == b.shape and a.tobytes() == b.tobytes() for a, b in zip(*arrays, strict=True))
    )


class _Service:
    """A running service that fills a folder, and the processes below it."""

    def __init__(self, command: Sequence[str], folder: Path, stream: Any, log: Path) -> None:
        self._folder, self._log = folder, log
        self.process = subprocess.Popen(command, stdout=stream, stderr=stream, start_new_session=True)

    def wait(self, seconds: float) -> None:
        """Waits, less long when the data set is complete before. Raises: RuntimeError when the service has ended."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline and not self._complete():
            time.sleep(_LOOK_S)

    def wait_until_complete(self) -> None:
        """Raises: RuntimeError when the service has ended, or publishes nothing more."""
        revision, deadline = -1, time.monotonic() + _PATIENCE_S
        while not self._complete():
            now = Manifest.load(self._folder).revision if (self._folder / MANIFEST_NAME).exists() else -1
            if now != revision:
                revision, deadline = now, time.monotonic() + _PATIENCE_S
            self._look_again(deadline, "nothing was published")

    def kill(self, target: str, generator: np.random.Generator) -> bool:
        """Ends a process by SIGKILL as soon as there is such a one; False when the data set is complete before."""
        deadline = time.monotonic() + _PATIENCE_S
        while not self._complete():
            victims = self._processes(target)
            if victims and self._kill(target, victims[generator.integers(len(victims))]):
                return True
            self._look_again(deadline, f"the service has no {target}")
        return False

    def stop(self) -> None:
        """Ends the service as a person would, and waits for its pool."""
        if self.process.poll() is None:
            self.process.terminate()
        self.process.wait(_PATIENCE_S)

    def _kill(self, target: str, process: int) -> bool:
        try:
            (os.killpg if target == "all of them" else os.kill)(process, signal.SIGKILL)
        except ProcessLookupError:
            return False
        if process == self.process.pid:
            self.process.wait()
        return True

    def _processes(self, target: str) -> list[int]:
        if target in ("service", "all of them"):
            return [self.process.pid]
        pools = _spawned(self.process.pid)
        return pools if target == "pool" else [worker for pool in pools for worker in _spawned(pool)]

    def _complete(self) -> bool:
        """Raises: RuntimeError when it is not, and the service has ended."""
        if (self._folder / MANIFEST_NAME).exists() and Manifest.load(self._folder).complete:
            return True
        if self.process.poll() is not None:
            tail = "\n".join(self._log.read_text(errors="replace").splitlines()[-5:])
            raise RuntimeError(f"the service ended by itself, exit code {self.process.returncode}: {tail}")
        return False

    def _look_again(self, deadline: float, lacking: str) -> None:
        if time.monotonic() > deadline:
            raise RuntimeError(f"{lacking} for {_PATIENCE_S:.0f} s; see {self._log}")
        time.sleep(_LOOK_S)


def _spawned(process: int) -> list[int]:
    """The processes that multiprocessing has started from one, without its own helpers."""
    children = []
    try:
        for path in Path(f"/proc/{process}/task").glob("*/children"):
            for child in path.read_text().split():
                if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                    children.append(int(child))
    except (FileNotFoundError, ProcessLookupError):  # ended meanwhile
        return []
    return children


if __name__ == "__main__":
    run_command(main, "kills")
