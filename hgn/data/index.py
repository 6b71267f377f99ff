"""Reads and writes the index of a data set: a line of JSON for each shard in publication order, in append-only files.

| file in `index/` | content |
|---|---|
| `G-NNNNNN.jsonl` | segment N of generation G: SEGMENT_SHARDS shards, fewer in the last one |
| `G-segments.jsonl` | the totals up to the end of each full segment |
| `G-quarantined.jsonl` | scenes that could not be simulated |

The *head*, `manifest.json`, contains the valid sizes of the last segment and of the other two files. Bytes after them
are not published and are overwritten. The cost of a publication does not depend on the number of shards, and a reader
reads only new shards. If a shard is removed from the list, the whole index is written again as the next generation.
"""

import json
import os
import re
import threading
from array import array
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar, overload

from hgn.data.entries import (
    REMEDY,
    SPLITS,
    Count,
    EpisodeEntry,
    QuarantinedScene,
    ShardEntry,
    SplitTotals,
    Totals,
    no_totals,
    totals_of,
)
from hgn.data.storage import Storage, StorageError, ask
from hgn.schema import Bounded, ConfigError, NonNegative, from_mapping, strict_json, to_mapping
from hgn.system.files import errors_name, make_folder, sync_file, sync_folder

INDEX_NAME = "index"
SEGMENT_SHARDS = 128  # number of shards in a segment
_SEGMENTS_CACHED = 64  # number of segments in memory: 8,192 shards

T = TypeVar("T")


@dataclass(frozen=True)
class IndexState(Bounded):
    """Holds the valid sizes of the index's files."""

    generation: NonNegative[int] = 1
    shards: Count = 0
    segment_bytes: NonNegative[int] = 0  # size of the last segment
    table_bytes: NonNegative[int] = 0
    quarantined: NonNegative[int] = 0
    quarantine_bytes: NonNegative[int] = 0

    def path(self, kind: int | str) -> str:
        """Returns the name of segment number `kind`, or of another file."""
        return f"{INDEX_NAME}/{self.generation}-{kind if isinstance(kind, str) else f'{kind:06d}'}.jsonl"


@dataclass(frozen=True)
class _SegmentEnd:
    """Holds a line of `G-segments.jsonl`."""

    bytes: int  # size of the segment
    totals: dict[str, SplitTotals]  # totals up to its end, without statistics


@dataclass(frozen=True)
class _Segment:
    """Holds the lines of a segment that have been read."""

    shards: list[ShardEntry]
    bytes: int
    totals: Totals  # totals up to its end, without statistics


class _Read:
    """Caches the parts of an index that were read. Later states of the same index share the cache."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.ends: list[_SegmentEnd] = []  # ends of the full segments
        self.ends_bytes = 0
        self.segments: OrderedDict[int, _Segment] = OrderedDict()
        # the episode ranges of the shards that have been read, sorted
        self.ranges: dict[str, list[tuple[int, int]]] = {split: [] for split in SPLITS}
        self.seen: dict[int, int] = {}  # number of shards in `ranges` by segment
        self.particles = {split: array("i") for split in SPLITS}  # particle count of each episode; -1: not read

    def see(self, segment: int, shards: Sequence[ShardEntry]) -> None:
        """Records the shards of a segment. Raises: ConfigError if an episode is listed twice."""
        for shard in shards[self.seen.get(segment, 0) :]:
            ranges, own = self.ranges[shard.split], (shard.first, shard.stop)
            place = bisect_left(ranges, own)
            for other in ranges[max(place - 1, 0) : place + 1]:
                if max(other[0], own[0]) < min(other[1], own[1]) or other == own:
                    raise ConfigError(f"{shard.name} must be listed once, got its episodes twice; {REMEDY}")
            ranges.insert(place, own)
        self.seen[segment] = len(shards)


class Index(Sequence[ShardEntry]):
    """Lists the published shards of a data set in publication order. Segments are read when needed.

    Raises on access: ConfigError if a line is invalid or the lines contradict the head; UnreachableError.
    """

    def __init__(self, folder: Path | str, state: IndexState, totals: Totals) -> None:
        self.folder, self.state, self.totals = folder, state, totals
        self._read = _Read()

    def continued(self, later: "Index") -> "Index":
        """Returns `later`. If it is a later state of the same index, it shares the cache of this one."""
        if later.state.generation == self.state.generation and len(later) >= len(self):
            later._read = self._read
        return later

    def __len__(self) -> int:
        return self.state.shards

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    __hash__ = None  # type: ignore[assignment]

    @overload
    def __getitem__(self, place: int) -> ShardEntry: ...

    @overload
    def __getitem__(self, place: slice) -> list[ShardEntry]: ...

    def __getitem__(self, place: int | slice) -> ShardEntry | list[ShardEntry]:
        if isinstance(place, slice):
            return [self[i] for i in range(len(self))[place]]
        place = range(len(self))[place]
        return self._segment(place // SEGMENT_SHARDS)[place % SEGMENT_SHARDS]

    def __iter__(self) -> Iterator[ShardEntry]:
        return self.since(0)

    def since(self, count: int) -> Iterator[ShardEntry]:
        """Yields all shards except the first `count`."""
        while count < len(self):
            rest = self._segment(count // SEGMENT_SHARDS)[count % SEGMENT_SHARDS :][: len(self) - count]
            yield from rest
            count += len(rest)

    def locate(self, split: str, episode: int) -> tuple[ShardEntry, EpisodeEntry]:
        """Returns the shard and the entry of an episode, by the episode's index in the split. Raises: IndexError."""
        if not 0 <= episode < self.totals[split].episodes:
            raise IndexError(episode)
        segment = self._first_beyond(split, episode)
        before = self._before(segment)[split].episodes
        shards = (shard for shard in self._segment(segment) if shard.split == split)
        for shard in shards:
            if episode < before + len(shard.episodes):
                break
            before += len(shard.episodes)
        return shard, shard.episodes[episode - before]

    def particles(self, split: str, episodes: Sequence[int]) -> list[int]:
        """Returns the particle counts of episodes, by their indices in the split. Each segment is read once."""
        particles = self._read.particles[split]
        with self._read.lock:
            particles.extend([-1] * (self.totals[split].episodes - len(particles)))
            for episode in episodes:
                if particles[episode] < 0:
                    segment = self._first_beyond(split, episode)
                    counts = [e.particles for s in self._segment(segment) if s.split == split for e in s.episodes]
                    before = self._before(segment)[split].episodes
                    particles[before : before + len(counts)] = array("i", counts)
        return [particles[episode] for episode in episodes]

    def digest(self, split: str, episodes: int) -> str | None:
        """Returns the digest of the shards with the first `episodes`, or None if these do not fill whole shards."""
        totals = self.totals[split]
        if episodes < totals.episodes:
            segment = self._first_beyond(split, episodes)
            totals = self._before(segment)[split]
            for shard in self._segment(segment):
                if totals.episodes < episodes and shard.split == split:
                    totals = totals.plus(shard)
        return totals.digest if totals.episodes == episodes else None

    def continues(self, earlier: "Index", split: str) -> bool:
        """Returns whether the shards of a split begin with those of `earlier`."""
        before = earlier.totals[split]
        return self.digest(split, before.episodes) == before.digest

    def quarantined(self) -> list[QuarantinedScene]:
        """Returns the scenes that could not be simulated, in order."""
        return self._rows(QuarantinedScene, "quarantined", 0, self.state.quarantine_bytes, self.state.quarantined)

    def files(self) -> Iterator[tuple[str, int]]:
        """Yields names and sizes of the files in the order in which they must be written."""
        for kind in (*range(len(self) // SEGMENT_SHARDS + 1), "segments", "quarantined"):
            if size := self._bytes(kind):
                yield self.state.path(kind), size

    def size(self, name: str) -> int | None:
        """Returns the valid size of a file, or None if it is not part of the index."""
        match = re.fullmatch(r".*-(\d{6,9}|segments|quarantined)\.jsonl", name)
        kind: int | str = "" if match is None else int(match[1]) if match[1].isdecimal() else match[1]
        return self._bytes(kind) or None if name == self.state.path(kind) else None

    def _bytes(self, kind: int | str) -> int:
        """Returns the valid size of a segment or another file; 0 if there is none."""
        state, full = self.state, len(self) // SEGMENT_SHARDS
        if isinstance(kind, int) and kind < full:
            return self._ends()[kind].bytes
        others = {full: state.segment_bytes, "segments": state.table_bytes, "quarantined": state.quarantine_bytes}
        return others.get(kind, 0)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name != "_read"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _read=_Read())

    def _rows(self, cls: type[T], kind: int | str, start: int, stop: int, count: int) -> list[T]:
        name = self.state.path(kind)

        def read(storage: Storage) -> list[T]:
            try:
                content = storage.read(name, start, stop) if stop > start else b""
            except FileNotFoundError:
                raise StorageError(f"{self.folder}/{name} must exist, got no such file; {REMEDY}") from None
            try:
                rows = [from_mapping(cls, parse_json(line, name), name) for line in content.splitlines()]
            except ConfigError as error:  # other bytes than were published, perhaps temporarily
                raise StorageError(f"{self.folder}/{error}") from None
            if len(rows) != count:
                raise StorageError(
                    f"{self.folder}/{name} must have {count} lines from byte {start}, got {len(rows)}; {REMEDY}"
                )
            return rows

        return ask(self.folder, read)

    def _ends(self) -> list[_SegmentEnd]:
        """Returns the ends of the full segments, and those that later states of the index have read."""
        read, full = self._read, len(self) // SEGMENT_SHARDS
        with read.lock:
            if len(read.ends) < full:
                read.ends += self._rows(
                    _SegmentEnd, "segments", read.ends_bytes, self.state.table_bytes, full - len(read.ends)
                )
                read.ends_bytes = self.state.table_bytes
            return read.ends

    def _before(self, segment: int) -> Totals:
        return self._ends()[segment - 1].totals if segment else {split: SplitTotals() for split in SPLITS}

    def _first_beyond(self, split: str, episode: int) -> int:
        """Returns the segment that contains an episode."""
        return bisect_right(self._ends(), episode, key=lambda end: end.totals[split].episodes)

    def _segment(self, number: int) -> list[ShardEntry]:
        """Returns the shards of a segment, and further shards if later states of the index have read them."""
        read, count = self._read, min(SEGMENT_SHARDS, len(self) - number * SEGMENT_SHARDS)
        with read.lock:
            segment = read.segments.get(number) or _Segment([], 0, self._before(number))
            if len(segment.shards) < count:
                end = self._ends()[number] if count == SEGMENT_SHARDS else None
                stop = end.bytes if end else self.state.segment_bytes

                def extended(_: Storage, earlier: _Segment = segment) -> _Segment:
                    new = self._rows(ShardEntry, number, earlier.bytes, stop, count - len(earlier.shards))
                    later = _Segment(earlier.shards + new, stop, totals_of(new, earlier.totals))
                    for split, expected in (end.totals if end else self.totals).items():
                        if replace(expected, statistics=None) != later.totals[split]:
                            raise StorageError(
                                f"{self.folder}/{self.state.path(number)} must list the {split} shards that were "
                                f"published, got others; {REMEDY}"
                            )
                    return later

                segment = ask(self.folder, extended)
                read.see(number, segment.shards)
                read.segments[number] = segment
            read.segments.move_to_end(number)
            if len(read.segments) > _SEGMENTS_CACHED:
                read.segments.popitem(last=False)
            return segment.shards


def extend(
    folder: Path, index: Index, shards: Iterable[ShardEntry], quarantined: Sequence[QuarantinedScene] = ()
) -> Index:
    """Appends lines to the files of an index. They become valid when a head with the returned state is written.

    Raises: OSError; ConfigError if the files are shorter than the index states.
    """
    state, totals = index.state, index.totals
    make_folder(folder / INDEX_NAME)
    rest = list(shards)
    while rest:
        number, filled = divmod(state.shards, SEGMENT_SHARDS)
        part, rest = rest[: SEGMENT_SHARDS - filled], rest[SEGMENT_SHARDS - filled :]
        size = _append(folder / state.path(number), state.segment_bytes, part)
        totals = totals_of(part, totals)
        state = replace(state, shards=state.shards + len(part), segment_bytes=size)
        if state.shards % SEGMENT_SHARDS == 0:
            plain = {split: replace(value, statistics=None) for split, value in totals.items()}
            table = _append(folder / state.path("segments"), state.table_bytes, [_SegmentEnd(size, plain)])
            state = replace(state, segment_bytes=0, table_bytes=table)
    if quarantined:
        size = _append(folder / state.path("quarantined"), state.quarantine_bytes, quarantined)
        state = replace(state, quarantined=state.quarantined + len(quarantined), quarantine_bytes=size)
    return index.continued(Index(folder, state, totals))


def begin(folder: Path, current: int = 0) -> Index:
    """Returns an empty index of a new generation, with a number above those of all files.

    Removes files of generations before `current`, that of the head, because nobody reads them. Files of later
    generations, left by an interrupted publication, stay.
    """
    files = {path: int(path.name.partition("-")[0]) for path in (folder / INDEX_NAME).glob("[0-9]*-*.jsonl")}
    for path, generation in files.items():
        if generation < current:
            path.unlink()
    return Index(folder, IndexState(max(files.values(), default=0) + 1), no_totals())


def parse_json(content: bytes, path: str) -> Any:
    """Parses strict JSON. Raises: ConfigError, also for repeated keys, NaN and infinities."""
    try:
        return strict_json(content, parse_constant=_refuse)
    except ValueError as error:
        raise StorageError(f"{path} must be JSON written by python -m datagen, got {error}; {REMEDY}") from None


def _refuse(constant: str) -> None:
    raise ValueError(constant)


def _append(path: Path, at: int, rows: Sequence[Any]) -> int:
    """Writes lines at an offset of a file, truncates it after them and syncs it. Returns its size."""
    content = b"".join(
        json.dumps(to_mapping(row), sort_keys=True, allow_nan=False, separators=(",", ":")).encode() + b"\n"
        for row in rows
    )
    # the existence of the file is not checked, because a network file system may have cached an old answer
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC
    with errors_name(path), os.fdopen(os.open(path, flags, 0o644), "r+b") as file:
        if file.seek(0, 2) < at:
            raise ConfigError(f"{path} must have {at} bytes or more, got {file.tell()}; {REMEDY}")
        file.truncate(at)
        file.seek(at)
        file.write(content)
        sync_file(file)
    if at == 0:
        sync_folder(path.parent)
    return at + len(content)
