"""Reads several data sets as one: fixed data sets first, then one that may grow."""

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from pathlib import Path

import numpy as np

from hgn.data.manifest import EpisodeEntry, Manifest
from hgn.data.reader import Episodes, EpisodeStore
from hgn.data.statistics import Statistics, merge_statistics
from hgn.scene.episode import Episode


class PooledStore(Episodes):
    """Joins one split of several data sets: first `others`, which stay as they were opened, then `own`, which may grow.

    It is used like an EpisodeStore. The index of an episode counts over all data sets.
    """

    def __init__(self, own: EpisodeStore, others: Sequence[EpisodeStore]) -> None:
        self.own, self.others = own, tuple(others)
        self._starts = np.cumsum([0, *map(len, self.others)])  # index of the first episode of each data set
        self._still = int(self._starts[-1])

    @property
    def folder(self) -> Path | str:
        return self.own.folder

    @property
    def manifest(self) -> Manifest:
        """Returns the manifest of the data set that may grow."""
        return self.own.manifest

    def of_split(self, split: str) -> "PooledStore":
        """Returns another split of the same data sets."""
        return PooledStore(self.own.of_split(split), [store.of_split(split) for store in self.others])

    def refresh(self) -> bool:
        """Refreshes the data set that may grow."""
        return self.own.refresh()

    def ask_again(self) -> None:
        """Refreshes after a fault; see EpisodeStore.ask_again."""
        self.own.ask_again()

    def within_reach(self, indices: Sequence[int], patience_s: float) -> bool:
        """Fetches the shards of these episodes; see EpisodeStore.within_reach."""
        return all(store.within_reach(places, patience_s) for store, places in self._by_store(indices))

    def fetch_ahead(self, episodes: Sequence[int] | None = None) -> None:
        """Starts to fetch shards in the background; see EpisodeStore.fetch_ahead."""
        every = ((store, None) for store in (*self.others, self.own))
        for store, places in every if episodes is None else self._by_store(episodes):
            store.fetch_ahead(places)

    def digest(self, count: int) -> str | None:
        """Combines the digests of all data sets."""
        parts = [*(store.digest(len(store)) for store in self.others), self.own.digest(count - self._still)]
        if any(part is None for part in parts):
            return None
        return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()

    @property
    def entries(self) -> Iterator[EpisodeEntry]:
        return chain.from_iterable(store.entries for store in (*self.others, self.own))

    def frames(self, count: int | None = None) -> list[int]:
        """Returns the frame counts of the first `count` episodes, which include all of `others`."""
        own = None if count is None else count - self._still
        return [*chain.from_iterable(store.frames() for store in self.others), *self.own.frames(own)]

    def particles(self, episodes: Sequence[int]) -> list[int]:
        """Returns the particle counts of these episodes."""
        return [store.particles([place])[0] for store, place in map(self._place, episodes)]

    def statistics(self) -> Statistics:
        """Returns the merged statistics of all data sets."""
        return merge_statistics(store.statistics() for store in (*self.others, self.own))

    def __len__(self) -> int:
        return self._still + len(self.own)

    def read(self, index: int) -> Episode:
        store, place = self._place(index)
        return store.read(place)

    def _place(self, index: int) -> tuple[EpisodeStore, int]:
        """Returns the store of an episode, and the episode's index in it."""
        number = int(np.searchsorted(self._starts, index, side="right")) - 1
        return (*self.others, self.own)[number], index - int(self._starts[number])

    def _by_store(self, indices: Sequence[int]) -> Iterable[tuple[EpisodeStore, list[int]]]:
        places: dict[EpisodeStore, list[int]] = defaultdict(list)
        for store, place in map(self._place, indices):
            places[store].append(place)
        return places.items()


AnyStore = EpisodeStore | PooledStore
