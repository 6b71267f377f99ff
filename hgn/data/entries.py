"""Defines the entries of a data set's index: episodes, shards and their totals."""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from hgn.config import Split
from hgn.data.statistics import Moments, Statistics
from hgn.schema import Bound, Bounded, ConfigError, NonNegative, require, require_bounds

SPLITS = ("train", "validation", "test")
REMEDY = "if this persists, run the generator again without manifest.json: published shards are found and kept"
MOST = 10_000_000  # largest number of shards of a data set, and of episodes of a split
Count = Annotated[int, Bound(f"from 0 to {MOST}", lambda value: 0 <= value <= MOST)]
_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,200}")
_SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class EpisodeEntry:
    """Describes an episode in a shard."""

    key: str
    index: int  # number of the episode in its split
    seed: int
    attempt: int  # 0, or the number of quarantined seeds of this index
    particles: int
    frames: int
    members: dict[str, tuple[int, int]]  # offset in the tar and size, by the name after `<key>.`

    def __post_init__(self) -> None:
        counts = [self.particles, self.frames]
        require(min(counts) >= 0 and max(counts) < 2**31, "particles, frames", "from 0 to 2147483647", counts)


@dataclass(frozen=True)
class ShardEntry:
    """Describes a published tar file with the episodes [first, stop) of a split."""

    name: str
    split: Split
    first: Count
    stop: Count
    sha256: str
    bytes: NonNegative[int]
    episodes: tuple[EpisodeEntry, ...]
    statistics: Statistics

    def __post_init__(self) -> None:
        require_bounds(self)
        # name and sha256 become file names, and an index may come from any server
        require(_FILE_NAME.fullmatch(self.name) is not None, "name", "a plain file name", self.name)
        require(_SHA256.fullmatch(self.sha256) is not None, "sha256", "64 hexadecimal digits", self.sha256)
        numbers = [episode.index for episode in self.episodes]
        if self.stop - self.first != len(numbers) or numbers != list(range(self.first, self.stop)):
            raise ConfigError(f"episodes must be numbers {self.first} to {self.stop - 1}, got {numbers}; {REMEDY}")
        require_sound(self.statistics)


@dataclass(frozen=True)
class QuarantinedScene:
    """Describes a scene that could not be simulated. The scene of the next seed replaced it."""

    key: str
    attempt: int
    seed: int
    cause: str


@dataclass(frozen=True)
class SplitTotals(Bounded):
    """Counts the published part of a split."""

    shards: Count = 0
    episodes: Count = 0
    bytes: NonNegative[int] = 0
    digest: str = ""  # digest of the shards' sha256 in publication order; identifies the order of samples
    statistics: Statistics | None = None  # stored in `manifest.json` only, not with segments

    def plus(self, shard: ShardEntry) -> "SplitTotals":
        """Returns the totals with one more shard."""
        return SplitTotals(
            self.shards + 1,
            self.episodes + len(shard.episodes),
            self.bytes + shard.bytes,
            hashlib.sha256(f"{self.digest}{shard.sha256}".encode()).hexdigest(),
            self.statistics and self.statistics.merge(shard.statistics),
        )


Totals = dict[str, SplitTotals]


def require_sound(statistics: Statistics) -> None:
    """Raises ConfigError for numbers that are too large or not finite, and for negative counts or squares."""
    for name in ("velocity", "acceleration"):
        moments: Moments = getattr(statistics, name)
        counts = (moments.count, *moments.squared_deviation)
        sound = all(x >= 0 for x in counts) and all(abs(x) <= 1e15 for x in (*moments.mean, *moments.std))
        rule = "at most 1e15 in size, with count and squares >= 0"
        require(sound, f"statistics.{name}", rule, moments, remedy=REMEDY)


def no_totals() -> Totals:
    """Returns the totals of an empty data set."""
    return {split: SplitTotals(statistics=Statistics()) for split in SPLITS}


def totals_of(shards: Iterable[ShardEntry], totals: Totals | None = None) -> Totals:
    """Adds shards to `totals`."""
    totals = dict(totals or no_totals())
    for shard in shards:
        totals[shard.split] = totals[shard.split].plus(shard)
    return totals
