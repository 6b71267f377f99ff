"""Tests that samples are the same whether they are read whole or in windows, from a folder or a URL."""

import threading
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import fsspec
import pytest
import torch
from training.runs import NETWORK, TRAINING

from hgn.config import NetworkConfig, TrainingConfig
from hgn.data.episode_tensors import EpisodeTensors
from hgn.data.reader import EpisodeStore
from hgn.data.shard_cache import LIMIT_VARIABLE
from hgn.schema import ConfigError
from hgn.training.data_module import EpisodeDataModule, agreed_count
from hgn.training.readers import EpisodeReader, WindowReader

UPDATES = 40  # of 2 samples, where an epoch has 25
SETTINGS = (NetworkConfig(**NETWORK), TrainingConfig(**TRAINING | {"maximum_updates": 200}))


def windows_of(folder, training=SETTINGS[1], **options):
    store = EpisodeStore(folder, "train")
    return EpisodeDataModule(store, training, WindowReader(store, SETTINGS[0], training), **options)


def episodes_of(folder, training, **options):
    store = EpisodeStore(folder, "train")
    return EpisodeDataModule(store, training, EpisodeReader(store, SETTINGS[0], training), **options)


@pytest.mark.parametrize(("importance", "quiet"), [(0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)])
def test_resident_feeding_equals_streaming(folder, importance, quiet):
    """Whole episodes in a GPU's memory contain bitwise the same windows as streaming, for samples with the same order,
    seeds and weights. Each episode is sent once, and the cursors agree at the end of every chunk."""
    changes = {"frame_importance": importance, "quiet_acceleration": quiet}  # nothing accelerates as much
    network, training = SETTINGS[0], replace(SETTINGS[1], **changes)
    expected = list(islice(windows_of(folder, training).chunks(), UPDATES))
    resident: dict[int, EpisodeTensors] = {}
    update = 0
    for chunk in episodes_of(folder, training).chunks():
        assert not resident.keys() & chunk.episodes.keys()
        resident |= chunk.episodes
        for samples in chunk.samples[: UPDATES - update]:
            batch = expected[update].batch
            windows = [
                resident[sample.episode].position_TN3[sample.frame : sample.frame + network.velocity_history + 2]
                for sample in samples
            ]
            assert torch.equal(torch.cat(windows, dim=1), batch.window_WN3)
            assert torch.equal(torch.cat([resident[s.episode].material_N for s in samples]).long(), batch.material_N)
            assert tuple(sample.seed for sample in samples) == batch.seeds_S
            assert tuple(sample.weight for sample in samples) == batch.weight_S
            assert (batch.weight_S == (1.0, 1.0)) == (importance == quiet == 0)
            if importance == 0:
                assert batch.weight_S == ((4.0, 4.0) if quiet else (1.0, 1.0))
            update += 1
        if update == UPDATES:
            break
        assert chunk.sampler_state == expected[update - 1].sampler_state
    assert len(resident) == 5


def test_shard_made_again_is_not_mixed_up(make_config, make_dataset, folder):
    """A damaged shard that was deleted and made again is published last. An epoch that began before does not resume,
    because some samples would be used twice."""
    *_, last = islice(windows_of(folder).chunks(), 3)
    (folder / "train-000001-000002.tar").unlink()
    make_dataset(make_config())
    again = windows_of(folder)
    again.sampler_state = last.sampler_state
    with pytest.raises(ConfigError, match="must still contain the shards that epoch 0 began with, in the order"):
        next(again.chunks())


@pytest.mark.parametrize("here", [True, False])
def test_ranks_with_other_data_are_refused(folder, here):
    """Ranks whose data were published in another order end together, wherever the difference is seen."""

    asked: list[bool] = []

    class Strategy:
        def broadcast(self, mine):
            return (mine[0], "another order" if here else mine[1], {"seed": 0})

        def reduce_boolean_decision(self, same, all):
            asked.append(same)
            return same and (here or len(asked) == 1)

    trainer = SimpleNamespace(world_size=2, global_rank=1, strategy=Strategy())
    with pytest.raises(ConfigError, match=r"must show the same 5 episodes on every node, got others.* rank"):
        agreed_count(EpisodeStore(folder, "train"), trainer, {"seed": 0})
    with pytest.raises(ConfigError, match=r"training.seed must be the same on all ranks, got \{'seed': 1\} on rank 1"):
        agreed_count(EpisodeStore(folder, "train"), trainer, {"seed": 1})


@pytest.mark.parametrize(("ahead", "room"), [(False, 1 / 3), (True, 1 / 3), (True, 2 / 3)])
def test_data_larger_than_the_cache(make_config, make_dataset, cache, monkeypatch, ahead, room):
    """With shuffling in windows, an epoch fetches each shard once through a cache for a third of the data. Its batches
    equal those of a reader with all data. If the cache has space for two windows, the training waits only for shards of
    the first one, because the next samples are known in advance."""
    folder = make_dataset(make_config(training_scenes=32, validation_scenes=0, test_scenes=0, frames=3))
    training = replace(SETTINGS[1], shuffle_episodes=8)
    sizes = [shard.bytes for shard in EpisodeStore(folder, "train").manifest.shards]
    files = fsspec.filesystem("memory")
    files.put(str(folder), "/larger", recursive=True)
    monkeypatch.setenv(LIMIT_VARIABLE, str(room * sum(sizes) / 1e9))
    if not ahead:
        monkeypatch.setattr(EpisodeStore, "fetch_ahead", lambda store, episodes=None: None)
    fetched: list[str] = []
    waited_for: list[int] = []  # batches so far, of each shard that was not fetched ahead
    real, given = files.cat_file, 0

    def cat_file(path, *arguments, **options):
        fetched.append(path)
        if path.endswith(".tar") and threading.current_thread().name != "shards":
            waited_for.append(given)
        return real(path, *arguments, **options)

    monkeypatch.setattr(files, "cat_file", cat_file)
    monkeypatch.setattr("hgn.training.data_module.CHUNKS_AHEAD", 0)
    epoch = 32 * 2 // 2

    def batches(place, training):
        nonlocal given
        given = 0
        feed, found = windows_of(place, training), []
        for batch in islice(feed.chunks(), epoch):
            found.append(batch)
            given = len(found)
            if (fetcher := feed.store._fetcher) is not None:
                fetcher.join()  # training takes its time
        return found

    for here, there in zip(batches(folder, training), batches("memory://larger", training), strict=True):
        assert torch.equal(here.batch.window_WN3, there.batch.window_WN3)
        assert (here.batch.seeds_S, here.sampler_state) == (there.batch.seeds_S, there.sampler_state)
    once = sorted(name for name in fetched if name.endswith(".tar"))
    assert len(once) == len(set(once)) == len(sizes) == 7
    assert room < 2 / 3 or max(waited_for, default=0) == 0
    assert ahead or len(waited_for) == 7
    fetched.clear()
    batches("memory://larger", SETTINGS[1])
    assert len([name for name in fetched if name.endswith(".tar")]) > 2 * len(sizes)
