"""Several data sets read as one."""

import pickle
from dataclasses import replace

import numpy as np
import pytest

from hgn.data.pooled import PooledStore
from hgn.data.reader import EpisodeStore
from hgn.data.sampler import EpisodeSampler
from hgn.data.statistics import merge_statistics


@pytest.fixture
def configs(make_config):
    """Of three data sets, of other seeds and lengths."""
    parts = [{"training_scenes": 3}, {"training_scenes": 2, "frames": 9}, {"training_scenes": 4, "frames": 5}]
    made = [make_config(seed=i, **part) for i, part in enumerate(parts)]
    folders = [f"{config.dataset.folder}_{i}" for i, config in enumerate(made)]
    return [replace(c, dataset=replace(c.dataset, folder=f)) for c, f in zip(made, folders, strict=True)]


def test_the_sets_follow_each_other(configs, make_dataset):
    """Places, lengths, sizes and statistics are those of the sets one behind the other; the last one grows, and what
    was there keeps its place."""
    stores = [EpisodeStore(make_dataset(config), "train") for config in configs]
    pooled = pickle.loads(pickle.dumps(PooledStore(stores[2], stores[:2])))
    expected = [episode for store in (stores[0], stores[1], stores[2]) for episode in store]

    def require_same(pooled, count):
        assert len(pooled) == len(list(pooled.entries)) == count
        for found, episode in zip(pooled, expected, strict=False):
            assert found.seed == episode.seed and np.array_equal(found.position_TN3, episode.position_TN3)
        assert pooled.frames() == [episode.frame_count for episode in pooled]
        assert pooled.particles(range(count)[::-1]) == [e.particle_count for e in pooled][::-1]

    require_same(pooled, 9)
    assert pooled.frames(6) == [6, 6, 6, 9, 9, 5]
    assert pooled.statistics() == merge_statistics(store.statistics() for store in stores)
    assert [len(part) for part in (pooled.of_split("validation"), pooled.of_split("test"))] == [6, 3]
    before = pooled.digest(9)
    assert before not in (None, PooledStore(stores[2], stores[1::-1]).digest(9)) and not pooled.refresh()
    make_dataset(replace(configs[2], dataset=replace(configs[2].dataset, training_scenes=8)))
    assert pooled.refresh()
    require_same(pooled, 13)
    assert pooled.digest(9) == before != pooled.digest(13)


def test_an_order_over_all(configs, make_dataset):
    """An epoch holds every sample of all sets once, also where the set that grows has no episode yet."""
    first, second = (EpisodeStore(make_dataset(config), "train") for config in configs[:2])
    empty = replace(configs[2], dataset=replace(configs[2].dataset, training_scenes=0))
    pooled = PooledStore(EpisodeStore(make_dataset(empty), "train"), [first, second])
    order = EpisodeSampler(0, 1, lambda epoch: pooled.frames(), digest=pooled.digest)
    drawn = {(sample.episode, sample.frame) for _ in range(31) for sample in order.next_batch()}
    assert drawn == {(i, frame) for i, count in enumerate(pooled.frames()) for frame in range(count - 1)}
    assert len(drawn) == 31


def test_what_is_fetched(configs, make_dataset, monkeypatch):
    """Each set is asked for its own episodes, in the order that they are needed in."""
    stores = [EpisodeStore(make_dataset(config), "train") for config in configs]
    pooled, asked = PooledStore(stores[2], stores[:2]), []
    monkeypatch.setattr(EpisodeStore, "within_reach", lambda store, places, _: not asked.append((store, places)))
    monkeypatch.setattr(EpisodeStore, "fetch_ahead", lambda store, places=None: asked.append((store, places)))
    assert pooled.within_reach([8, 0, 3, 5], 0.0)
    pooled.fetch_ahead([4, 3])
    pooled.fetch_ahead()
    own, *others = stores[2], stores[0], stores[1]
    wanted = [(own, [3, 0]), (others[0], [0]), (others[1], [0])]
    assert asked == [*wanted, (others[1], [1, 0]), *((store, None) for store in (*others, own))]
