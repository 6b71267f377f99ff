"""The deterministic order of samples, and its exact resume."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hgn.data.sampler import BLOCK_EPISODES, EpisodeSampler, SamplerState
from hgn.schema import ConfigError

frame_counts = st.lists(st.integers(2, 9), min_size=1, max_size=6)


def take(order, batches):
    return [(s.episode, s.frame, s.seed) for _ in range(batches) for s in order.next_batch()]


@settings(max_examples=60, deadline=None)
@given(frame_counts, st.integers(1, 4), st.integers(1, 8), st.integers(0, 5))
def test_each_sample_once_an_epoch(frames, batch, world_size, seed):
    """On any world size and batch, the ranks together see every sample exactly once in each epoch."""
    ranks = [EpisodeSampler(seed, batch, lambda _: frames, rank=r, world_size=world_size) for r in range(world_size)]
    total = sum(frames) - len(frames)
    epochs = 3
    stream = []
    while len(stream) < epochs * total:
        for rank in ranks:
            stream += [(s.episode, s.frame) for s in rank.next_batch()]
    expected = sorted((e, n) for e, count in enumerate(frames) for n in range(count - 1))
    for epoch in range(epochs):
        assert sorted(stream[epoch * total : (epoch + 1) * total]) == expected


@settings(max_examples=60, deadline=None)
@given(frame_counts, st.integers(1, 4), st.integers(1, 3), st.integers(0, 20), st.integers(1, 20))
def test_resume_equals_no_interruption(frames, batch, world_size, before, after):
    """Starting again from the state gives the samples, and their seeds, that would have come."""
    for rank in range(world_size):
        order = EpisodeSampler(3, batch, lambda _: frames, rank=rank, world_size=world_size)
        take(order, before)
        again = EpisodeSampler(3, batch, lambda _: frames, order.state, rank, world_size)
        assert take(again, after) == take(order, after)


def test_growing_data_waits_for_the_next_epoch():
    """Episodes published during an epoch join the next one, also when the run was interrupted between."""
    published = [3]
    order = EpisodeSampler(0, 1, lambda _: published)
    first = take(order, 1)
    published.append(4)
    again = EpisodeSampler(0, 1, lambda _: published, order.state)
    rest = take(again, 1)
    assert sorted(s[:2] for s in first + rest) == [(0, 0), (0, 1)]
    assert again.state.episodes == 1
    assert sorted(s[:2] for s in take(again, 5)) == [(0, 0), (0, 1), (1, 0), (1, 1), (1, 2)]
    assert again.state == SamplerState(1, 5, 2)


def test_epochs_and_seeds_differ():
    """Another epoch and another seed shuffle differently; each sample's noise seed is its own."""
    samples = take(EpisodeSampler(0, 1, lambda _: [101]), 200)
    first, second = samples[:100], samples[100:]
    assert [s[1] for s in first] != [s[1] for s in second]
    assert [s[1] for s in first] != [s[1] for s in take(EpisodeSampler(1, 1, lambda _: [101]), 100)]
    assert len({s[2] for s in samples}) == 200


def test_lost_or_missing_episodes_are_refused():
    """A data set that has shrunk, or is empty, ends in a message with the remedy."""
    with pytest.raises(ConfigError, match="must still hold the 3 training episodes"):
        EpisodeSampler(0, 1, lambda _: [5, 5], SamplerState(0, 2, 3))
    with pytest.raises(ConfigError, match="at least one training episode"):
        EpisodeSampler(0, 1, lambda _: [])


def test_other_shards_are_refused():
    """An epoch goes on only with the shards that it began with, in their order; later ones may be there."""
    order = EpisodeSampler(0, 1, lambda _: [5, 5], digest=lambda count: f"digest {count}")
    assert order.state.digest == "digest 2"
    EpisodeSampler(0, 1, lambda _: [5, 5, 5], order.state, digest=lambda count: f"digest {count}")
    EpisodeSampler(0, 1, lambda _: [5, 5], replace(order.state, digest=""), digest=lambda count: f"digest {count}")
    for found in ("other", None):
        with pytest.raises(ConfigError, match="must still hold the shards that epoch 0 began with"):
            EpisodeSampler(0, 1, lambda _: [5, 5], order.state, digest=lambda count, found=found: found)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(2, 5), min_size=1, max_size=60), st.integers(1, 40), st.integers(1, 4), st.integers(0, 99))
def test_windows(frames: list[int], window: int, world_size: int, cut: int):
    """With a window each sample still comes once an epoch, on any number of ranks and through an interruption; between
    two samples of an episode lie no more than those of a window's episodes."""
    total = sum(frames) - len(frames)

    def ranks(state: SamplerState | None = None) -> list[EpisodeSampler]:
        orders = range(world_size)
        return [EpisodeSampler(3, 1, lambda _: frames, state, rank, world_size, window=window) for rank in orders]

    samples: list[tuple[int, int]] = []
    orders = ranks()
    while len(samples) < total:
        if len(samples) == cut // world_size * world_size:
            orders = ranks(orders[0].state)
        samples += [sample[:2] for order in orders for sample in order.next_batch()]
    epoch = samples[:total]
    assert sorted(epoch) == [(episode, frame) for episode, count in enumerate(frames) for frame in range(count - 1)]
    if window < len(frames):
        most = 4 * BLOCK_EPISODES * max(1, window // BLOCK_EPISODES)
        places = [[i for i, (episode, _) in enumerate(epoch) if episode == e] for e in range(len(frames))]
        assert all(place[-1] - place[0] < most for place in places)


def test_window_cannot_change_within_an_epoch():
    """Another window is another order: an epoch goes on with its own, and its end with any."""
    order = EpisodeSampler(0, 1, lambda _: [5] * 20, window=8)
    take(order, 1)
    with pytest.raises(ConfigError, match=r"training\.shuffle_episodes must be 8 to go on in the middle of epoch 0"):
        EpisodeSampler(0, 1, lambda _: [5] * 20, order.state)
    assert EpisodeSampler(0, 1, lambda _: [5] * 20, SamplerState(1, 0, 20, "", 8)).state.window == 0


def test_order_is_the_same_everywhere():
    """The order is part of the contract: this is the start of seed 0, epoch 0, on three episodes of 5 frames."""
    found = [s[:2] for s in take(EpisodeSampler(0, 2, lambda _: [5, 5, 5]), 3)]
    assert found == [(2, 1), (0, 2), (1, 3), (1, 0), (1, 1), (2, 3)]
