"""The index of a data set: what a publication, a claim and a reader's start cost does not grow with the data set."""

import dataclasses
import os
import re
import sys
from pathlib import Path

import ballistic_dataset
import pytest

import hgn.data.index
import hgn.data.reader
from datagen.pool.writer import DatasetWriter
from hgn.data.entries import EpisodeEntry, ShardEntry, totals_of
from hgn.data.identity import dataset_identity, identity_hash
from hgn.data.index import Index, begin, extend
from hgn.data.manifest import Manifest
from hgn.data.reader import EpisodeStore
from hgn.data.statistics import Moments, Statistics
from hgn.schema import ConfigError

MANY = 1_259  # far from the ends of a segment


class Count:
    """Lines of ours that are run, and bytes that are read from and written to files, while it is entered."""

    def __enter__(self):
        self.lines, self._before = 0, self._bytes()
        sys.settrace(self._trace)
        return self

    def __exit__(self, *error):
        sys.settrace(None)
        self.read, self.written = (b - a for a, b in zip(self._before, self._bytes(), strict=True))

    def _trace(self, frame, event, argument):
        self.lines += event == "line"
        return self._trace if f"{os.sep}data" in frame.f_code.co_filename else None

    def _bytes(self):
        numbers = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
        return int(numbers["rchar"]), int(numbers["wchar"])


def shard(number):
    """The entry of a training shard of one episode and no bytes."""
    members = {f"{name}.npy": (512, 10_000_000) for name in ("position", "material")}
    entry = EpisodeEntry(f"train-{number:06d}", number, 2**62 + number, 0, 4296 + number % 1000, 6, members)
    statistics = Statistics(*2 * [Moments(10**6, (0.1, 0.2, 1 / 3), (0.1, 0.2, 1 / 3))])
    name = f"train-{number:06d}-{number + 1:06d}.tar"
    return ShardEntry(name, "train", number, number + 1, f"{number:064x}", 0, (entry,), statistics)


def listed(config, count):
    """A folder that lists so many shards, which are not there."""
    folder, identity = Path(config.dataset.folder), dataset_identity(config)
    folder.mkdir(parents=True)
    requested = {"train": config.dataset.training_scenes, "validation": 0, "test": 0}
    Manifest(identity_hash(identity), identity, requested, count).save(folder, map(shard, range(count)))
    return folder


@pytest.mark.skipif(sys.platform != "linux", reason="counts bytes in /proc")
def test_costs_do_not_grow(make_config, stage, tmp_path, monkeypatch):
    """A claim, a publication and a look at what is new cost the same in an empty data set and behind 80 segments; a
    reader of these starts after reading a hundredth of their index."""
    monkeypatch.setattr(hgn.data.index, "SEGMENT_SHARDS", 16)
    monkeypatch.setattr(DatasetWriter, "_is_present", lambda self, shard: True)
    costs = []
    for published in (1, MANY):
        sizes = {"training_scenes": MANY + 3, "validation_scenes": 0, "test_scenes": 0, "episodes_per_shard": 1}
        config = make_config(folder=str(tmp_path / str(published)), **sizes)
        folder = listed(config, published)
        with DatasetWriter(config) as writer:
            store = EpisodeStore(folder, "train")
            stage(writer, "train", published)  # what runs for the first time costs more
            assert ballistic_dataset.publish(writer) and store.refresh()
            with Count() as claim:
                assert writer.claim_next()
            stage(writer, "train", published + 1)
            with Count() as publication:
                assert ballistic_dataset.publish(writer)
            with Count() as look:
                assert store.refresh()
            assert store[-1].key == f"train-{published + 1:06d}"
        costs.append([(count.lines, count.read, count.written) for count in (claim, publication, look)])
        with Count() as start:
            assert sum(EpisodeStore(folder, "train").frames()) == 6 * (published + 2)
    for first, last in zip(*costs, strict=True):
        assert last == pytest.approx(first, rel=0.2, abs=400)
    assert start.read < 1e6 * MANY / 100_000
    assert sum(path.stat().st_size for path in folder.glob("index/*")) > 50 * start.read


@pytest.fixture
def small_segments(monkeypatch):
    monkeypatch.setattr(hgn.data.index, "SEGMENT_SHARDS", 3)
    monkeypatch.setattr(hgn.data.index, "_SEGMENTS_CACHED", 2)


def test_every_way_to_read(tmp_path, small_segments):
    """An index lists its shards in order, for any sequence of appends and any start of reading. Each episode is found.
    An earlier state is a beginning of a later state of the same index, and of no other index."""
    shards = [shard(i) for i in range(11)]
    for step in (1, 2, 4, 11):
        folder = tmp_path / str(step)
        folder.mkdir()
        index, earlier = begin(folder), []
        for first in range(0, 11, step):
            index = extend(folder, index, shards[first : first + step])
            earlier.append(index)
        fresh = Index(folder, index.state, index.totals)
        assert list(fresh) == list(index) == shards and fresh[-1] == shards[-1] and fresh[2:5] == shards[2:5]
        assert list(fresh.since(7)) == shards[7:]
        assert [fresh.locate("train", i)[1].index for i in (10, 0, 5, 6)] == [10, 0, 5, 6]
        assert [fresh.digest("train", i) for i in range(12)] == [
            totals_of(shards[:i])["train"].digest for i in range(12)
        ]
        assert all(fresh.continues(before, "train") for before in earlier)
        assert fresh.particles("train", [10, 0, 5]) == [4306, 4296, 4301]
        assert earlier[0].particles("train", [0]) + index.particles("train", [9, 0]) == [4296, 4305, 4296]
        assert {name: (folder / name).stat().st_size for name, _ in fresh.files()} == dict(fresh.files())
    changed = [*shards[:4], dataclasses.replace(shards[4], sha256="a" * 64)]
    assert not fresh.continues(extend(tmp_path, begin(tmp_path), changed), "train")


def test_what_was_not_published_is_written_over(tmp_path, small_segments):
    """Lines after the end that the head states, of a writer that ended before it wrote the head, are ignored and
    overwritten."""
    index = extend(tmp_path, begin(tmp_path), [shard(0), shard(1)])
    extend(tmp_path, index, [shard(7), shard(8)])
    index = extend(tmp_path, index, [shard(2), shard(3)])
    assert [entry.first for entry in Index(tmp_path, index.state, index.totals)] == [0, 1, 2, 3]


def test_a_list_that_is_written_anew_again(tmp_path, monkeypatch):
    """Writers that end before the head of a list written anew, several of them, leave what the head lists."""
    shards = [shard(0), shard(1)]
    manifest = Manifest(identity_hash({}), {}, {"train": 2}, 2).save(tmp_path, shards)
    with monkeypatch.context() as patch:
        patch.setattr("hgn.data.manifest.write_atomically", lambda path, content: 1 / 0)
        for _ in range(3):
            with pytest.raises(ZeroDivisionError):
                manifest.save(tmp_path, shards)
            assert list(Manifest.load(tmp_path).shards) == shards
    manifest.save(tmp_path, shards)
    assert len(manifest.save(tmp_path, shards).shards) == 2 and len({*(tmp_path / "index").glob("*-000000.jsonl")}) <= 3


@pytest.mark.parametrize(
    ("pattern", "text", "message"),
    [
        (r'"sha256":"....', '"sha256":"0000', "must list the .* shards that were published, got others"),
        (r"^.*\n", "", "must have [0-9]+ bytes, got"),
        (r"\Z", "{}\n", ""),
        (r"}\n", " \n", "must be JSON"),
    ],
)
def test_index_that_was_altered(folder, pattern, text, message):
    """Lines that contradict the manifest are refused, and later lines are not read."""
    path = folder / "index" / "1-000000.jsonl"
    path.write_text(re.sub(pattern, text, path.read_text(), count=1))
    store = EpisodeStore(folder, "train")
    if not message:
        assert len(store[:]) == 5
        return
    with pytest.raises(ConfigError, match=message):
        store[0]
