"""Keys, seeds, shard ranges and the order of work."""

from itertools import product

from hypothesis import given
from hypothesis import strategies as st

from datagen.pool.plan import ShardRange, generation_place, missing_ranges, parse_shard_name, scene_seed, shard_ranges

COUNTS = st.integers(0, 60)
SPLITS = st.sampled_from(["train", "validation", "test"])


def test_shards_grow_up_to_their_size():
    """Training can start after one episode: its shards double up to their size. Five validation and test episodes are
    shards of their own. The last shard is cut to the count."""
    for split, count, size, stops in (
        ("train", 30, 8, [1, 2, 4, 8, 16, 24, 30]),
        ("train", 12, 3, [1, 2, 4, 7, 10, 12]),
        ("train", 3, 1, [1, 2, 3]),
        ("validation", 20, 8, [1, 2, 3, 4, 5, 13, 20]),
        ("test", 3, 8, [1, 2, 3]),
    ):
        assert [shard.stop for shard in shard_ranges(split, count, size)] == stops


@given(split=SPLITS, count=COUNTS, size=st.integers(1, 9))
def test_ranges_cover_each_episode_once(split, count, size):
    """Ranges partition the split in order, whatever its size."""
    covered = [index for shard in shard_ranges(split, count, size) for index in shard.indices]
    assert covered == list(range(count))


@given(split=SPLITS, before=COUNTS, after=COUNTS, sizes=st.tuples(st.integers(1, 9), st.integers(1, 9)))
def test_growth_makes_just_what_is_missing(split, before, after, sizes):
    """A data set that grows, even with another shard size, gains the new episodes once and no others."""
    present = shard_ranges(split, before, sizes[0])
    missing = missing_ranges(shard_ranges(split, after, sizes[1]), {split: b"\1" * before})
    assert [index for shard in missing for index in shard.indices] == list(range(before, after))
    assert len({shard.name for shard in (*present, *missing)}) == len(present) + len(missing)


def test_missing_ranges_split_around_holes():
    """Only the episodes that are not there are planned, as one shard a gap."""
    published = {"train": [0, 0, 1, 0, 0, 1], "test": [1] * 8}
    gaps = [(shard.first, shard.stop) for shard in missing_ranges([ShardRange("train", 0, 8)], published)]
    assert gaps == [(0, 2), (3, 5), (6, 8)]


@given(train=COUNTS, validation=COUNTS, test=COUNTS)
def test_generation_order_holds_each_episode_once(train, validation, test):
    """Every episode of every split is made once; within a split in order; test comes last."""
    requested = {"train": train, "validation": validation, "test": test}
    items = [(split, index) for split, count in requested.items() for index in range(count)]
    order = sorted(items, key=lambda item: generation_place(*item))
    for split, count in requested.items():
        assert [index for name, index in order if name == split] == list(range(count))
    assert [name for name, _ in order[train + validation :]] == ["test"] * test


def test_seeds_are_stable_and_distinct():
    """Seeds are 63-bit, the same for ever, and differ in data set, split, index and attempt."""
    assert scene_seed(0, "train", 0, 0) == 9049802857590921173
    places = product(range(3), ("train", "validation", "test"), range(20), range(3))
    seeds = {scene_seed(*place) for place in places}
    assert len(seeds) == 3 * 3 * 20 * 3
    assert all(0 <= seed < 2**63 for seed in seeds)


@given(split=SPLITS, first=st.integers(0, 2_000_000), size=st.integers(1, 9))
def test_shard_names_parse_back(split, first, size):
    """A name contains split and range, also with more than six digits. Other files in the folder are ignored."""
    shard = ShardRange(split, first, first + size)
    assert parse_shard_name(shard.name) == shard
    for name in ("train-0-1.tar", "train-000001-000001.tar", "extra-000000-000001.tar", "train-000000-000001.tar.gz"):
        assert parse_shard_name(name) is None
