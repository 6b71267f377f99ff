"""Plans a data set: keys, seeds, shard ranges and the order of work. All functions are pure.

An episode is the unit of simulation, a shard the unit of publication. Training may start after the first shard, so
the first shards are small and the first validation episode comes early.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hgn.data.manifest import SPLITS

_SHARD_NAME = re.compile(rf"({'|'.join(SPLITS)})-(\d{{6,}})-(\d{{6,}})\.tar")
_SINGLE_EPISODE_SHARDS = 5  # number of leading shards of validation and test with one episode


@dataclass(frozen=True)
class SceneTask:
    """Names a scene to make and simulate."""

    split: str
    index: int
    attempt: int  # number of earlier seeds that could not be simulated
    seed: int

    @property
    def key(self) -> str:
        return episode_key(self.split, self.index)

    @property
    def place(self) -> tuple[bool, int, bool]:
        return generation_place(self.split, self.index)


@dataclass(frozen=True)
class ShardRange:
    """Names the episodes [first, stop) of a split."""

    split: str
    first: int
    stop: int

    @property
    def name(self) -> str:
        return f"{self.split}-{self.first:06d}-{self.stop:06d}.tar"

    @property
    def indices(self) -> range:
        return range(self.first, self.stop)


def episode_key(split: str, index: int) -> str:
    """Returns the WebDataset key of an episode. It has no dot, because WebDataset would end it there."""
    return f"{split}-{index:06d}"


def scene_seed(dataset_seed: int, split: str, index: int, attempt: int) -> int:
    """Returns the 63-bit seed of a scene. It is the same on every machine and in every version of Python."""
    text = f"{dataset_seed}/{split}/{index}/{attempt}"
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def parse_shard_name(name: str) -> ShardRange | None:
    """Returns the range of a shard's file name; None if it is not the name of a shard."""
    match = _SHARD_NAME.fullmatch(name)
    if match is None:
        return None
    shard = ShardRange(match[1], int(match[2]), int(match[3]))
    return shard if shard.name == name and shard.first < shard.stop else None


def parse_episode_key(key: str) -> ShardRange | None:
    """Returns the range of a key's episode; None if it is not a key of an episode."""
    split, _, number = key.rpartition("-")
    if split not in SPLITS or not number.isdecimal() or episode_key(split, int(number)) != key:
        return None
    return ShardRange(split, int(number), int(number) + 1)


def shard_ranges(split: str, count: int, episodes_per_shard: int) -> list[ShardRange]:
    """Returns the shards of a split of `count` episodes.

    Sizes of training shards double from one episode up to `episodes_per_shard` (begins 0, 1, 2, 4, 8, 16, 24, ... for
    8). The first five shards of validation and test have one episode each.
    """
    ranges, first = [], 0
    while first < count:
        if split == "train":
            size = min(max(first, 1), episodes_per_shard)
        else:
            size = 1 if first < _SINGLE_EPISODE_SHARDS else episodes_per_shard
        stop = min(first + size, count)
        ranges.append(ShardRange(split, first, stop))
        first = stop
    return ranges


def work_order(requested: Mapping[str, int], episodes_per_shard: int) -> list[ShardRange]:
    """Returns all shards of a data set in the order of their completion."""
    shards = [shard for split in SPLITS for shard in shard_ranges(split, requested[split], episodes_per_shard)]
    return sorted(shards, key=lambda shard: generation_place(shard.split, shard.stop - 1))


def missing_ranges(planned: Iterable[ShardRange], published: Mapping[str, Sequence[int]]) -> list[ShardRange]:
    """Returns the unpublished episodes of the planned shards. Published ones in the middle divide a shard into several.

    `published` contains a flag for each episode of a split. Episodes after its end are not published.
    """
    missing = []
    for shard in planned:
        flags = published[shard.split]
        first: int | None = None
        for index in range(shard.first, shard.stop + 1):
            wanted = index < shard.stop and not (index < len(flags) and flags[index])
            if wanted and first is None:
                first = index
            elif not wanted and first is not None:
                missing.append(ShardRange(shard.split, first, index))
                first = None
    return missing


def generation_place(split: str, index: int) -> tuple[bool, int, bool]:
    """Returns an episode's sort key: training and validation alternate, then the rest of training, then test."""
    return split == "test", index, split == "validation"
