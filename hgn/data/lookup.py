"""Selection of episodes from a data set."""

from __future__ import annotations

from heapq import nsmallest
from itertools import islice
from pathlib import Path

from hgn.data.manifest import SPLITS
from hgn.data.pooled import AnyStore
from hgn.data.reader import EpisodeStore
from hgn.scene.episode import Episode
from hgn.schema import ConfigError


def first_indices(store: AnyStore, count: int, published: int | None = None) -> list[int]:
    """Returns the places of the episodes with the lowest indices among the first `published` (None: all)."""
    places = ((entry.index, place) for place, entry in enumerate(islice(store.entries, published)))
    return [place for _, place in nsmallest(count, places)]


def first_episodes(store: EpisodeStore, count: int) -> list[Episode]:
    """Returns the `count` episodes of lowest index.

    Raises: ConfigError when there are none.
    """
    if not len(store):
        others = ", ".join(f"split={split}" for split in SPLITS if len(store.of_split(split)))
        remedy = f"; it has others: {others}" if others else ""
        raise ConfigError(f"data must hold episodes of the split {store.split}, got none in {store.folder}{remedy}")
    return [store.open(i) for i in first_indices(store, count)]


def find_episode(folder: Path | str, key: str) -> Episode:
    """Returns the episode with a key, for example validation-000000.

    Raises: ConfigError when the data set does not hold it.
    """
    split = key.rsplit("-", 1)[0]
    if split not in SPLITS:
        raise ConfigError(f"episode must begin with one of {', '.join(SPLITS)}, got {key!r}; e.g. validation-000000")
    store = EpisodeStore(folder, split)
    for place, entry in enumerate(store.entries):
        if entry.key == key:
            return store.open(place)
    raise ConfigError(f"episode must be one of the {len(store)} {split} episodes in {folder}, got {key!r}")
