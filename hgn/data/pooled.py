"""Several data sets as one: those that stand still come first, whole, then one that may grow."""

from __future__ import annotations

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
    """One split of `own`, behind the same of `others`: of these what was published when they were opened.

    Read as an EpisodeStore is: places of episodes count over all of them, and only ever `own` grows.
    """

    def __init__(self, own: EpisodeStore, others: Sequence[EpisodeStore]) -> None:
        self.own, self.others = own, tuple(others)
        self._ends = np.cumsum([len(store) for store in self.others])
        self._still = int(self._ends[-1]) if self.others else 0

    @property
    def folder(self) -> Path | str:
        return self.own.folder

    @property
    def manifest(self) -> Manifest:
        """Of the set that may grow."""
        return self.own.manifest

    def of_split(self, split: str) -> PooledStore:
        """Another split of the same data sets."""
        return PooledStore(self.own.of_split(split), [store.of_split(split) for store in self.others])

    def refresh(self) -> bool:
        """As EpisodeStore.refresh, of the set that may grow."""
        return self.own.refresh()

    def within_reach(self, indices: Sequence[int], patience_s: float) -> bool:
        """As EpisodeStore.within_reach."""
        return all(store.within_reach(places, patience_s) for store, places in self._by_store(indices))

    def fetch_ahead(self, episodes: Sequence[int] | None = None) -> None:
        """As EpisodeStore.fetch_ahead."""
        if episodes is None:
            for store in (*self.others, self.own):
                store.fetch_ahead()
        else:
            for store, places in self._by_store(episodes):
                store.fetch_ahead(places)

    def digest(self, count: int) -> str | None:
        """As EpisodeStore.digest: over those of all sets."""
        parts = [*(store.digest(len(store)) for store in self.others), self.own.digest(count - self._still)]
        if any(part is None for part in parts):
            return None
        return hashlib.sha256(" ".join(map(str, parts)).encode()).hexdigest()

    @property
    def entries(self) -> Iterator[EpisodeEntry]:
        """What the indices say of each episode."""
        return chain.from_iterable(store.entries for store in (*self.others, self.own))

    def frames(self, count: int | None = None) -> list[int]:
        """Frames of each episode, of the first `count` only, which holds all `others` have."""
        own = None if count is None else count - self._still
        return [*chain.from_iterable(store.frames() for store in self.others), *self.own.frames(own)]

    def particles(self, episodes: Sequence[int]) -> list[int]:
        """How many each of these has, by the indices."""
        return [store.particles([place])[0] for store, place in map(self._place, episodes)]

    def statistics(self) -> Statistics:
        """Velocity and acceleration of all sets together, in frame units."""
        return merge_statistics(store.statistics() for store in (*self.others, self.own))

    def __len__(self) -> int:
        return self._still + len(self.own)

    def open(self, index: int) -> Episode:
        store, place = self._place(index)
        return store.open(place)

    def _place(self, index: int) -> tuple[EpisodeStore, int]:
        """The store of an episode, and where it is in there."""
        number = int(np.searchsorted(self._ends, index, side="right"))
        if number == len(self.others):
            return self.own, index - self._still
        return self.others[number], index - int(self._ends[number]) + len(self.others[number])

    def _by_store(self, indices: Sequence[int]) -> Iterable[tuple[EpisodeStore, list[int]]]:
        places: dict[EpisodeStore, list[int]] = defaultdict(list)
        for store, place in map(self._place, indices):
            places[store].append(place)
        return places.items()


AnyStore = EpisodeStore | PooledStore
